"""Bodies of different materials in one scene: each behaves as it would alone, and they meet."""

import pytest
import torch

from neuido.data.bodies.shapes import cube
from neuido.errors import UserError
from neuido.physics.laws.classical import FixedCorotated, Identity, Sigma, VonMises
from neuido.physics.laws.composite import by_body
from neuido.physics.mpm.simulator import Simulator
from neuido.types import Body, Scene


def join(*bodies):
    return Body(*(torch.cat([getattr(body, name) for body in bodies]) for name in ("x", "v", "volume")))


def bodies(gap=0.35):
    options = {"length": 0.15, "particles_per_side": 4}
    left = cube(centre=(0.3, 0.1, 0.5), velocity=(0.0, -2.0, 0.0), **options)
    right = cube(centre=(0.3 + gap, 0.1, 0.5), velocity=(0.0, -1.0, 0.0), **options)
    return left, right


def test_apart_each_moves_as_if_alone():
    left, right = bodies()
    scene = Scene(cells=16, dt=1e-3)
    soft, hard = (FixedCorotated(1e4, 0.2), Identity()), (Sigma(1e5, 0.3), VonMises(1e3, 1e5, 0.3))
    simulator = Simulator(scene, join(left, right), device="cpu")
    laws = by_body([soft[0], hard[0]], [soft[1], hard[1]], [64, 64], simulator.order)
    with torch.no_grad():
        together = simulator.rollout(100, *laws, every=100)
        alone = [Simulator(scene, body, device="cpu").rollout(100, *pair, every=100) for body, pair in ((left, soft), (right, hard))]
    assert torch.allclose(together.x[-1, :64], alone[0].x[-1], atol=1e-5)
    assert torch.allclose(together.x[-1, 64:], alone[1].x[-1], atol=1e-5)
    assert (alone[0].x[-1, :, 1].mean() - alone[1].x[-1, :, 1].mean()).abs() > 5e-3
    assert float(laws[0].modulus()) == pytest.approx(float(hard[0].modulus()))


def test_gradients_reach_each_law():
    left, right = bodies()
    simulator = Simulator(Scene(cells=16, dt=1e-3), join(left, right), dtype=torch.float64, device="cpu")
    young = [torch.tensor([value], dtype=torch.float64, requires_grad=True) for value in (1e4, 5e4)]

    def height(first, second):
        laws = by_body([FixedCorotated(first, 0.2), FixedCorotated(second, 0.2)], [Identity(), Identity()], [64, 64], simulator.order)
        return simulator.rollout(60, *laws, every=60).x[-1, :, 1].square().sum()

    gradients = torch.autograd.grad(height(*young), young)
    with torch.no_grad():
        for i in range(2):
            moved = [[y + (sign * 1.0 if j == i else 0.0) for j, y in enumerate(young)] for sign in (1, -1)]
            difference = (height(*moved[0]) - height(*moved[1])) / 2
            assert float(gradients[i]) == pytest.approx(float(difference), rel=1e-4)


def test_numbers_that_do_not_fit_are_refused():
    left, _ = bodies()
    simulator = Simulator(Scene(cells=16, dt=1e-3), left, device="cpu")
    with pytest.raises(UserError, match="the simulator has 64"):
        by_body([FixedCorotated(1e4, 0.2)], [Identity()], [60], simulator.order)
