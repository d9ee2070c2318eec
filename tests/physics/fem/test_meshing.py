"""From particles to tetrahedra: cells, faces, volumes, and the ties between nodes and particles."""

import itertools

import numpy as np
import pytest
import torch

from neuido.errors import UserError
from neuido.physics.fem.meshing import (
    Mesh,
    lattice_of,
    mesh_body,
    mesh_of_cells,
    oriented,
    tetrahedra_of,
)
from neuido.physics.fem.particle_weights import interpolation_weights, locate
from neuido.physics.linalg.extent import box_axes
from tests.physics.bodies import block


def rotation(seed: int) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    q = torch.linalg.qr(torch.randn(3, 3, generator=g, dtype=torch.float64))[0]
    return q * torch.linalg.det(q)


def faces(mesh: Mesh) -> dict[tuple[int, ...], int]:
    """How many elements have each face."""
    count: dict[tuple[int, ...], int] = {}
    for corners in mesh.elements.tolist():
        for face in itertools.combinations(sorted(corners), 3):
            count[face] = count.get(face, 0) + 1
    return count


def surface(mesh: Mesh) -> float:
    outer = torch.tensor([face for face, n in faces(mesh).items() if n == 1])
    a, b, c = mesh.nodes[outer].unbind(1)
    return float(torch.linalg.cross(b - a, c - a).norm(dim=1).sum()) / 2


def scattered(inside, volume: float, count: int, seed: int = 0):
    """About `count` particles of an even but irregular density, by rejection of near neighbours; and their volumes."""
    g = np.random.default_rng(seed)
    h = (volume / count) ** (1 / 3)
    kept = np.empty((0, 3))
    for _ in range(12):
        for p in g.uniform(-0.5, 0.5, (count * 4, 3)):
            if inside(p) and (not len(kept) or ((kept - p) ** 2).sum(axis=1).min() > (0.75 * h) ** 2):
                kept = np.vstack([kept, p])
            if len(kept) == count:
                break
        if len(kept) == count:
            break
    x = torch.from_numpy(kept)
    return x, torch.full((len(x),), volume / len(x), dtype=torch.float64)


@pytest.mark.parametrize("kind", [5, 6])
def test_cells_become_conforming_tetrahedra(kind):
    mesh = mesh_of_cells(np.argwhere(np.ones((3, 2, 4), bool)), np.array([1.0, 2.0, 3.0]), np.diag([0.1, 0.2, 0.3]), kind)
    assert len(mesh.elements) == 24 * kind
    assert float(mesh.volume.min()) > 0
    assert float(mesh.volume.sum()) == pytest.approx(24 * 0.006)
    assert max(faces(mesh).values()) == 2
    # without gaps or overlaps what is left over is the box's own surface
    assert surface(mesh) == pytest.approx(2 * (0.3 * 0.4 + 0.4 * 1.2 + 0.3 * 1.2))


def test_other_cuts_are_refused():
    with pytest.raises(UserError, match="tetrahedra must be 5 or 6, got 7"):
        tetrahedra_of(np.zeros((1, 3), dtype=np.int64), 7)


@pytest.mark.parametrize("turned", [False, True])
def test_a_lattice_of_particles_gives_its_cells(turned):
    body = block((0.1, 0.2, 0.3), (0.5, 0.5, 0.9), (4, 3, 6))
    R = rotation(1) if turned else torch.eye(3, dtype=torch.float64)
    x = body.x @ R.T
    assert lattice_of(x.numpy()) is not None
    mesh = mesh_body(x, body.volume, elements=5 * len(x))
    assert len(mesh.elements) == 5 * len(x)
    corners = torch.cartesian_prod(*(torch.tensor([a, b], dtype=torch.float64) for a, b in ((0.1, 0.5), (0.2, 0.5), (0.3, 0.9)))) @ R.T
    assert float(torch.cdist(corners, mesh.nodes).amin(dim=1).max()) < 1e-7
    assert float(mesh.volume.sum()) == pytest.approx(float(body.volume.sum()))


def test_coarser_cells_keep_the_faces_of_a_block():
    body = block((0.0, 0.0, 0.0), (0.4, 0.2, 0.2), (20, 10, 10))
    mesh = mesh_body(body.x, body.volume, elements=1500)
    assert 1100 < len(mesh.elements) < 2000
    assert torch.allclose(mesh.nodes.amin(dim=0), torch.zeros(3, dtype=torch.float64), atol=1e-9)
    assert torch.allclose(mesh.nodes.amax(dim=0), torch.tensor([0.4, 0.2, 0.2], dtype=torch.float64), atol=1e-9)


def test_scattered_particles_of_a_turned_box_give_its_faces():
    size = np.array([0.5, 0.3, 0.4])
    x, volume = scattered(lambda p: (np.abs(p) <= size / 2).all(), float(size.prod()), 900)
    assert lattice_of(x.numpy()) is None
    R = rotation(2)
    mesh = mesh_body(x @ R.T, volume)
    extent = np.sort(np.ptp((mesh.nodes @ R).numpy(), axis=0))
    assert extent == pytest.approx(np.sort(size), rel=0.03)
    assert float(mesh.volume.sum()) == pytest.approx(float(volume.sum()))


def test_an_angle_keeps_its_notch():
    def inside(p):
        return (np.abs(p) <= (0.3, 0.3, 0.15)).all() and not (p[0] > 0 and p[1] > 0)

    x, volume = scattered(inside, 0.36 * 0.3 * 0.75, 1400)
    mesh = mesh_body(x, volume, elements=1400)
    notch = ((mesh.nodes[mesh.elements].mean(dim=1)[:, :2] > 0.04).all(dim=1)).double() @ mesh.volume
    assert float(notch) < 0.02 * float(volume.sum())
    _, weights = locate(mesh, x)
    assert float((weights.amin(dim=1) < -0.05).double().mean()) < 0.02


def test_a_ball_keeps_volume_and_size():
    x, volume = scattered(lambda p: (p**2).sum() <= 0.09, 4 / 3 * np.pi * 0.027, 1200)
    mesh = mesh_body(x, volume, elements=3000)
    assert float(mesh.volume.sum()) == pytest.approx(float(volume.sum()))
    assert float(mesh.nodes.norm(dim=1).max()) < 0.3 * 1.15
    moment = (mesh.volume * mesh.nodes[mesh.elements].mean(dim=1).square().sum(dim=1)).sum() / mesh.volume.sum()
    assert float(moment) == pytest.approx(0.6 * 0.09, rel=0.04)


def test_points_are_located_and_fields_are_followed():
    body = block((0.0, 0.0, 0.0), (0.6, 0.4, 0.5), (6, 4, 5))
    mesh = mesh_body(body.x, body.volume, elements=600)
    g = torch.Generator().manual_seed(0)
    points = torch.rand(200, 3, generator=g, dtype=torch.float64) * torch.tensor([0.6, 0.4, 0.5], dtype=torch.float64)
    element, weights = locate(mesh, points)
    assert float(weights.min()) > -1e-9
    assert torch.allclose((weights[..., None] * mesh.nodes[mesh.elements[element]]).sum(dim=1), points, atol=1e-12)
    beyond = torch.tensor([[-0.02, 0.2, 0.2], [0.63, 0.41, 0.52]], dtype=torch.float64)
    element, weights = locate(mesh, beyond)
    assert torch.allclose((weights[..., None] * mesh.nodes[mesh.elements[element]]).sum(dim=1), beyond, atol=1e-12)

    A = torch.randn(3, 3, generator=g, dtype=torch.float64)
    index, weight = interpolation_weights(body.x, mesh.nodes)
    got = torch.einsum("nk,nkc->nc", weight, (body.x @ A.T + 1.0)[index])
    assert torch.allclose(got, mesh.nodes @ A.T + 1.0, atol=1e-6)
    index, weight = interpolation_weights(body.x, mesh.nodes, degree=0)
    assert float(weight.min()) > 0


def test_smallest_box_is_found():
    R = rotation(5)
    g = torch.Generator().manual_seed(3)
    x = (torch.rand(500, 3, generator=g, dtype=torch.float64) * torch.tensor([3.0, 2.0, 1.0], dtype=torch.float64)) @ R.T
    assert np.prod(np.ptp(x.numpy() @ box_axes(x.numpy()).T, axis=0)) < 6.0 * 1.02


def test_bad_meshes_are_refused():
    nodes = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [2, 2, 2]])
    with pytest.raises(UserError, match="belong to no element"):
        oriented(nodes, torch.tensor([[0, 1, 2, 3]]))
    with pytest.raises(UserError, match="has no volume"):
        oriented(torch.cat([nodes[:3], nodes[:1] + nodes[1:2] + nodes[2:3], nodes[3:4]]), torch.tensor([[0, 1, 2, 3], [0, 1, 2, 4]]))
    assert float(oriented(nodes[:4], torch.tensor([[0, 2, 1, 3]])).volume) == pytest.approx(1 / 6)
    with pytest.raises(UserError, match="elements is 2"):
        mesh_body(nodes, torch.ones(5), elements=2)
    with pytest.raises(UserError, match="without particles"):
        mesh_body(nodes[:0], torch.ones(0))


@pytest.mark.parametrize(("shape", "words"), [((6, 6, 1), "36 particles of a body lie in a plane"), ((9, 1, 1), "9 .* lie on a line")])
def test_flat_bodies_are_refused(shape, words):
    axes = [torch.arange(n, dtype=torch.float32) for n in shape]
    x = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, 3) * 0.02
    for turn in (torch.eye(3), rotation(3).float()):
        with pytest.raises(UserError, match=f"{words}, which has no mesh"):
            mesh_body(x @ turn.T + 0.4, torch.full((len(x),), 8e-6))


def test_a_thin_body_has_a_mesh():
    x = torch.stack(torch.meshgrid(*(torch.arange(n) for n in (6, 6, 2)), indexing="ij"), dim=-1).reshape(-1, 3) * 0.02
    mesh = mesh_body(x.double(), torch.full((len(x),), 8e-6, dtype=torch.float64), elements=5 * len(x))
    assert float(mesh.volume.sum()) == pytest.approx(72 * 8e-6)
