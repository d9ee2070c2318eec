"""Steps below the resolution of float32: what rounding leaves out of positions and strains is carried to the next step."""

import pytest
import torch

from neuido.data.bodies.shapes import cube
from neuido.physics.fem import FiniteElements
from neuido.physics.laws import FixedCorotated
from neuido.physics.mpm import Simulator
from neuido.physics.springs import MassSpring, connect
from neuido.types import Scene

LAW = FixedCorotated(1e4, 0.3)
BODY = cube(length=0.1, particles_per_side=4, centre=(0.45, 0.45, 0.45))
CASES = [(1e-5, 5000, 1e-3), (1e-6, 4000, 0.02), (1e-6, 4000, 0.05)]
"""Step [s], steps and speed [m/s]: less than half a unit of rounding of x, two thirds of one, and one and two thirds.

They are those of the shared case 18-small-step-float32, with fewer steps at 1e-6 s.
"""


def scene(dt):
    return Scene(lower=(0.3,) * 3, upper=(0.7,) * 3, cells=8, dt=dt, walls=None, gravity=(0.0, 0.0, 0.0))


def moving(speed):
    return BODY._replace(x=BODY.x.float(), v=torch.tensor([speed, 0.0, 0.0]).expand(64, 3).contiguous(), volume=BODY.volume.float())


@pytest.mark.parametrize(("dt", "steps", "speed"), CASES)
@pytest.mark.parametrize("solver", [Simulator, FiniteElements])
def test_a_slow_body_gets_as_far_as_its_speed_takes_it(solver, dt, steps, speed):
    frames = solver(scene(dt), moving(speed), device="cpu").rollout(steps, LAW, every=steps)
    assert float((frames.x[-1] - frames.x[0])[:, 0].mean()) == pytest.approx(speed * dt * steps, rel=2e-3)


@pytest.mark.parametrize(("dt", "steps", "speed"), CASES)
def test_slow_masses_on_springs_do_too(dt, steps, speed):
    body = moving(speed)
    springs = connect(body.x, 4)
    k = torch.ones(len(springs.pairs))
    solver = MassSpring(scene(dt), springs, torch.full((64,), 1e-3))
    x, _ = solver.rollout(steps, dt, body.x, body.v, k, 0 * k, torch.tensor(1.0), every=steps)
    assert float((x[-1] - x[0])[:, 0].mean()) == pytest.approx(speed * dt * steps, rel=2e-3)


@pytest.mark.parametrize("segment", [None, 1000])
def test_a_slow_strain_is_kept(segment):
    """dt C is below half a unit of rounding of F = I: without its rest F would stay what it is."""
    rate, dt, steps = 0.03, 1e-6, 4000
    stretching = BODY._replace(v=rate * (BODY.x - 0.45) * torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64))
    ends = []
    for dtype in (torch.float32, torch.float64):
        sim = Simulator(scene(dt), stretching, device="cpu", dtype=dtype)
        x = sim.state.x.clone().requires_grad_(segment is not None)
        ends.append(sim.rollout(steps, FixedCorotated(1.0, 0.3), every=1000, segment=segment, state=sim.state._replace(x=x)).F[-1].detach())
    stretch = ends[0][:, 0, 0].double() - 1
    assert float(stretch.mean()) == pytest.approx(rate * dt * steps, rel=0.01)
    torch.testing.assert_close(ends[0].double(), ends[1], rtol=0, atol=3e-7)


def test_usual_steps_carry_nothing():
    """Rounding is no matter there, and a launch reads and writes less."""
    sim = Simulator(Scene(cells=16, dt=5e-4), BODY._replace(v=BODY.v + 1.0), device="cpu")
    assert not sim._rounds_off(sim.state, sim.gravity[None], 100)
    slow = Simulator(scene(1e-6), moving(0.02), device="cpu")
    assert slow._rounds_off(slow.state, slow.gravity[None], 4000)
    assert not Simulator(scene(1e-6), moving(0.02), device="cpu", dtype=torch.float64)._rounds_off(slow.state, slow.gravity[None], 4000)
