"""Flat specimens under prescribed boundary motion: closed forms, gradients, and a plate with a hole whose truth is known."""

import math

import numpy as np
import pytest
import torch

from neuido.errors import UserError
from neuido.physics.effects.parameters import Effects
from neuido.physics.laws.base import AutogradElastic
from neuido.physics.laws.classical import NeoHookean, Sigma
from neuido.physics.plane.plane_specimen import PlaneSpecimen
from neuido.physics.points.material_point import Specimen, stress_along

Law = AutogradElastic | NeoHookean | Sigma


def sheet(n: int = 3, condition: str = "strain", thickness: float = 0.1, bend: float = 0.05) -> PlaneSpecimen:
    """A unit square of 2 n^2 triangles, whose inner nodes are off the lattice."""
    grid = np.stack(np.meshgrid(*[np.linspace(0, 1, n + 1)] * 2, indexing="ij"), -1).reshape(-1, 2)
    inner = ((grid > 0) & (grid < 1)).all(1)
    grid[inner] += bend * np.random.default_rng(3).standard_normal((inner.sum(), 2))
    at = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    a, b, c, d = at[:-1, :-1].ravel(), at[1:, :-1].ravel(), at[1:, 1:].ravel(), at[:-1, 1:].ravel()
    return PlaneSpecimen(torch.from_numpy(grid), torch.from_numpy(np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])),
                         thickness, condition)  # fmt: skip


def pulled(own: PlaneSpecimen, stretches: list[float]) -> tuple[torch.Tensor, torch.Tensor]:
    """Left and right edge held along x, the lower left corner along y."""
    x = own.nodes
    fixed = torch.stack([(x[:, 0] == 0) | (x[:, 0] == 1), (x[:, 0] == 0) & (x[:, 1] == 0)], 1)
    motion = torch.stack([torch.stack([(s - 1) * x[:, 0], 0 * x[:, 1]], 1) for s in stretches])
    return fixed, motion


@pytest.mark.parametrize("law", [NeoHookean(2.7, 0.35), Sigma(2.7, 0.35)], ids=["neo_hookean", "sigma"])
def test_a_thin_strip_is_a_uniaxial_test(law):
    own = sheet(condition="stress")
    fixed, motion = pulled(own, [1.05, 1.4, 0.8])
    found = own.equilibrium(law, fixed, motion)
    right = own.nodes[:, 0] == 1
    force = found.force[:, right, 0].sum(1) / own.thickness
    wanted = stress_along(Specimen(law, None, Effects(), 1), "uniaxial", torch.tensor([[1.05], [1.4], [0.8]], dtype=torch.float64))
    torch.testing.assert_close(force, wanted[0, :, 0], atol=1e-9, rtol=1e-8)
    assert float(found.force[:, ~right & (own.nodes[:, 0] > 0)].abs().max()) == 0.0
    assert float(found.force.sum(1).abs().max()) < 1e-9


def test_back_at_rest_no_force_is_left():
    own = sheet()
    fixed, motion = pulled(own, [1.2, 1.0])
    found = own.equilibrium(NeoHookean(2.7e6, 0.35), fixed, motion)
    assert float(found.displacement[1].abs().max()) < 1e-12 and float(found.force[1].abs().max()) < 1e-9 * float(found.force[0].abs().max())


def test_a_thick_one_is_held_across():
    """Plane strain of a sheared neo-Hookean block: the same displacement at the edges gives a uniform one inside, tau_12 = mu gamma."""
    own = sheet()
    edge = ((own.nodes == 0) | (own.nodes == 1)).any(1)
    fixed = edge[:, None].expand(-1, 2).contiguous()
    motion = torch.stack([0.3 * own.nodes[:, 1], 0 * own.nodes[:, 0]], 1)[None]
    found = own.equilibrium(NeoHookean(2.6, 0.3), fixed, motion)
    torch.testing.assert_close(found.displacement, motion, atol=1e-12, rtol=0)
    top = own.nodes[:, 1] == 1
    middle = top & (own.nodes[:, 0] > 0) & (own.nodes[:, 0] < 1)  # two of three spacings
    assert float(found.force[0, middle, 0].sum()) == pytest.approx(0.1 * 2 / 3 * 1.0 * 0.3, rel=1e-9)


def decoupled(F: torch.Tensor, mu: torch.Tensor, kappa: torch.Tensor) -> torch.Tensor:
    J = torch.linalg.det(F)[:, None, None]
    b = J ** (-2 / 3) * F @ F.mT
    eye = torch.eye(3, dtype=F.dtype)
    return mu * (b - b.diagonal(dim1=1, dim2=2).sum(-1)[:, None, None] / 3 * eye) + kappa * J * (J - 1) * eye


@pytest.mark.parametrize("condition", ["strain", "stress"])
def test_gradients_are_those_of_finite_differences(condition):
    own = sheet(2, condition)
    fixed, motion = pulled(own, [1.2])
    fixed[own.nodes[:, 0] == 1, 1] = True  # held, so that the field is not uniform
    weight = torch.randn(2, *own.nodes.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def scalar(mu, kappa, motion):
        found = own.equilibrium(AutogradElastic(decoupled, (mu, kappa), modulus=4.0), fixed, motion)
        return (weight[0] * found.displacement).sum() + (weight[1] * found.force).sum()

    given = [torch.tensor([[[1.0]]], dtype=torch.float64), torch.tensor([[[3.0]]], dtype=torch.float64), motion]
    leaves = [t.clone().requires_grad_() for t in given]
    grads = torch.autograd.grad(scalar(*leaves), leaves)
    right = int(((own.nodes[:, 0] == 1) & (own.nodes[:, 1] == 0.5)).nonzero()[0])
    for which, index in ((0, (0, 0, 0)), (1, (0, 0, 0)), (2, (0, right, 0)), (2, (0, right, 1))):
        ends = []
        for sign in (1, -1):
            moved = [t.clone() for t in given]
            moved[which][index] += sign * 1e-5
            ends.append(float(scalar(*moved)))
        assert float(grads[which][index]) == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-6, abs=1e-9)


def plate(folder):
    """The quarter plate: specimen, prescribed displacements, measured motion, total forces of the boundary sets, and the sets."""
    steps = [np.genfromtxt(folder / f"nodes_{n}.csv", delimiter=",", names=True) for n in (10, 20, 30, 40)]
    triangles = np.genfromtxt(folder / "elements.csv", delimiter=",", skip_header=1).astype(int)
    nodes, sets = np.stack([steps[0]["x"], steps[0]["y"]], 1), np.stack([steps[0]["bcx"], steps[0]["bcy"]], 1)
    motion = np.stack([np.stack([step["ux"], step["uy"]], 1) for step in steps])
    forces = np.stack([np.genfromtxt(folder / f"reactions_{n}.csv", skip_header=1) for n in (10, 20, 30, 40)])
    return PlaneSpecimen(torch.from_numpy(nodes), torch.from_numpy(triangles)), *(
        torch.from_numpy(a) for a in (sets > 0, motion, forces, sets)
    )


@pytest.mark.slow
def test_a_plate_with_a_hole_of_known_truth(data_root):
    folder = data_root / "measured" / "plate-known-truth"
    if not folder.is_dir():
        pytest.skip("no plate")
    own, fixed, motion, forces, sets = plate(folder)
    parts = [torch.tensor([[[value]]], dtype=torch.float64, requires_grad=True) for value in (1.0, 3.0)]
    found = own.equilibrium(AutogradElastic(decoupled, parts, modulus=4.3), fixed, motion)
    torch.testing.assert_close(found.displacement.detach(), motion, atol=1e-10, rtol=0)
    for which, axis in ((1, 0), (2, 0), (3, 1), (4, 1)):
        seen = found.force[:, sets[:, axis] == which, axis].sum(1).detach()
        torch.testing.assert_close(seen, forces[:, which - 1], atol=1e-9, rtol=0)
    assert math.isfinite(float(torch.autograd.grad(found.displacement.square().sum(), parts)[0]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"triangles": torch.tensor([[0, 1, 9]])}, "name the nodes 0 to 9, and there are 3"),
        ({"triangles": torch.tensor([[0, 1, 1]])}, "1 nodes belong to no triangle, the first is 2"),
        ({"nodes": torch.tensor([[0.0, 0], [1, 0], [2, 0]])}, "triangle 0 has no area"),
        ({"nodes": torch.tensor([[0.0, 0], [1, 0], [math.nan, 1]])}, "node 2 has a place that is not finite"),
        ({"nodes": torch.zeros(3, 3)}, "nodes have the shape"),
        ({"thickness": 0.0}, "thickness = 0.0 must be positive"),
        ({"condition": "plane"}, "condition = 'plane' is unknown: choose from strain, stress"),
    ],
)
def test_a_mesh_that_is_none(change, message):
    given = {"nodes": torch.tensor([[0.0, 0], [1, 0], [0, 1]]), "triangles": torch.tensor([[0, 1, 2]])}
    with pytest.raises(UserError, match=message):
        PlaneSpecimen(**(given | change))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("shape", "motion has the shape"),
        ("loose", "the specimen can move freely"),
        ("nan", "a prescribed displacement is not finite"),
        ("through", "load step 0 has no equilibrium, from .*: check units and signs"),
    ],
)
def test_a_motion_that_is_none(change, message):
    own = sheet(1)
    fixed, motion = pulled(own, [1.1])
    if change == "shape":
        motion = motion[0]
    if change == "loose":
        fixed[:] = False
    if change == "nan":
        motion[0, 0, 0] = math.nan
    if change == "through":  # the right edge is pushed through the left one
        motion = pulled(own, [-0.5])[1]
    with pytest.raises(UserError, match=message):
        own.equilibrium(NeoHookean(1.0, 0.3), fixed, motion)
