"""A grid that follows the matter against the grid of the whole domain."""

import dataclasses
import math

import pytest
import torch

from neuido.data.bodies import shapes
from neuido.errors import UserError
from neuido.physics.effects.parameters import Effects
from neuido.physics.laws.classical import FixedCorotated, VonMises
from neuido.physics.mpm.simulator import Simulator
from neuido.physics.mpm.window.placement import PIECE, Window, corners, pieces
from neuido.types import Body, Plane, Scene
from tests.physics.bodies import DEVICE

GROUND = Plane((0.0, 0.15, 0.0), (0.1, 1.0, 0.0), "separate", 0.3)
WIDE = Scene(upper=(2.0, 2.0, 1.5), cells=40, dt=1e-3, colliders=(GROUND,))
TALL = Scene(upper=(1.0, 2.4, 1.0), cells=48, dt=1e-3)


def simulator(grid, **options):
    thrown = shapes.cube(length=0.2, centre=(0.5, 0.3, 0.7), particles_per_side=4, velocity=(4.0, -2.0, 0.0))
    falling = shapes.cube(length=0.2, centre=(0.5, 2.25, 0.5), particles_per_side=3, velocity=(0.0, -6.0, 0.0))
    return Simulator([WIDE, TALL], [thrown, falling], dtype=torch.float64, device=DEVICE, grid=grid, **options)


def rolled(grid, every, segment=None):
    """Return frames, and gradients of a loss over several of them, with respect to everything that a rollout differentiates."""
    sim = simulator(grid)
    leaves = {"young": torch.tensor([5e4], dtype=torch.float64, requires_grad=True)}
    leaves["v"] = sim.state.v.clone().requires_grad_()
    leaves["friction"] = sim.colliders.friction.clone().requires_grad_()
    leaves["wave"] = torch.tensor([[[3.0, 0.0, 1.0], [0.0, 2.0, 0.0]]] * 2, dtype=torch.float64, device=DEVICE, requires_grad=True)
    effects = Effects(time_force=leaves["wave"], time_force_interval=0.06)
    frames = sim.rollout(
        60, FixedCorotated(leaves["young"], 0.3), VonMises(4e3, leaves["young"], 0.3), state=sim.state._replace(v=leaves["v"]),
        friction=leaves["friction"], effects=effects, every=every, segment=segment,
    )  # fmt: skip
    loss = frames.x[-1].square().sum() + frames.x[len(frames.x) // 2].pow(3).sum() + frames.F[1:].square().sum()
    return frames, torch.autograd.grad(loss, list(leaves.values())), sim


@pytest.mark.parametrize(("every", "segment"), [(4, 4), (30, None)])
def test_a_window_changes_no_frame_and_no_gradient(every, segment):
    whole, gradients, _ = rolled("domain", every, segment)
    frames, own, sim = rolled("window", every, segment)
    assert sim.setup.room.count < 2 * math.prod(sim.setup.whole) * (0.2 if segment else 0.6)
    first = sim.setup.window.first.clone()
    sim.setup.window.fit(*corners(whole.x[0].detach(), sim.particles.offsets), segment or PIECE)
    assert segment is None or bool((sim.setup.window.first != first).any(dim=1).all())  # the windows moved with their bodies
    for a, b in zip(whole, frames):
        torch.testing.assert_close(b, a, rtol=1e-9, atol=1e-12)
    for a, b in zip(gradients, own):
        torch.testing.assert_close(b, a, rtol=1e-7, atol=1e-10 * float(a.abs().max()))


def test_bodies_that_meet_do_so_in_a_window_too():
    def run(grid):
        pair = [
            Body(*shapes.cube(length=0.2, centre=(x, 0.5, 0.5), particles_per_side=4, velocity=(v, 0.0, 0.0))[:3], name=name, law=law)
            for x, v, name, law in ((0.5, 2.0, "left", FixedCorotated(5e4, 0.3)), (0.73, -1.0, "right", FixedCorotated(2e5, 0.2)))
        ]
        scene = Scene(upper=(2.0, 1.0, 1.0), cells=40, dt=1e-3, bodies=tuple(pair))
        return Simulator(scene, dtype=torch.float64, device=DEVICE, grid=grid).rollout(40, every=8, segment=8)

    whole, frames = run("domain"), run("window")
    assert float((whole.v[-1, :64, 0].mean() - 2.0).abs()) > 0.5  # they met
    torch.testing.assert_close(frames.x, whole.x, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(frames.F, whole.F, rtol=1e-7, atol=1e-10)


def test_memory_goes_with_the_matter_and_not_with_the_domain():
    body = shapes.cube(length=0.2, centre=(0.5, 0.5, 0.5), particles_per_side=8)
    tight = Simulator(Scene(cells=40, dt=1e-4), body, device="cpu")
    wide = Simulator(Scene(upper=(5.0, 5.0, 5.0), cells=200, dt=1e-4), body, device="cpu", grid="window")
    assert math.prod(wide.setup.whole) > 90 * tight.setup.room.count
    assert wide.setup.room.count <= 1.5 * tight.setup.room.count


def test_a_large_domain_is_followed_without_being_asked():
    body = shapes.cube(length=0.2, centre=(0.5, 0.5, 0.5), particles_per_side=4)
    scene = Scene(upper=(5.0, 5.0, 5.0), cells=200, dt=1e-4)
    assert Simulator(scene, body, device="cpu").setup.window is not None
    assert Simulator(dataclasses.replace(scene, cells=40), body, device="cpu").setup.window is None


def test_a_particle_that_leaves_the_domain_is_told_as_without_a_window():
    body = shapes.cube(length=0.2, centre=(0.5, 0.5, 0.5), particles_per_side=3, velocity=(8.0, 0.0, 0.0))
    lines = []
    for grid in ("domain", "window"):
        sim = Simulator(Scene(cells=16, dt=1e-3, walls=None, gravity=(0.0, 0.0, 0.0)), body, device="cpu", grid=grid, dtype=torch.float64)
        with pytest.raises(UserError, match="left the domain") as error:
            sim.rollout(120, FixedCorotated(1e4, 0.3), every=40)
        lines.append(str(error.value).split("(")[0])
    assert lines[0] == lines[1]


def test_frames_of_a_failed_scene_leave_the_others_alone():
    def run(grid):
        sim = simulator(grid)
        state = sim.state._replace(v=sim.state.v.clone())
        state.v[-1] = math.nan
        return sim.rollout(48, FixedCorotated(5e4, 0.3), state=state, every=24, nan_on_failure=True)

    whole, frames = run("domain"), run("window")
    assert bool(frames.x[-1, -1].isnan().all())
    torch.testing.assert_close(frames.x[:, :64], whole.x[:, :64], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(
    ("steps", "every", "segment"), [(120, 1, None), (120, 5, None), (120, 40, None), (51, 17, None), (24, 8, 8), (7, 7, 3)]
)
def test_pieces_cover_a_rollout_and_end_at_every_frame(steps, every, segment):
    parts = pieces(steps, every, segment)
    assert [part.first for part in parts] == [sum(part.steps for part in parts[:i]) for i in range(len(parts))]
    assert sum(part.steps for part in parts) == steps
    assert all(part.steps <= min(PIECE, segment or PIECE) and part.steps % part.every == 0 for part in parts)
    ends = {part.first + k * part.every for part in parts for k in range(1, part.steps // part.every + 1)}
    assert set(range(every, steps + 1, every)) <= ends


def test_a_window_stays_on_the_lattice_and_in_the_domain():
    window = Window([WIDE], pad=2)
    for x in (0.0, 0.7, 2.0):
        at = torch.tensor([[x, x, min(x, 1.5)]], dtype=torch.float64)
        (nx, ny, nz), origin = window.fit(at, at, 5)
        cells = (origin - window.edge) / WIDE.dx
        torch.testing.assert_close(cells, cells.round(), rtol=0, atol=1e-9)
        assert bool((cells >= 0).all()) and bool((cells.long() + torch.tensor([nx, ny, nz]) <= window.whole).all())


def test_particles_that_are_not_finite_have_no_corners():
    x = torch.tensor([[0.0, 1.0, 2.0], [math.nan, 9.0, 9.0], [math.inf, 0.0, 0.0]])
    low, high = corners(x, (0, 2, 3))
    assert low[0].tolist() == high[0].tolist() == [0.0, 1.0, 2.0]
    assert low[1].tolist() == [math.inf] * 3


def test_an_unknown_grid_is_one_line():
    with pytest.raises(UserError, match="grid is 'sparse'; choose domain, window or auto"):
        simulator("sparse")
