"""Bodies of fluid, honey, snow, foam and rubber: closed forms of a Newtonian fluid, drops, and the ranges of the families."""

import itertools
import math

import pytest
import torch

from neuido.data.bodies import families, shapes
from neuido.data.files.parsing import read_yaml
from neuido.installation import configs_root
from neuido.physics.effects.parameters import Effects
from neuido.physics.laws.classical import Fluid, VolumetricReset
from neuido.physics.mpm.simulator import Simulator
from neuido.types import Scene, Walls
from tests.physics.bodies import DEVICE, block

SLIP = Walls("slip", 0.0, inset=0.0)
DROPS = {
    "rubber": {"young": 1e5, "poisson": 0.45, "share": 0.2},
    "foam": {"young": 1e5, "poisson": 0.1, "exponent": 4.0},
    "fluid": {"bulk": 2e5, "viscosity": 1.0},
    "viscoplastic": {"young": 3e5, "poisson": 0.4, "yield_stress": 500.0, "viscosity": 60.0, "index": 0.7},
    "snow": {"young": 1.4e5, "poisson": 0.2, "compression": 0.025, "stretch": 0.0075, "hardening": 5.0},
}


def test_a_vortex_decays_by_its_viscosity():
    """Taylor and Green's vortex in a box of walls that slip: v = U (sin kx cos ky, -cos kx sin ky) exp(-2 nu k^2 t), k = pi/L.

    nu is such that the dissipation of the grid, a tenth of that at this resolution, is within the tolerance.
    """
    cells, nu, steps, dt, k = 12, 0.2, 40, 2e-3, math.pi
    thick = 4 / cells
    body = block((0, 0, 0), (1, 1, thick), (2 * cells, 2 * cells, 8))
    x, y = body.x[:, 0], body.x[:, 1]
    body.v[:, 0], body.v[:, 1] = 0.2 * (k * x).sin() * (k * y).cos(), -0.2 * (k * x).cos() * (k * y).sin()
    scene = Scene(upper=(1.0, 1.0, thick), cells=cells, dt=dt, gravity=(0.0, 0.0, 0.0), walls=SLIP)
    simulator = Simulator(scene, body, density=1000.0, device=DEVICE)
    frames = simulator.rollout(steps, Fluid(2e4), VolumetricReset(), effects=Effects(viscosity_shear=1000 * nu), every=steps)
    x, y = frames.x[..., 0], frames.x[..., 1]
    size = (frames.v[..., 0] * (k * x).sin() * (k * y).cos() - frames.v[..., 1] * (k * x).cos() * (k * y).sin()).mean(1)
    assert float(-(size[1] / size[0]).log()) / (steps * dt) == pytest.approx(2 * nu * k**2, rel=0.06)


def test_a_fluid_at_rest_carries_its_weight():
    """Water that begins in equilibrium stays there, with the pressure density g (H - y)."""
    cells, bulk, height = 10, 1e6, 0.6
    body = block((0, 0, 0), (0.4, height, 0.4), (8, 12, 8))
    scene = Scene(upper=(0.4, 1.0, 0.4), cells=cells, dt=1e-3, gravity=(0.0, -9.8, 0.0), walls=SLIP)
    simulator = Simulator(scene, body, density=1000.0, device=DEVICE)
    start = simulator.state
    p = 9800 * (height - start.x[:, 1].double())
    F = ((1 + 7 * p / bulk) ** (-1 / 21))[:, None, None] * torch.eye(3, dtype=torch.float64, device=p.device)
    effects = Effects(viscosity_shear=100.0, viscosity_bulk=1000.0)
    frames = simulator.rollout(300, Fluid(bulk), VolumetricReset(), effects=effects, state=start._replace(F=F.to(start.F)), every=300)
    assert float(frames.v[-1].abs().max()) < 0.01
    y, p = frames.x[-1, :, 1].double(), bulk / 7 * (torch.linalg.det(frames.F[-1].double()) ** -7 - 1)
    for low, high in ((0.1, 0.3), (0.3, 0.5)):
        inner = (y > low) & (y < high)
        assert float((p / (9800 * (height - y)))[inner].mean()) == pytest.approx(1.0, rel=0.03)


def test_a_drop_of_each_material():
    """300 substeps in one box each: all stay finite; a fluid becomes a puddle, honey later, snow keeps a heap, rubber its shape."""
    body = shapes.cube(length=0.3, particles_per_side=6, velocity=(0.0, -2.0, 0.0), centre=(0.5, 0.3, 0.5))
    simulator = Simulator(Scene(cells=20, dt=1e-3, walls=Walls(friction=0.5)), body, density=1000.0, device=DEVICE)
    height = {}
    for family, entry in DROPS.items():
        frames = simulator.rollout(300, *families.laws(family, [entry]), effects=families.effects(family, [entry]), every=100)
        assert torch.isfinite(frames.x).all() and not [event for event in frames.events if event.kind == "inversion"], family
        height[family] = float(frames.x[-1, :, 1].max())
    assert height["fluid"] < 0.7 * height["viscoplastic"] and height["viscoplastic"] < 0.8 * height["snow"], height
    assert height["snow"] < 0.8 * height["rubber"], height


@pytest.mark.slow
@pytest.mark.parametrize("family", DROPS)
def test_the_corners_of_the_ranges_run(family):
    """The ranges of the configuration of Stage I, in its box, at every combination of lowest and highest (a random eighth of 32)."""
    content = read_yaml(configs_root() / "trajectories_materials.yaml")
    ranges = content["families"][family]
    families.check_ranges(family, ranges)
    corners = [dict(zip(ranges, corner)) for corner in itertools.product(*ranges.values())]
    if len(corners) > 8:
        corners = [corners[i] for i in torch.randperm(len(corners), generator=torch.Generator().manual_seed(0))[:4]]
    body = shapes.cube(length=0.5, particles_per_side=6, velocity=(1.0, -1.5, -2.0), angular_velocity=(4.0, 4.0, 4.0))
    scene = Scene(cells=20, dt=5e-4, walls=Walls(contact="separate", friction=0.0, inset=2.0))
    simulator = Simulator([scene] * len(corners), [body] * len(corners), density=1000.0, device=DEVICE)
    frames = simulator.rollout(600, *families.laws(family, corners), effects=families.effects(family, corners), every=100)
    assert torch.isfinite(frames.x).all() and torch.isfinite(frames.F).all()
