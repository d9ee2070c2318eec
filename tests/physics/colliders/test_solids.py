"""Solid colliders against weights, the friction cone, conservation laws and each other, in float64."""

import math

import numpy as np
import pytest
import torch

from neuido.errors import UserError
from neuido.physics.colliders import Capsule, Cuboid, Cylinder, HalfSpace, HeightField, MeshCollider, Sphere
from neuido.physics.effects.parameters import Effects
from neuido.physics.laws.classical import FixedCorotated
from neuido.physics.mpm.simulator import Simulator
from neuido.types import Body, Keyframes, Plane, Scene
from tests.physics.balances import note
from tests.physics.bodies import DEVICE, block, same
from tests.physics.colliders.test_solid_gradients import icosahedron

LAW = FixedCorotated(5e4, 0.3)
G = 9.8
CORNERS = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]


def run(scene: Scene, body: Body, steps: int, every: int, law=LAW, **options):
    sim = Simulator(scene, body, dtype=torch.float64, device=DEVICE)
    with torch.no_grad():
        return sim, sim.rollout(steps, law, every=every, **options)


def supports() -> dict:
    """One of each kind of solid, with its top near y = 0.3."""
    vertices, faces = icosahedron()
    wave = 0.02 * np.cos(np.linspace(0, 2 * math.pi, 9))[:, None] * np.ones((9, 9))
    return {
        "half-space": HalfSpace(position=(0.0, 0.3, 0.0)),
        "sphere": Sphere(0.25, position=(0.5, 0.1, 0.5)),
        "cuboid": Cuboid((0.8, 0.2, 0.8), position=(0.5, 0.2, 0.5)),
        "capsule": Capsule(0.2, 0.4, position=(0.5, 0.15, 0.5), rotation=(1.0, 1.0, 0.0, 0.0)),
        "cylinder": Cylinder(0.4, 0.2, position=(0.5, 0.2, 0.5)),
        "height field": HeightField(wave, (1.0, 1.0), position=(0.5, 0.3, 0.5)),
        "mesh": MeshCollider(2 * np.array(vertices), faces, position=(0.5, 0.03, 0.5), friction=1.0),
    }


@pytest.mark.parametrize("kind", supports())
def test_the_force_of_a_body_at_rest_is_its_weight(kind, record_property):
    body = block((0.35, 0.36, 0.35), (0.65, 0.51, 0.65), (6, 3, 6))
    scene = Scene(cells=12, dt=2e-3, walls=None, colliders=(supports()[kind],))
    sim, frames = run(scene, body, 600, 200, effects=Effects(viscosity_shear=100.0, viscosity_bulk=100.0))
    weight = float(sim.mass.sum()) * G
    force = frames.forces[-1, 0]
    note(record_property, "force of a body at rest [N]", kind, -force[1], weight)
    assert abs(float(force[1]) + weight) < 0.01 * weight
    assert float(force[[0, 2]].norm()) < 0.01 * weight
    arm = (sim.mass[:, None] * frames.x[-1]).sum(0) / sim.mass.sum() - frames.colliders[0].poses[-1, :3, 3]
    expected = torch.linalg.cross(arm, torch.tensor([0.0, -weight, 0.0], dtype=torch.float64).to(arm))
    off = float((frames.torques[-1, 0] - expected).norm())
    note(record_property, "torque of a body at rest, minus arm times weight, over weight times 0.3 m [-]", kind, off / (0.3 * weight), 0.0)
    assert off < 0.01 * weight * 0.3


@pytest.mark.parametrize(("friction", "slides"), [(0.2, True), (0.6, False)])
def test_a_block_on_a_tilted_cuboid_obeys_the_friction_cone(friction, slides, record_property):
    angle = math.radians(20)
    turn = (math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2))
    up = torch.tensor([-math.sin(angle), math.cos(angle), 0.0], dtype=torch.float64)
    down = torch.tensor([-math.cos(angle), -math.sin(angle), 0.0], dtype=torch.float64)
    flat = block((-0.12, 0.0, -0.12), (0.12, 0.08, 0.12), (6, 2, 6))
    axes = torch.stack([-down, up, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)])
    x = flat.x.cpu() @ axes + torch.tensor([0.6, 0.35, 0.5]) + 0.1 * up
    slope = Cuboid((0.95, 0.2, 0.9), position=(0.6, 0.35, 0.5), rotation=turn, friction=friction)
    scene = Scene(cells=20, dt=1e-3, walls=None, colliders=(slope,))
    options = {"effects": Effects(viscosity_shear=50.0), "law": FixedCorotated(2e5, 0.3)}
    sim, frames = run(scene, Body(x, torch.zeros_like(x), flat.volume), 320, 80, **options)
    speed = frames.v.cpu().mean(1) @ down
    if slides:
        expected = G * (math.sin(angle) - friction * math.cos(angle))
        what = "acceleration of a block on a tilted cuboid, 20 degrees [m/s^2]"
        note(record_property, what, f"friction {friction:g}", float(speed[-1] - speed[-2]) / 0.08, expected)
        assert abs(float(speed[-1] - speed[-2]) / 0.08 - expected) < 0.02 * expected
        pressed, dragged = frames.forces[-1, 0].cpu() @ up, frames.forces[-1, 0].cpu() @ down
        note(record_property, "friction cone: drag over pressure [-]", f"friction {friction:g}", -dragged / pressed, friction)
        assert abs(float(dragged / pressed) + friction) < 0.01 * friction
    else:
        note(record_property, "speed of a block that sticks on a tilted cuboid [m/s]", f"friction {friction:g}", speed[-1], 0.0)
        assert abs(float(speed[-1])) < 0.02 * G * math.sin(angle) * 0.32


def moments(sim, frames, k: int):
    """Return momentum and angular momentum about the origin of the particles in frame k."""
    m, x, v, C = sim.mass[:, None], frames.x[k], frames.v[k], frames.C[k]
    inner = m[..., None] * C * sim.dx**2 / 4
    axial = torch.stack([inner[:, 2, 1] - inner[:, 1, 2], inner[:, 0, 2] - inner[:, 2, 0], inner[:, 1, 0] - inner[:, 0, 1]], dim=1)
    return (m * v).sum(0), (torch.linalg.cross(x, m * v) + axial).sum(0)


def test_an_off_centre_hit_of_a_free_ball_keeps_momentum_and_angular_momentum(record_property):
    body = block((0.2, 0.1, 0.2), (0.8, 0.35, 0.8), (8, 4, 8))
    ball = Sphere(0.12, position=(0.6, 0.5, 0.45), velocity=(0.4, -1.0, 0.0), spin=(0.0, 0.0, 3.0), mass=3.0, friction=0.3)
    sim, frames = run(Scene(cells=12, dt=2e-3, walls=None, gravity=(0.0, 0.0, 0.0), colliders=(ball,)), body, 90, 30)
    (found,) = frames.colliders
    total = []
    for k in range(4):
        p, L = moments(sim, frames, k)
        inertia, place, v, w = 0.4 * 3.0 * 0.12**2, found.poses[k, :3, 3], found.velocity[k, :3], found.velocity[k, 3:]
        total.append(torch.cat([p + 3.0 * v, L + torch.linalg.cross(place, 3.0 * v) + inertia * w]))
    assert float(found.velocity[-1, 1]) > 0.05  # it bounced
    assert abs(float(found.velocity[-1, 5]) - 3.0) > 0.1  # friction turned it
    drift = (torch.stack(total) - total[0]).abs().amax(0)
    for name, unit, part in (("momentum", "kg m/s", drift[:3]), ("angular momentum", "kg m^2/s", drift[3:])):
        note(record_property, f"{name} of body and free ball [{unit}]", "off-centre hit with friction", part.max(), 0.0)
    for row in total[1:]:
        assert float((row - total[0]).abs().max()) < 1e-13
    assert torch.allclose(frames.forces.sum(0)[0] * 0.06, 3.0 * (found.velocity[-1, :3] - found.velocity[0, :3]), atol=1e-12)


def test_a_free_box_comes_to_rest_on_a_plane_and_one_in_the_air_falls_freely_and_spins():
    floor = Plane((0.0, 0.1, 0.0), (0.0, 1.0, 0.0), friction=0.5)
    landing = Cuboid((0.3, 0.2, 0.25), position=(0.4, 0.3, 0.5), rotation=(1.0, 0.1, 0.0, 0.15), velocity=(0.3, 0.0, 0.0), mass=2.0)
    thrown = Cuboid((0.1, 0.2, 0.3), position=(0.5, 5.0, 0.5), spin=(0.1, 9.0, 0.2), velocity=(1.0, 0.0, 0.0), mass=0.5)
    body = block((0.85, 0.85, 0.85), (0.95, 0.95, 0.95), (2, 2, 2))
    scene = Scene(cells=10, dt=1e-3, walls=None, gravity=(0.0, -G, 0.0), colliders=(floor, landing, thrown))
    _, frames = run(scene, body, 300, 100)
    _, resting, flying = frames.colliders
    assert float(flying.poses[-1, 1, 3]) == pytest.approx(5.0 - G * 1e-6 * 300 * 301 / 2, abs=1e-9)
    inertia = torch.diag(torch.tensor([0.2**2 + 0.3**2, 0.1**2 + 0.3**2, 0.1**2 + 0.2**2], dtype=torch.float64) * 0.5 / 12).to(DEVICE)
    momentum = [pose[:3, :3] @ inertia @ pose[:3, :3].T @ w for pose, w in zip(flying.poses, flying.velocity[:, 3:])]
    assert float((momentum[-1] - momentum[0]).norm()) < 1e-12
    body = block((0.85, 0.35, 0.85), (0.95, 0.45, 0.95), (2, 2, 2))
    _, frames = run(scene.__class__(**{**scene.__dict__, "dt": 2e-3, "colliders": (floor, landing)}), body, 800, 400)
    rest = frames.colliders[1]
    assert float(rest.velocity[-1].norm()) < 1e-2
    assert abs(float(rest.poses[-1, 1, 3]) - 0.2) < 5e-3
    assert float(rest.poses[-1, 1, 1]) > 0.999


AWAY = block((0.85, 0.85, 0.05), (0.95, 0.95, 0.15), (2, 2, 2))
"""A body that touches no solid."""


@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0])
def test_free_spheres_collide_head_on_by_the_closed_form(restitution, record_property):
    """v' = (p ± e m' v_rel) / M. Momentum, and an off-centre pair's angular momentum, are exact.

    A critically damped spring that never pulls lets go at v = -exp(-2) v_0, which is what no restitution comes to.
    """
    e = restitution or math.exp(-2)
    for offset in (0.0, 0.03):
        balls = (Sphere(0.1, position=(0.3, 0.5, 0.5), velocity=(1.0, 0.0, 0.0), mass=2.0, friction=0.3, restitution=restitution),
                 Sphere(0.08, position=(0.6, 0.5 + offset, 0.5), velocity=(-0.5, 0.0, 0.0), mass=1.0))  # fmt: skip
        _, frames = run(Scene(cells=10, dt=1e-4, walls=None, gravity=(0.0,) * 3, colliders=balls), AWAY, 2000, 1000)
        p, L = [], []
        for k in (0, -1):
            parts = [
                (ball.mass, 0.4 * ball.mass * ball.radius**2, f.poses[k, :3, 3], f.velocity[k]) for ball, f in zip(balls, frames.colliders)
            ]
            p.append(sum(m * u[:3] for m, _, _, u in parts))
            L.append(sum(torch.linalg.cross(x, m * u[:3]) + i * u[3:] for m, i, x, u in parts))
        assert float((p[1] - p[0]).norm()) < 1e-13 and float((L[1] - L[0]).norm()) < 1e-13
        speeds = [float(f.velocity[-1, 0]) for f in frames.colliders]
        if offset == 0.0:
            for ball, exact in ((0, (1.5 - e * 1.5) / 3), (1, (1.5 + e * 3.0) / 3)):
                note(
                    record_property,
                    f"velocity of free sphere {ball + 1} after a collision [m/s]",
                    f"restitution {restitution:g}",
                    speeds[ball],
                    exact,
                )
            assert speeds[0] == pytest.approx((1.5 - e * 1.0 * 1.5) / 3, abs=0.03)
            assert speeds[1] == pytest.approx((1.5 + e * 2.0 * 1.5) / 3, abs=0.06)
        else:
            assert abs(float(frames.colliders[1].velocity[-1, 5])) > 0.1  # friction turned it


def test_two_boxes_rest_in_a_stack_on_a_third():
    """One free box lies on a box at rest, and another one on it; they stay where the closed form has them."""
    table = Cuboid((0.5, 0.2, 0.5), position=(0.4, 0.2, 0.5), friction=0.5)
    low = Cuboid((0.2, 0.1, 0.2), position=(0.4, 0.355, 0.5), mass=2.0, friction=0.5)
    top = Cuboid((0.15, 0.1, 0.15), position=(0.41, 0.465, 0.5), rotation=(0.998, 0.0, 0.06, 0.0), mass=1.0)
    body = block((0.75, 0.11, 0.05), (0.95, 0.21, 0.15), (2, 2, 2))
    floor = Plane((0.0, 0.1, 0.0), (0.0, 1.0, 0.0))
    _, frames = run(Scene(cells=10, dt=5e-4, walls=None, gravity=(0.0, -G, 0.0), colliders=(floor, table, low, top)), body, 1000, 500)
    for found, height, x in zip(frames.colliders[2:], (0.35, 0.45), (0.4, 0.41)):
        assert float(found.velocity[-1].norm()) < 1e-3
        assert float(found.poses[-1, 1, 3]) == pytest.approx(height, abs=1e-3)
        assert float(found.poses[-1, 0, 3]) == pytest.approx(x, abs=2e-3)
        assert float(found.poses[-1, 1, 1]) > 0.9999


def test_a_moving_plate_carries_a_body_at_its_own_speed():
    plate = Cuboid((0.6, 0.2, 0.6), position=(0.35, 0.2, 0.5), friction=1.0, velocity=(0.4, 0.0, 0.0))
    body = block((0.25, 0.34, 0.4), (0.45, 0.46, 0.6), (4, 3, 4))
    _, frames = run(Scene(cells=12, dt=2e-3, walls=None, colliders=(plate,)), body, 400, 100)
    assert abs(float(frames.v[-1, :, 0].mean()) - 0.4) < 0.004
    assert float(frames.colliders[0].poses[-1, 0, 3]) == pytest.approx(0.35 + 0.4 * 0.8, abs=1e-12)


def test_a_constant_path_is_a_collider_at_rest_and_a_straight_one_a_constant_velocity():
    body = block((0.3, 0.34, 0.3), (0.7, 0.46, 0.7), (4, 2, 4))
    turn = (0.9, 0.1, 0.2, -0.1)

    def motion(**options):
        scene = Scene(cells=10, dt=2e-3, walls=None, colliders=(Cuboid((0.6, 0.2, 0.6), rotation=turn, friction=0.4, **options),))
        return run(scene, body, 40, 20)[1]

    place = (0.5, 0.2, 0.5)
    still = motion(position=place)
    path = motion(path=Keyframes((0.0, 0.05), (place, place)))
    for a, b in zip((*still, still.forces), (*path, path.forces)):
        assert same(a, b)
    moving = motion(position=place, velocity=(0.2, 0.1, 0.0), spin=(0.0, 0.5, 0.0))
    half = 0.5 * 0.5 * 0.08
    first = torch.tensor(turn, dtype=torch.float64)
    first = (first / first.norm()).tolist()
    c, s = math.cos(half), math.sin(half)
    w, x, y, z = first
    last = (c * w - s * y, c * x + s * z, c * y + s * w, c * z - s * x)  # the turn about y after the first
    path = motion(path=Keyframes((0.0, 0.08), (place, (0.516, 0.208, 0.5)), (first, last)))
    for a, b in zip((*moving, moving.forces), (*path, path.forces)):
        assert torch.allclose(a, b, rtol=0, atol=1e-9 * float(b.abs().max()))


def test_planes_alone_keep_their_frames_and_have_no_forces():
    body = block((0.3, 0.15, 0.3), (0.7, 0.45, 0.7), (4, 3, 4))
    _, frames = run(Scene(cells=10, dt=2e-3, colliders=(Plane((0.0, 0.1, 0.0), (0.0, 2.0, 0.0)),)), body, 4, 2)
    assert frames.forces.shape == (3, 0, 3)
    (plane,) = frames.colliders
    assert plane.force is None and plane.poses.shape == (3, 4, 4)
    assert plane.poses[0, :3, 1].tolist() == [0.0, 1.0, 0.0]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Sphere(-0.1), "radius of a Sphere is -0.1"),
        (lambda: Sphere(0.1, contact="glue"), "contact of a Sphere is 'glue'"),
        (lambda: Sphere(0.1, friction=-1.0), "friction of a Sphere is -1.0"),
        (lambda: Sphere(0.1, restitution=2.0), "restitution of a Sphere is 2.0"),
        (lambda: Cuboid((0.1, 0.2, 0.3), rotation=(0.0, 0.0, 0.0, 0.0)), "rotation of a Cuboid"),
        (lambda: Cuboid((0.1, 0.2, 0.3), mass=1.0, path=Keyframes((0.0,), ((0.0, 0.0, 0.0),))), "has a path and a mass"),
        (lambda: HalfSpace(mass=1.0), "cannot move freely"),
        (lambda: Sphere("wide"), "radius of a Sphere must be numbers"),
        (lambda: Sphere(0.1, position=(1.0, 2.0)), r"position of a Sphere is \(1.0, 2.0\); give 3 numbers"),
        (lambda: Sphere(0.1, rotation=1.0), "rotation of a Sphere is 1.0; give 4 numbers"),
        (lambda: Sphere(0.1, velocity=(math.nan, 0.0, 0.0)), "velocity of a Sphere contains a NaN"),
        (lambda: Sphere(0.1, path=[(0.0, 0.0, 0.0)]), "path of a Sphere is a list; give neuido.Keyframes"),
        (lambda: Sphere(0.1, friction="rough"), "friction of a Sphere is 'rough'"),
        (lambda: Sphere(0.1, mass="heavy"), "mass of a Sphere must be numbers"),
        (lambda: Cuboid(0.1), "size of a Cuboid is 0.1; give 3 numbers"),
        (lambda: HeightField([[0.0, 0.0], [0.0, 0.0]], 1.0), "size of a HeightField is 1.0; give 2 numbers"),
        (lambda: HeightField([[0.0, 1.0]], (1.0, 1.0)), "at least 2 x 2"),
        (lambda: MeshCollider(CORNERS, [(0, 1, 2), (0, 1, 3), (0, 2, 3), (0, 1, 2)]), "not watertight"),
        (lambda: Sphere(0.1, inertia=((1, 0, 0), (0, 1, 0), (0, 0, 1))), "an inertia and no mass"),
    ],
)  # fmt: skip
def test_impossible_solids_are_one_line(make, message):
    with pytest.raises(UserError, match=message):
        make()


def test_impossible_scenes_are_one_line():
    body = block((0.3, 0.3, 0.3), (0.7, 0.7, 0.7), (2, 2, 2))
    with pytest.raises(UserError, match="less than a cell"):
        Simulator(Scene(cells=8, colliders=(Cuboid((0.5, 0.05, 0.5)),)), body, device="cpu")
    bent = Cuboid((0.5, 0.5, 0.5), path=Keyframes((0.0, 0.0), ((0.0, 0.0, 0.0),) * 2))
    with pytest.raises(UserError, match="must rise"):
        Simulator(Scene(cells=8, colliders=(bent,)), body, device="cpu").rollout(2, LAW)
    planes = Simulator(Scene(cells=8), body, device="cpu")
    with pytest.raises(UserError, match="no solid colliders"):
        planes.solid_inputs(2)
    ball = Simulator(Scene(cells=8, colliders=(Sphere(0.2),)), body, device="cpu")
    given = ball.solid_inputs(2)
    with pytest.raises(UserError, match=r"solids\.friction has shape \(2,\)"):
        ball.rollout(2, LAW, solids=given._replace(friction=torch.zeros(2)))
    with pytest.raises(UserError, match=r"solids\.mass frees a collider"):
        ball.rollout(2, LAW, solids=given._replace(mass=given.mass + 1.0))
