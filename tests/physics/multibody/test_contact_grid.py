"""Contact between bodies: balances and closed forms, and gradients against finite differences."""

import math

import pytest
import torch

from neuido.data.bodies import shapes
from neuido.errors import UserError
from neuido.physics.colliders.solids import Sphere
from neuido.physics.laws.classical import FixedCorotated, NeoHookean, Sigma
from neuido.physics.mpm import reference
from neuido.physics.mpm.simulator import Simulator
from neuido.types import Body, Box, Plane, Scene
from tests.physics.balances import note

YOUNG, POISSON, RHO = 1e5, 0.3, 1000.0
WAVE = math.sqrt(YOUNG * (1 - POISSON) / ((1 + POISSON) * (1 - 2 * POISSON)) / RHO)
"""Speed of the elastic P-wave [m/s]."""


def simulator(scene, dtype=torch.float64):
    return Simulator(scene, device="cpu", dtype=dtype)


def momentum(sim, frames):
    return (sim.mass[:, None] * frames.v).sum(1)


def velocity(sim, frames, body):
    own = frames.body == body
    share = sim.mass[own] / sim.mass[own].sum()
    return (share[:, None] * frames.v[:, own]).sum(1)


def balls(contact="separate", cells=24, speed=0.5, ratio=1.0):
    ball = {"radius": 0.1, "spacing": 0.48 / cells}
    law = FixedCorotated(YOUNG, POISSON)
    left = Body(shape=shapes.ball(centre=(0.39, 0.5, 0.5), **ball), name="left", velocity=(speed, 0.0, 0.0), law=law, density=RHO)
    right = Body(
        shape=shapes.ball(centre=(0.61, 0.5, 0.5), **ball), name="right", velocity=(-speed, 0.0, 0.0), law=law, density=ratio * RHO
    )
    gravity = (0.0, 0.0, 0.0)
    return Scene(cells=cells, dt=0.5 / cells / WAVE, gravity=gravity, bodies=[left, right], contact=contact, walls=None)


@pytest.mark.parametrize("ratio", [1.0, 2.0])
def test_balls_collide_head_on_by_the_closed_form(ratio, record_property):
    """v' = (p ± e m v_rel) / M; a grid of finite cells loses a part of the restitution e, less the finer it is."""
    restitution = []
    for cells in (16, 24):
        scene = balls(cells=cells, ratio=ratio)
        sim = simulator(scene)
        with torch.no_grad():
            frames = sim.rollout(round(0.15 / scene.dt), every=round(0.15 / scene.dt))
        left, right = (velocity(sim, frames, body)[:, 0] for body in (0, 1))
        restitution.append(float(right[-1] - left[-1]) / float(left[0] - right[0]))
        own = [float(sim.mass[frames.body == b].sum()) for b in (0, 1)]
        total = float(momentum(sim, frames)[0, 0])
        assert float(left[-1]) == pytest.approx((total - own[1] * restitution[-1] * 1.0) / sum(own), abs=1e-9)
        assert momentum(sim, frames).sub(momentum(sim, frames)[0]).abs().max() < 1e-12
        drift = momentum(sim, frames).sub(momentum(sim, frames)[0]).abs().max()
        note(
            record_property,
            "momentum of a head-on collision [kg m/s]",
            f"masses 1 : {ratio:g}, balls of {round(0.2 * cells)} cells",
            drift,
            0.0,
        )
        energy = 0.5 * (sim.mass[:, None] * frames.v.square()).sum((1, 2))
        assert energy[-1] < energy[0]
    assert all(0.84 < e < 1 for e in restitution)  # balls of 3 and 5 cells


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [1.0, 2.0])
def test_what_a_collision_loses_is_of_first_order_in_the_cell(ratio, record_property):
    """Restitution of 1 is the limit: balls of 10 cells lose less than 0.6 of what those of 5 cells do."""
    lost = []
    for cells in (24, 48):
        scene = balls(cells=cells, ratio=ratio)
        sim, steps = simulator(scene, torch.float32), round(0.15 / scene.dt)
        with torch.no_grad():
            frames = sim.rollout(steps, every=steps)
        left, right = (velocity(sim, frames, body)[:, 0] for body in (0, 1))
        lost.append(1 - float(right[-1] - left[-1]) / float(left[0] - right[0]))
        case = f"masses 1 : {ratio:g}, balls of {round(0.2 * cells)} cells across"
        note(record_property, "restitution of elastic balls [-]", case, 1 - lost[-1], 1.0)
        for name, speed, other in (
            ("left", left[-1], sim.mass[frames.body == 1].sum()),
            ("right", right[-1], -sim.mass[frames.body == 0].sum()),
        ):
            middle = float(momentum(sim, frames)[0, 0] / sim.mass.sum())
            exact = middle - float(other / sim.mass.sum())
            note(record_property, f"velocity after an elastic collision, {name} ball [m/s]", case, speed, exact)
    assert 0 < lost[1] < 0.6 * lost[0]
    assert lost[1] < 0.08


def block_on_slope(angle, friction):
    """A block on a slab that is turned by `angle`; the lower part of the slab is clamped."""
    cells, centre = 20, torch.tensor([0.5, 0.4, 0.2], dtype=torch.float64)
    c, s = math.cos(angle), math.sin(angle)
    R = torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)

    def turned(x):
        return (x.double() - centre) @ R.T + centre

    slab = shapes.box(lower=(0.2, 0.25, 0.05), upper=(0.9, 0.4, 0.5), spacing=0.025)
    block = shapes.box(lower=(0.5, 0.4, 0.2), upper=(0.65, 0.5, 0.35), spacing=0.025)
    middles = turned(torch.tensor([[0.25 + 0.1 * i, 0.265, 0.275] for i in range(7)]))
    clamps = [Box((x - 0.05, y - 0.015, 0.04), (x + 0.05, y + 0.015, 0.51)) for x, y, _ in middles.tolist()]
    bodies = [
        Body(shape=body, x=turned(body.x), name=name, law=FixedCorotated(2e5, POISSON))
        for body, name in ((slab, "slope"), (block, "block"))
    ]
    dt = 0.5 / cells / (math.sqrt(2) * WAVE)
    return Scene(upper=(1.0, 1.0, 0.55), cells=cells, dt=dt, gravity=(0.0, -10.0, 0.0), clamps=tuple(clamps), walls=None, bodies=bodies,
                 body_friction=friction)  # fmt: skip


@pytest.mark.slow  # three runs of two seconds
@pytest.mark.parametrize("friction", [0.0, 0.2, 0.5])
def test_block_slides_on_a_slope_by_coulombs_law(friction, record_property):
    """a = g (sin a - mu cos a), and rest for mu > tan a."""
    angle = math.radians(20.0)
    scene = block_on_slope(angle, friction)
    sim = simulator(scene, torch.float32)
    steps = round(0.3 / scene.dt) // 30 * 30
    with torch.no_grad():
        frames = sim.rollout(steps, every=steps // 30)
    down = velocity(sim, frames, 1) @ torch.tensor([-math.cos(angle), -math.sin(angle), 0.0])
    found = float((down[-1] - down[10]) / (frames.times[-1] - frames.times[10]))
    exact = 10.0 * (math.sin(angle) - friction * math.cos(angle))
    if exact > 0:
        what = "acceleration of a block on the slope of another body, 20 degrees [m/s^2]"
        note(record_property, what, f"friction {friction:g}", found, exact)
        assert found == pytest.approx(exact, rel=0.05)
    else:
        what = "speed of a block that sticks on the slope of another body, 20 degrees [m/s]"
        note(record_property, what, f"friction {friction:g}", down[-1], 0.0)
        assert abs(float(down[-1])) < 0.02


@pytest.mark.slow  # half a minute
def test_balls_that_are_pressed_together_approach_hertz(record_property):
    """The largest force of a slow collision: Hertz for elastic spheres."""
    radius, speed, errors = 0.2, 0.25, []
    stiff, reduced, mass = YOUNG / (1 - POISSON**2) / 2, radius / 2, 0.5 * RHO * 4 / 3 * math.pi * radius**3
    depth = (15 * mass * (2 * speed) ** 2 / (16 * math.sqrt(reduced) * stiff)) ** 0.4
    hertz = 4 / 3 * stiff * math.sqrt(reduced) * depth**1.5
    forces = []
    for cells in (20, 30):
        ball = {"radius": radius, "spacing": 0.5 / cells}
        law = FixedCorotated(YOUNG, POISSON)
        bodies = [Body(shape=shapes.ball(centre=(0.5, 0.5 - side * radius, 0.5), **ball), velocity=(0.0, side * speed, 0.0), law=law)
                  for side in (1, -1)]  # fmt: skip
        scene = Scene(cells=cells, dt=0.5 / cells / WAVE, gravity=(0.0, 0.0, 0.0), walls=None, bodies=bodies)
        sim = simulator(scene, torch.float32)
        with torch.no_grad():
            frames = sim.rollout(round(0.14 / scene.dt))
        v = velocity(sim, frames, 0)[:, 1]
        own = float(sim.mass[frames.body == 0].sum())
        force = -(v[1:] - v[:-1]) * own / scene.dt
        forces.append(float(torch.nn.functional.avg_pool1d(force[None, None], 9, 1, 4).max()))
        errors.append(abs(forces[-1] / hertz - 1))
        note(record_property, "largest force of two balls [N]", f"{round(radius * cells * 2)} cells across", forces[-1], hertz)
    assert max(errors) < 0.1  # balls of 8 and 12 cells across


def stack(friction=0.3, third=False, contact="separate", **options):
    """A low block, one that slides on it, and optionally one that runs into both."""
    box = {"spacing": 0.05, "jitter": 0.2}
    low = shapes.box(lower=(0.3, 0.3, 0.3), upper=(0.6, 0.45, 0.6), **box)
    top = shapes.box(lower=(0.35, 0.45, 0.35), upper=(0.55, 0.6, 0.55), seed=1, **box)
    side = shapes.box(lower=(0.55, 0.4, 0.35), upper=(0.7, 0.6, 0.55), seed=3, **box)
    bodies = [
        Body(shape=low, name="low", law=FixedCorotated(1e4, 0.3), velocity=(0.0, 0.1, 0.0)),
        Body(shape=top, name="top", law=NeoHookean(2e4, 0.2), density=2000.0, velocity=(1.0, -0.5, 0.3), spin=(0.0, 0.0, 2.0)),
        Body(shape=side, name="side", law=Sigma(3e4, 0.2), density=500.0, velocity=(-1.0, 0.0, 0.0)),
    ][: 3 if third else 2]
    return Scene(cells=12, dt=1e-3, bodies=bodies, body_friction=friction, contact=contact, **options)


@pytest.mark.parametrize("contact", ["separate", "sticky"])
@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_momentum_is_kept_to_rounding(contact, friction, record_property):
    sim = simulator(stack(friction, True, contact, gravity=(0.0, 0.0, 0.0), walls=None))
    with torch.no_grad():
        frames = sim.rollout(60, every=20)
    total = momentum(sim, frames)
    drift = (total - total[0]).abs().max()
    note(record_property, "momentum of three rubbing bodies [kg m/s]", f"{contact}, friction {friction:g}", drift, 0.0)
    assert drift < 1e-12
    assert (velocity(sim, frames, 1)[-1] - velocity(sim, frames, 1)[0]).norm() > 0.1


@pytest.mark.parametrize("third", [False, True])
@pytest.mark.parametrize("friction", [0.0, 0.3, 5.0])
def test_gradients_equal_finite_differences(friction, third, record_property):
    """Positions, velocities, masses (densities) and friction; without friction from above, where the sliding branch begins."""
    sim = simulator(stack(friction, third))
    generator = torch.Generator().manual_seed(0)
    weight = torch.randn(len(sim.mass), 3, dtype=torch.float64, generator=generator)

    def loss(x, v, mass, own_friction):
        frames = sim.rollout(12, state=sim.state._replace(x=x, v=v), mass=mass, body_friction=own_friction, every=12)
        return 10 * (weight * frames.x[-1]).sum() + frames.F[-1].square().sum()

    given = [sim.state.x, sim.state.v, sim.mass, torch.full((1,), friction, dtype=torch.float64)]
    given = [t.clone().requires_grad_() for t in given]
    gradients = torch.autograd.grad(loss(*given), given)
    with torch.no_grad():
        for i, (t, gradient) in enumerate(zip(given, gradients)):
            along = (
                torch.ones_like(t)
                if i == 3
                else torch.randn(t.shape, dtype=t.dtype, generator=generator) * (sim.mass.mean() if i == 2 else 1)
            )
            step = 1e-7

            def at(size, i=i, along=along):
                return loss(*(a + (size * along if j == i else 0.0) for j, a in enumerate(given)))

            low = 0.0 if i == 3 and friction == 0.0 else -step
            difference = (at(step) - at(low)) / (step - low)
            name = ("positions", "velocities", "masses", "friction of bodies")[i]
            case = f"{3 if third else 2} bodies, friction {friction:g}"
            note(record_property, f"derivative along {name}", case, (gradient * along).sum(), difference)
            assert float((gradient * along).sum()) == pytest.approx(float(difference), rel=1e-4, abs=1e-6)


def test_gradient_of_a_modulus_field_equals_finite_differences(record_property):
    scene = stack()
    count = len(scene.bodies[1].x)
    young = torch.linspace(1e4, 3e4, count, dtype=torch.float64, requires_grad=True)

    def loss(values):
        bodies = [scene.bodies[0], Body(shape=scene.bodies[1], law=FixedCorotated(values, 0.2))]
        sim = simulator(Scene(cells=12, dt=1e-3, bodies=bodies, body_friction=0.3))
        return sim.rollout(12, every=12).x[-1, -count:, 1].square().sum()

    (gradient,) = torch.autograd.grad(loss(young), young)
    along = torch.cos(torch.arange(count, dtype=torch.float64))
    with torch.no_grad():
        difference = (loss(young + along) - loss(young - along)) / 2
    note(record_property, "derivative along a field of moduli", "2 bodies", (gradient * along).sum(), difference)
    assert float((gradient * along).sum()) == pytest.approx(float(difference), rel=1e-5)


@pytest.mark.parametrize("third", [False, True])
def test_rollout_equals_its_slow_twin(third):
    sim = simulator(stack(third=third))
    with torch.no_grad():
        fast = sim.rollout(10, every=10)
        slow = reference.rollout(sim, 10, *sim.own_laws, every=10)
    for a, b in zip(fast, slow):
        assert torch.allclose(a, b, rtol=1e-9, atol=1e-10)


def test_several_scenes_share_a_launch():
    scenes = [stack(0.3), stack(0.1, True)]
    with torch.no_grad():
        together = simulator(scenes).rollout(20, every=20)
        alone = [simulator(scene).rollout(20, every=20) for scene in scenes]
    assert torch.allclose(together.x[-1], torch.cat([frames.x[-1] for frames in alone]), atol=1e-12)
    assert together.body_names == ("low", "top", "low", "top", "side")
    assert together.body.unique().tolist() == [0, 1, 2, 3, 4]


def test_window_segments_and_tapes_do_not_change_contact():
    scene = stack(0.3, True)

    def gradient(segment=None, **options):
        sim = Simulator(scene, device="cpu", dtype=torch.float64, **options)
        x = sim.state.x.clone().requires_grad_()
        frames = sim.rollout(10, state=sim.state._replace(x=x), every=5, segment=segment)
        return frames.x[-1].detach(), torch.autograd.grad(frames.x[-1].square().sum(), x)[0]

    plain = gradient()
    for other in (gradient(segment=5), gradient(store="all"), gradient(grid="window")):
        assert all(torch.allclose(a, b, rtol=1e-9, atol=1e-12) for a, b in zip(plain, other))


def test_solid_collider_takes_what_the_bodies_lose():
    ball = Sphere(0.1, position=(0.45, 0.62, 0.45), velocity=(0.0, -1.0, 0.0))
    sim = simulator(stack(0.3, True, gravity=(0.0, 0.0, 0.0), walls=None, colliders=(ball,)))
    with torch.no_grad():
        frames = sim.rollout(12, every=12)
    total = momentum(sim, frames)
    assert torch.allclose(12e-3 * frames.forces[-1, 0], total[0] - total[-1], atol=1e-10)
    assert frames.forces[-1, 0, 1] > 100.0


def test_friction_of_pairs_is_that_of_their_names():
    by_pair = stack(third=True)
    named = Scene(**{**vars(by_pair), "body_friction": [("top", "low", 0.3), ("low", "side", 0.3), ("side", "top", 0.3)]})
    with torch.no_grad():
        assert torch.equal(simulator(named).rollout(10, every=10).x, simulator(by_pair).rollout(10, every=10).x)


def test_body_rests_on_another_on_the_floor():
    """The weight of both goes to the floor, and neither sinks in."""
    box = {"spacing": 0.05}
    bodies = [
        Body(shape=shapes.box(lower=(0.3, 0.1, 0.3), upper=(0.7, 0.3, 0.7), **box), law=FixedCorotated(2e5, 0.3)),
        Body(shape=shapes.box(lower=(0.4, 0.3, 0.4), upper=(0.6, 0.5, 0.6), **box), law=FixedCorotated(2e5, 0.3)),
    ]
    scene = Scene(cells=10, dt=2e-3, bodies=bodies, colliders=(Plane((0.0, 0.1, 0.0), (0.0, 1.0, 0.0)),))
    sim = simulator(scene)
    with torch.no_grad():
        frames = sim.rollout(300, every=300)
    fall = (frames.x[-1] - frames.x[0])[:, 1]
    assert fall.abs().max() < 0.1 * scene.dx
    assert frames.v[-1].abs().max() < 0.02


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"contact": "glue"}, "contact is 'glue'"),
        ({"friction": -1.0}, "body_friction of scene 0 is -1.0"),
        ({"friction": [("low", "lid", 0.1)]}, "names the body 'lid'; there are low, top"),
    ],
)
def test_impossible_contact_is_refused(options, match):
    with pytest.raises(UserError, match=match):
        simulator(stack(**options))


def test_impossible_friction_of_a_rollout_is_refused():
    sim = simulator(stack())
    with pytest.raises(UserError, match="body_friction has shape"):
        sim.rollout(1, body_friction=torch.zeros(3))
    with pytest.raises(UserError, match="body_friction is -1"):
        sim.rollout(1, body_friction=-1.0)
