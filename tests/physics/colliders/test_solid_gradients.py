"""Gradients of rollouts with solid colliders against finite differences in float64."""

import pytest
import torch

from neuido.physics.colliders import Capsule, Cuboid, Cylinder, HalfSpace, HeightField, MeshCollider, SolidInputs, Sphere
from neuido.physics.laws.classical import FixedCorotated
from neuido.physics.mpm.simulator import Simulator
from neuido.types import Keyframes, Plane, Scene, Walls
from tests.physics.balances import note
from tests.physics.bodies import DEVICE, cloud

TURN = (0.9, 0.2, -0.3, 0.1)
ICOSAHEDRON = (
    [(0, s * 0.1, t * 0.1618) for s in (1, -1) for t in (1, -1)]
    + [(s * 0.1, t * 0.1618, 0) for s in (1, -1) for t in (1, -1)]
    + [(t * 0.1618, 0, s * 0.1) for s in (1, -1) for t in (1, -1)]
)


def icosahedron() -> tuple[list, list]:
    """Return vertices and outward faces: all triples of vertices at the least distance."""
    x = torch.tensor(ICOSAHEDRON, dtype=torch.float64)
    near = (torch.cdist(x, x) - 0.2).abs() < 1e-3
    faces = [(i, j, k) for i in range(12) for j in range(i) for k in range(j) if near[i, j] and near[j, k] and near[i, k]]
    out = []
    for i, j, k in faces:
        outward = float(torch.linalg.cross(x[j] - x[i], x[k] - x[i]) @ x[i]) > 0
        out.append((i, j, k) if outward else (i, k, j))
    return x.tolist(), out


def solids() -> list[tuple]:
    """The solids of two scenes: every kind, every contact, every motion."""
    vertices, faces = icosahedron()
    ground = 0.03 * torch.randn(4, 5, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    path = Keyframes((0.0, 0.003, 0.02), ((0.3, 0.1, 0.25), (0.301, 0.102, 0.25), (0.31, 0.09, 0.26)), (TURN, TURN, (1, 0.1, 0, 0)))
    tilted = {"position": (0.1, 0.12, 0.1), "rotation": (1.0, 0.05, 0.1, 0.1)}
    hill = {"position": (0.5, 0.05, 0.45), "rotation": (1, 0.02, 0, 0.03), "spin": (0.1, 0.2, 0)}
    thrown = {"position": (0.43, 0.33, 0.23), "velocity": (0.1, -0.5, 0.2), "spin": (2.0, 0.0, 1.0)}
    landing = {"position": (0.5, 0.07, 0.5), "rotation": TURN, "velocity": (0.5, -1.0, 0.2), "spin": (1.0, 2.0, 0.5)}
    flying = {"position": (0.15, 0.4, 0.2), "velocity": (0.3, -0.4, 0.1), "spin": (3.0, 1.0, -2.0)}
    return [
        (
            Cuboid((0.3, 0.2, 0.25), friction=0.3, path=path),
            Sphere(0.15, mass=20.0, friction=0.2, **flying),
            HalfSpace(contact="slip", velocity=(0.2, 0.1, 0.0), spin=(0.5, 0, 1), **tilted),
            Cuboid((0.3, 0.15, 0.2), mass=30.0, **landing),
        ),
        (
            Cylinder(0.2, 0.16, position=(0.2, 0.1, 0.2), rotation=TURN, friction=0.4, spin=(0.0, 2.0, 0.0)),
            Capsule(0.12, 0.25, position=(0.5, 0.4, 0.4), rotation=TURN, contact="sticky", velocity=(-0.2, 0.1, 0.3)),
            HeightField(ground + 0.08, (0.9, 0.9), friction=0.1, **hill),
            MeshCollider(vertices, faces, mass=15.0, friction=0.3, **thrown),
        ),
    ]


def leaf(value) -> torch.Tensor:
    return torch.as_tensor(value, dtype=torch.float64).clone().to(DEVICE).requires_grad_()


class Problem:
    """Two scenes of a few particles among solids, with every differentiable input as a leaf."""

    NAMES = ("pose", "velocity", "twist", "friction", "mass", "inertia", "x", "v", "F", "body mass", "gravity", "plane friction", "young")

    def __init__(self, store: str = "auto") -> None:
        floor = Plane((0.0, 0.05, 0.0), (0.1, 1.0, 0.2), "separate", 0.3)
        first, second = solids()
        scenes = [
            Scene(cells=8, dt=2e-3, colliders=(floor, *first), walls=None),
            Scene(upper=(1.0, 0.9, 0.8), cells=8, dt=1e-3, colliders=second, walls=Walls("separate", 0.2)),
        ]
        bodies = [cloud(24, 0.1, 0.45, (0.0, -2.0, 1.0), 0), cloud(32, 0.05, 0.6, (0.3, -1.0, 0.0), 1)]
        self.sim = Simulator(scenes, bodies, dtype=torch.float64, device=DEVICE, store=store)
        self.solids = SolidInputs(*(leaf(t) for t in self.sim.solid_inputs(6)))
        g = torch.Generator().manual_seed(3)
        F = self.sim.state.F + 0.05 * torch.randn(self.sim.state.F.shape, generator=g, dtype=torch.float64).to(DEVICE)
        self.state = self.sim.state._replace(x=leaf(self.sim.state.x), v=leaf(self.sim.state.v), F=leaf(F))
        self.mass, self.gravity, self.friction = (leaf(t) for t in (self.sim.mass, self.sim.gravity, self.sim.colliders.friction))
        self.young = leaf(5e4)

    def leaves(self) -> list[torch.Tensor]:
        state = self.state
        return [*self.solids, state.x, state.v, state.F, self.mass, self.gravity, self.friction, self.young]

    def loss(self, **options) -> torch.Tensor:
        law = FixedCorotated(self.young, 0.3)
        own = {"state": self.state, "mass": self.mass, "gravity": self.gravity, "friction": self.friction, "solids": self.solids}
        frames = self.sim.rollout(6, law, every=2, **own, **options)
        poses = torch.cat([c.poses for c in frames.colliders if c.force is not None])
        twists = torch.cat([c.velocity for c in frames.colliders if c.force is not None])
        total = 0.0
        for i, t in enumerate((*frames, 1e-4 * frames.forces, 1e-3 * frames.torques, poses, twists)):
            weights = torch.randn(t.shape, generator=torch.Generator().manual_seed(i), dtype=t.dtype)
            total = total + (t * weights.to(t.device)).sum()
        return total


@pytest.mark.slow
def test_gradients_equal_finite_differences(record_property):
    p = Problem()
    gradients = torch.autograd.grad(p.loss(), p.leaves())
    for name, t, gradient in zip(p.NAMES, p.leaves(), gradients, strict=True):
        direction = torch.randn(t.shape, generator=torch.Generator().manual_seed(9), dtype=t.dtype).to(t.device)
        if name == "mass":
            direction = direction * (t > 0)
        if name == "inertia":
            direction = (direction + direction.mT) * t.detach().diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None] * (t[..., :1, :1] < 1)
        # the loss is smooth but for kinks at cell faces, edges of solids and branches of friction: a short step stays on its piece
        # gravity moves a loss of thousands by a hundredth, so that a shorter step would be rounding
        h = (1e-5 if name == "gravity" else 1e-6) * float(t.detach()[direction != 0].norm() / direction.norm())
        with torch.no_grad():
            values = []
            for shift in (-2, -1, 1, 2):
                t.add_(shift * h * direction)
                values.append(float(p.loss()))
                t.sub_(shift * h * direction)
        numeric = (8 * (values[2] - values[1]) - (values[3] - values[0])) / (12 * h)
        analytic = float((gradient * direction).sum())
        note(record_property, f"derivative along {name}", "solids of every kind and motion, two scenes", analytic, numeric)
        assert float(gradient.norm()) > 0, name
        assert abs(numeric - analytic) <= 2e-6 * max(abs(analytic), 1e-2 * float(gradient.norm() * direction.norm())), (
            f"{name}: {numeric:.9g} by differences, {analytic:.9g}"
        )


@pytest.mark.parametrize("options", [{"segment": 2}, {"store": "state"}, {"store": "all"}])
def test_checkpointing_and_the_tape_change_nothing(options):
    whole = Problem()
    expected = torch.autograd.grad(whole.loss(), whole.leaves())
    other = Problem(options.pop("store", "auto"))
    found = torch.autograd.grad(other.loss(**options), other.leaves())
    for name, a, b in zip(Problem.NAMES, found, expected, strict=True):
        assert float((a - b).norm()) <= 1e-11 * float(b.norm()), name
