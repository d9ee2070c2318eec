import numpy as np
import pytest
import torch
from scipy.spatial import KDTree

from neuido.data.bodies import mesh_filling, scanlines, shapes
from neuido.data.bodies.mesh_files import read_mesh
from neuido.data.bodies.triangle_mesh import clean_mesh
from neuido.errors import UserError

trimesh = pytest.importorskip("trimesh")


def made(kind: str):
    creation = trimesh.creation
    mesh = {
        "ball": lambda: creation.icosphere(subdivisions=3, radius=0.2),
        "torus": lambda: creation.torus(0.2, 0.07),
        "turned box": lambda: creation.box((0.3, 0.2, 0.25), transform=trimesh.transformations.rotation_matrix(0.7, (1, 2, 3))),
        "plate": lambda: creation.box((0.3, 0.02, 0.3)),  # thinner than the spacing of 2,000 particles
    }[kind]()
    return mesh, clean_mesh(mesh.vertices, mesh.faces, kind)


@pytest.mark.parametrize("kind", ["ball", "torus", "turned box", "plate"])
def test_a_filling_has_the_volume_and_moments_of_the_mesh(kind):
    mesh, own = made(kind)
    spacing = (mesh.volume / 2000) ** (1 / 3)
    x, volume = mesh_filling.fill_mesh(mesh_filling.closed_mesh(own, kind), spacing, kind)
    assert volume.sum() == pytest.approx(mesh.volume, rel=1e-9)
    assert len(x) == pytest.approx(2000, rel=0.2)
    middle = np.average(x, axis=0, weights=volume)
    assert np.abs(middle - mesh.center_mass).max() < 0.1 * spacing
    apart = x - middle
    second = np.einsum("p,pi,pj->ij", volume, apart, apart)
    truth = 0.5 * np.trace(mesh.moment_inertia) * np.eye(3) - mesh.moment_inertia  # of density 1
    each = volume.sum() * spacing**2 / 12  # a particle is a point, the cube that it fills is not
    assert second + each * np.eye(3) == pytest.approx(truth, abs=0.03 * np.trace(truth))
    depth = KDTree(_centres(mesh, spacing / 3, scanlines.find_inside(own, *_lattice(mesh, spacing / 3)).inside)).query(x)[0]
    assert depth.max() < spacing / 3  # each lies in a cell that is inside, or beside one


@pytest.mark.parametrize("kind", ["ball", "torus", "turned box"])
def test_a_filling_is_even(kind):
    mesh, own = made(kind)
    spacing = (mesh.volume / 4000) ** (1 / 3)
    x, volume = mesh_filling.fill_mesh(own, spacing, kind)
    tree = KDTree(x)
    nearest = tree.query(x, k=2)[0][:, 1] / spacing
    assert nearest.min() > 0.6 and nearest.std() / nearest.mean() < 0.1  # 0.36 of random points
    assert volume.std() / volume.mean() < 0.2 and 0.3 < volume.min() / spacing**3 and volume.max() / spacing**3 < 1.8
    centres = np.random.default_rng(0).uniform(*mesh.bounds, (4000, 3))
    inside = scanlines.find_inside(own, *_lattice(mesh, spacing / 3)).inside
    deep = KDTree(_centres(mesh, spacing / 3, ~inside)).query(centres)[0] > 1.5 * spacing
    counts = np.array([len(near) for near in tree.query_ball_point(centres[deep], 1.5 * spacing)])
    assert len(counts) > 50
    assert counts.var() / counts.mean() < 0.25  # 1 of random points: the number of particles in a ball hardly varies


def _lattice(mesh, edge):
    low, high = mesh.bounds
    return low - 3 * edge, tuple(np.ceil((high - low) / edge).astype(int) + 6), np.full(3, edge)


def _centres(mesh, edge, chosen):
    return mesh.bounds[0] - 3 * edge + edge * (np.argwhere(chosen) + 0.5)


def test_lines_find_what_is_inside():
    mesh, own = made("ball")
    lower, shape, edges = _lattice(mesh, 0.02)
    found = scanlines.find_inside(own, lower, shape, edges)
    centre = lower + edges * (np.indices(shape).reshape(3, -1).T + 0.5)
    shift = (np.array(scanlines.SHIFTS[0]) - 0.5) * 0.02
    radius = np.linalg.norm(centre + np.array([0.0, *shift]), axis=1).reshape(shape)
    assert found.inside[radius < 0.196].all() and not found.inside[radius > 0.2].any()  # the mesh is up to 2 % inside the ball
    assert found.volume == pytest.approx(mesh.volume, rel=0.01) and not found.overlaps


def test_axes_and_lattices_that_coincide_are_no_trouble():
    box = trimesh.creation.box((1.0, 1.0, 1.0))  # its faces, edges and diagonals lie on those of the lattice
    x, volume = mesh_filling.fill_mesh(clean_mesh(box.vertices, box.faces, "box"), 0.1, "box")
    assert len(x) == 1000 and volume == pytest.approx(1e-3)
    at = np.sort(np.unique(np.round(x, 9)))
    assert at == pytest.approx(np.linspace(-0.45, 0.45, 10))  # the lattice itself


def test_cavities_and_overlaps():
    outer, inner = trimesh.creation.icosphere(2, 0.2), trimesh.creation.icosphere(2, 0.1)
    inner.invert()
    hollow = trimesh.util.concatenate([outer, inner])
    x, volume = mesh_filling.fill_mesh(clean_mesh(hollow.vertices, hollow.faces, "hollow"), 0.02, "hollow")
    assert volume.sum() == pytest.approx(outer.volume + inner.volume) and np.linalg.norm(x, axis=1).min() > 0.09
    a, b = trimesh.creation.box((0.2, 0.2, 0.2)), trimesh.creation.box((0.2, 0.2, 0.2))
    b.apply_translation((0.1, 0.013, 0.007))
    both = trimesh.util.concatenate([a, b])
    _, volume = mesh_filling.fill_mesh(clean_mesh(both.vertices, both.faces, "both"), 0.02, "both")
    assert volume.sum() == pytest.approx(2 * 0.008 - 0.1 * 0.187 * 0.193, rel=0.01)


def test_open_meshes_are_refused_and_repaired():
    mesh = trimesh.creation.icosphere(2, 0.2)
    faces = mesh.faces[5:].copy()
    faces[10] = faces[10][::-1]
    torn = clean_mesh(mesh.vertices, faces, "torn.stl")
    with pytest.raises(UserError, match=r"torn.stl is not watertight: \d+ of its edges .* repair"):
        mesh_filling.closed_mesh(torn, "torn.stl")
    whole = mesh_filling.closed_mesh(torn, "torn.stl", repair=True)
    assert scanlines.open_edges(whole.faces) == 0
    assert scanlines.enclosed_volume(whole) == pytest.approx(mesh.volume, rel=0.02)
    half = clean_mesh(mesh.vertices, mesh.faces[:3], "scrap.stl")
    with pytest.raises(UserError, match="scrap"):
        mesh_filling.closed_mesh(half, "scrap.stl", repair=True)


def test_an_inverted_mesh_is_turned():
    mesh = trimesh.creation.icosphere(2, 0.2)
    inverted = clean_mesh(mesh.vertices, mesh.faces[:, ::-1], "ball")
    assert scanlines.enclosed_volume(mesh_filling.closed_mesh(inverted, "ball")) == pytest.approx(mesh.volume)


def test_limits_hold_before_memory_is_taken(monkeypatch):
    _, own = made("ball")
    with pytest.raises(UserError, match="NEUIDO_MAX_PARTICLES"):
        mesh_filling.fill_mesh(own, 1e-5, "ball")
    monkeypatch.setenv("NEUIDO_MAX_MEMORY_BYTES", "1000000")
    with pytest.raises(UserError, match="raise spacing"):
        mesh_filling.fill_mesh(own, 0.005, "ball")
    monkeypatch.delenv("NEUIDO_MAX_MEMORY_BYTES")
    with pytest.raises(UserError, match=r"too coarse .* 8 at least"):
        mesh_filling.fill_mesh(own, 0.3, "ball")
    thin = trimesh.util.concatenate(
        [trimesh.creation.box((1.0, 0.001, 1.0)), trimesh.creation.box(bounds=[(0, 0.1, 0), (0.01, 0.2, 0.01)])]
    )
    with pytest.raises(UserError, match=r"too coarse .* cells of a third"):
        mesh_filling.fill_mesh(clean_mesh(thin.vertices, thin.faces, "sheet"), 0.03, "sheet")


def test_a_mesh_becomes_a_body_with_a_skin(tmp_path):
    trimesh.creation.box((1.0, 2.0, 3.0)).export(tmp_path / "box.stl")
    body = shapes.mesh(file=tmp_path / "box.stl", particles=3000, size=0.3, up="z", rotation=(0.0, 90.0, 0.0), centre=(0.5, 0.4, 0.3),
                       velocity=(0.0, -1.0, 0.0), angular_velocity=(0.0, 0.0, 2.0))  # fmt: skip
    assert float(body.volume.sum()) == pytest.approx(0.1 * 0.2 * 0.3, rel=1e-5)
    extent = body.skin.vertices.amax(0) - body.skin.vertices.amin(0)
    assert extent.tolist() == pytest.approx([0.2, 0.3, 0.1])  # z is up, x and the former y change places
    assert ((body.skin.vertices.amax(0) + body.skin.vertices.amin(0)) / 2).tolist() == pytest.approx([0.5, 0.4, 0.3])
    assert (body.skin.vertices_at(body.x[None].double())[0] - body.skin.vertices).abs().max() < 1e-7
    omega = torch.tensor([0.0, 0.0, 2.0])
    rigid = torch.tensor([0.0, -1.0, 0.0]) + torch.linalg.cross(omega.expand_as(body.x), body.x - torch.tensor([0.5, 0.4, 0.3]))
    assert (body.v - rigid).abs().max() < 1e-3
    cases = (({}, "spacing or particles"), ({"spacing": 0.1, "size": 1.0, "scale": 1.0}, "not both"), ({"spacing": -1.0}, "positive"),
             ({"particles": 0}, "positive"), ({"spacing": 0.1, "up": "w"}, "x, y or z"))  # fmt: skip
    for wrong, words in cases:
        with pytest.raises(UserError, match=words):
            shapes.mesh(file=tmp_path / "box.stl", **wrong)


def test_a_mesh_in_a_torn_file_says_what_to_do(tmp_path):
    mesh = trimesh.creation.icosphere(2, 0.2)
    trimesh.Trimesh(mesh.vertices, mesh.faces[2:], process=False).export(tmp_path / "torn.ply")
    assert len(read_mesh(tmp_path / "torn.ply").faces) == len(mesh.faces) - 2
    with pytest.raises(UserError, match="repair"):
        shapes.mesh(file=tmp_path / "torn.ply", spacing=0.04)
    assert float(shapes.mesh(file=tmp_path / "torn.ply", spacing=0.04, repair=True).volume.sum()) == pytest.approx(mesh.volume, rel=0.01)
