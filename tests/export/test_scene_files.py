"""What is exported is opened again by the format's own library and compared with what was simulated."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates
from scipy.spatial import KDTree

import neuido
from neuido.data import cameras
from neuido.data.formats.ply import read_ply_vertices
from neuido.errors import UserError
from neuido.export.exchange import exchange_of, with_edges
from neuido.export.marching_cubes import find_isosurface
from neuido.export.reconstruction import reconstruct_surface
from neuido.export.runs import read_run
from neuido.models import attach_gaussians, bind, deform, load_gaussians
from neuido.physics.colliders.solids import Sphere
from neuido.types import Skin

K, DT = 4, 0.02
BALL = neuido.shapes.ball(centre=(0.5, 0.6, 0.5), radius=0.2, spacing=0.05)
COUNT = len(BALL.x)
TETRAHEDRON = SimpleNamespace(
    vertices=np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float), faces=np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
)


def quarter_turns() -> np.ndarray:
    """Poses that turn about y by 30 degrees a frame and rise by 0.1 m a frame."""
    poses = np.tile(np.eye(4), (K, 1, 1))
    for k in range(K):
        c, s = np.cos(np.pi / 6 * k), np.sin(np.pi / 6 * k)
        poses[k, :3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
        poses[k, :3, 3] = [1.0, 0.1 * k, 0.0]
    return poses


def motion() -> SimpleNamespace:
    """Two bodies of one ball that falls by 0.05 m a frame and is stretched along x, with a skin and a collider on a path."""
    at = torch.arange(K)[:, None, None]
    F = torch.eye(3).repeat(K, COUNT, 1, 1)
    F[:, :, 0, 0] += 0.1 * torch.arange(K)[:, None]
    x = torch.einsum("kpij,pj->kpi", F, BALL.x.float()) + at * torch.tensor([0.0, -0.05, 0.0])
    v = torch.tensor([0.0, -0.05 / DT, 0.0]).expand(K, COUNT, 3)
    skin = Skin(BALL.x[:4].float(), torch.tensor(TETRAHEDRON.faces), torch.arange(4)[:, None], torch.ones(4, 1))
    collider = SimpleNamespace(name="gripper", mesh=TETRAHEDRON, poses=quarter_turns())
    body = (torch.arange(COUNT) >= COUNT // 2).int()
    return SimpleNamespace(
        x=x, v=v, C=torch.zeros(K, COUNT, 3, 3), F=F, times=DT * np.arange(K), body=body, body_names=("left part", "right"),
        skins=(skin,), colliders=(collider,),
    )  # fmt: skip


MOTION = motion()
SCENE = neuido.Scene(colliders=(neuido.Plane((0.0, 0.05, 0.0), (0.0, 1.0, 0.0)),))
LAW = neuido.laws.FixedCorotated(1e5, 0.3)
LEFT, RIGHT = (np.flatnonzero(MOTION.body.numpy() == i) for i in (0, 1))
SKIN = MOTION.skins[0].vertices_at(MOTION.x).numpy()


def coloured_gaussians() -> neuido.Gaussians:
    """Gaussians at the particles, with harmonics of degree 3."""
    made = attach_gaussians(BALL.x.float(), BALL.volume.float())
    harmonics = 0.2 * torch.randn(COUNT, 16, 3, generator=torch.Generator().manual_seed(1))
    return made._replace(harmonics=harmonics)


def signed_volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices[faces[:, i]].astype(float) for i in range(3))
    return float(np.einsum("ni,ni->", a, np.cross(b, c))) / 6


def test_usd_is_read_by_usd_core_as_it_was_written(tmp_path):
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom, UsdValidation, UsdVol

    around = cameras.orbit(2, width=64, height=48)
    path = neuido.export(MOTION, tmp_path / "a.usda", scene=SCENE, law=LAW, surface=True, gaussians=coloured_gaussians(), cameras=around,
                         speed=0.5)  # fmt: skip
    assert [p.name for p in tmp_path.iterdir()] == ["a.usda"]
    stage = Usd.Stage.Open(str(path))
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Y", 1.0)
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (0, K - 1, pytest.approx(0.5 / DT))
    errors = UsdValidation.ValidationContext(UsdValidation.ValidationRegistry().GetOrLoadAllValidators()).Validate(stage)
    assert not [e.GetErrorAsString() for e in errors if "usdz" not in e.GetName().lower()]

    points = UsdGeom.Points(stage.GetPrimAtPath("/World/particles/left_part"))
    for k in range(K):
        assert np.array_equal(np.array(points.GetPointsAttr().Get(k)), MOTION.x[k, LEFT].numpy())
    assert np.array(points.GetVelocitiesAttr().Get(1))[0] == pytest.approx([0.0, -0.5 * 0.05 / DT, 0.0])
    api = UsdGeom.PrimvarsAPI(points)
    assert np.array(api.GetPrimvar("volume_ratio").Get(3)) == pytest.approx(1.3)
    strain = np.log(1.3) * np.array([2, -1, -1]) / 3
    assert np.array(api.GetPrimvar("strain").Get(3)) == pytest.approx(np.sqrt(2 / 3 * (strain**2).sum()), rel=1e-6)
    sigma = LAW(MOTION.F[3, 0].double()) / 1.3
    deviator = sigma - sigma.trace() / 3 * torch.eye(3)
    assert np.array(api.GetPrimvar("stress").Get(3)) == pytest.approx(float((1.5 * deviator.square().sum()).sqrt()), rel=1e-5)
    assert set(np.array(api.GetPrimvar("body").Get())) == {0}

    skin = UsdGeom.Mesh(stage.GetPrimAtPath("/World/surfaces/skin"))
    assert np.array_equal(np.array(skin.GetPointsAttr().Get(2)), SKIN[2])
    assert np.array_equal(np.array(skin.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3), TETRAHEDRON.faces)
    surface = UsdGeom.Mesh(stage.GetPrimAtPath("/World/surfaces/right_surface"))
    faces = np.array(surface.GetFaceVertexIndicesAttr().Get(1)).reshape(-1, 3)
    vertices = np.array(surface.GetPointsAttr().Get(1))
    assert signed_volume(vertices, faces) == pytest.approx(1.1 * float(BALL.volume[RIGHT].sum()), rel=0.2)
    gripper = UsdGeom.Xformable(stage.GetPrimAtPath("/World/colliders/gripper"))
    assert np.array(gripper.GetLocalTransformation(3)).T == pytest.approx(quarter_turns()[3])
    floor = UsdGeom.Mesh(stage.GetPrimAtPath("/World/colliders/plane_0"))
    assert np.array(floor.GetPointsAttr().Get())[:, 1] == pytest.approx(0.05)
    assert np.array(floor.GetNormalsAttr().Get())[:, 1] == pytest.approx(1.0)

    frustum = UsdGeom.Camera(stage.GetPrimAtPath("/World/cameras/view_1")).GetCamera(0).frustum
    seen = frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
    point = np.array([0.3, 0.4, 0.7])
    ours = around.viewmats[1].double().numpy() @ np.append(point, 1)
    pixel = around.Ks[1].double().numpy() @ ours[:3]
    theirs = np.array(seen.Transform(point.tolist()))
    want = [2 * pixel[0] / pixel[2] / 64 - 1, 1 - 2 * pixel[1] / pixel[2] / 48]
    assert theirs[:2] == pytest.approx(want, abs=1e-4)

    splats = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/World/gaussians"))
    at = np.array(splats.GetPositionsAttr().Get(3))
    assert at == pytest.approx(MOTION.x[3].numpy(), abs=1e-6)
    assert splats.GetRadianceSphericalHarmonicsDegreeAttr().Get() == 3
    wide, narrow = (np.array(splats.GetScalesAttr().Get(3))[0].max(), np.array(splats.GetScalesAttr().Get(0))[0].max())
    assert wide == pytest.approx(1.3 * narrow, rel=1e-4)


def accessor(g, index: int) -> np.ndarray:
    a = g.accessors[index]
    view, width = g.bufferViews[a.bufferView], {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[a.type]
    kind = {5126: "<f4", 5125: "<u4"}[a.componentType]
    return np.frombuffer(g.binary_blob(), kind, a.count * width, view.byteOffset).reshape(-1, width)


def test_gltf_is_read_by_pygltflib_and_trimesh(tmp_path):
    library, trimesh = pytest.importorskip("pygltflib"), pytest.importorskip("trimesh")
    around = cameras.orbit(1, width=64, height=64)
    path = neuido.export(MOTION, tmp_path / "a.glb", scene=SCENE, surface=True, cameras=around, speed=0.5)
    g = library.GLTF2().load(str(path))
    names = {mesh.name: mesh for mesh in g.meshes}
    right, skin = names["right"].primitives[0], names["skin"].primitives[0]
    start = accessor(g, right.attributes.POSITION)
    assert np.array_equal(start, MOTION.x[0, RIGHT].numpy())
    assert len(right.targets) == K - 1 and right.mode == 0
    for k in range(1, K):
        assert start + accessor(g, right.targets[k - 1]["POSITION"]) == pytest.approx(MOTION.x[k, RIGHT].numpy(), abs=1e-6)
        moved = accessor(g, skin.attributes.POSITION) + accessor(g, skin.targets[k - 1]["POSITION"])
        assert moved == pytest.approx(SKIN[k], abs=1e-6)
    channels = {(g.nodes[c.target.node].name, c.target.path): g.animations[0].samplers[c.sampler] for c in g.animations[0].channels}
    weights = channels["right", "weights"]
    assert accessor(g, weights.input)[:, 0] == pytest.approx(2 * DT * np.arange(K))
    assert np.array_equal(accessor(g, weights.output).reshape(K, K - 1), np.eye(K)[:, 1:])
    turn = accessor(g, channels["gripper", "rotation"].output)
    assert turn[3] == pytest.approx([0, np.sin(np.pi / 4), 0, np.cos(np.pi / 4)], abs=1e-6)
    shown = channels["right_surface_0001", "scale"]
    assert (shown.interpolation, accessor(g, shown.output)[:, 0].tolist()) == ("STEP", [0.0, 1.0, 0.0])
    assert accessor(g, shown.input)[:, 0] == pytest.approx([0.0, 2 * DT, 4 * DT])
    assert all(view.byteOffset % 4 == 0 for view in g.bufferViews)

    scene = trimesh.load_scene(str(path))
    floor = scene.geometry["plane_0"]
    assert floor.vertices[:, 1] == pytest.approx(0.05) and floor.face_normals[:, 1] == pytest.approx(1.0)
    surface = scene.geometry["right_surface_0000"]
    assert surface.is_watertight and surface.volume == pytest.approx(float(BALL.volume[RIGHT].sum()), rel=0.2)
    text = json.loads(neuido.export(MOTION, tmp_path / "a.gltf").read_text())
    assert text["asset"]["version"] == "2.0" and text["buffers"][0]["uri"].startswith("data:")


def test_gltf_of_a_scene_with_z_up_is_turned(tmp_path):
    library = pytest.importorskip("pygltflib")
    upright = neuido.Scene(gravity=(0.0, 0.0, -9.8))
    g = library.GLTF2().load(str(neuido.export(MOTION, tmp_path / "a.glb", scene=upright)))
    x, y, z, w = g.nodes[0].rotation
    up = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])  # where +z goes
    assert up == pytest.approx([0.0, 1.0, 0.0])


def test_vtk_series_is_read_by_vtk(tmp_path):
    pytest.importorskip("vtkmodules")
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader

    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "right_0009.vtp").touch()  # of an earlier, longer run
    path = neuido.export(MOTION, tmp_path / "a.pvd", law=LAW)
    assert path.name == "a.pvd" and path.read_text().count("<DataSet") == 4 * K
    assert 'timestep="0.06" part="1" name="right" file="a/right_0003.vtp"' in path.read_text()
    assert not (tmp_path / "a" / "right_0009.vtp").exists()

    def read(name: str):
        reader = vtkXMLPolyDataReader()
        reader.SetFileName(str(tmp_path / "a" / name))
        reader.Update()
        return reader.GetOutput()

    data = read("right_0003.vtp")
    assert np.array_equal(vtk_to_numpy(data.GetPoints().GetData()), MOTION.x[3, RIGHT].numpy())
    fields = {data.GetPointData().GetArrayName(i) for i in range(data.GetPointData().GetNumberOfArrays())}
    assert fields == {"velocity [m/s]", "deformation_gradient", "volume_ratio", "strain", "stress [Pa]", "body"}
    assert vtk_to_numpy(data.GetPointData().GetArray("volume_ratio")) == pytest.approx(1.3)
    assert vtk_to_numpy(data.GetPointData().GetArray("deformation_gradient"))[:, 0] == pytest.approx(1.3)
    gripper = read("gripper_0002.vtp")
    pose = quarter_turns()[2]
    assert vtk_to_numpy(gripper.GetPoints().GetData()) == pytest.approx(TETRAHEDRON.vertices @ pose[:3, :3].T + pose[:3, 3], abs=1e-6)
    assert gripper.GetNumberOfPolys() == 4


def test_ply_sequence_has_surfaces_and_deforming_gaussians(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    gaussians = coloured_gaussians()
    first = neuido.export(MOTION, tmp_path / "a.ply", surface=True, gaussians=gaussians)
    vertices = read_ply_vertices(first.with_name("a_0003.ply"))
    assert vertices["volume_ratio"] == pytest.approx(1.3) and vertices["body"].dtype.kind == "i"
    index = json.loads((tmp_path / "a.json").read_text())
    assert index["times"] == pytest.approx([0.0, 0.02, 0.04, 0.06]) and index["units"]["velocity"] == "m/s"
    assert set(index["series"]) == {"a", "a_skin", "a_left_part_surface", "a_right_surface", "a_gripper", "a_splats"}
    assert {name for names in index["series"].values() for name in names} | {"a.json"} == {p.name for p in tmp_path.iterdir()}
    assert trimesh.load_mesh(tmp_path / "a_right_surface_0002.ply").is_watertight
    assert np.array(trimesh.load_mesh(tmp_path / "a_skin_0002.ply", process=False).vertices) == pytest.approx(SKIN[2], abs=1e-6)


def test_turned_gaussians_look_as_the_renderer_shows_them(tmp_path):
    """The harmonics of a turned body are written turned: rendered from file, they have the pixels of `deform`."""
    angle = torch.tensor(0.7)
    R = torch.eye(3)
    R[0, 0] = R[2, 2] = angle.cos()
    R[0, 2], R[2, 0] = angle.sin(), -angle.sin()
    centre = torch.tensor([0.5, 0.6, 0.5])
    x = torch.stack([BALL.x.float(), (BALL.x.float() - centre) @ R.T + centre])
    F = torch.stack([torch.eye(3).expand(COUNT, 3, 3), R.expand(COUNT, 3, 3)])
    gaussians = coloured_gaussians()
    neuido.export(SimpleNamespace(x=x, v=0 * x, F=F, times=[0.0, 0.1]), tmp_path / "a.ply", gaussians=gaussians)
    view = cameras.orbit(2, width=48, height=48)
    read = load_gaussians(tmp_path / "a_splats_0001.ply", device="cpu")
    want = neuido.render(deform(gaussians, F[1], x[1], bind(gaussians, x[0])), view)[0]
    assert float((neuido.render(read, view)[0] - want).abs().max()) < 2e-3
    unturned = read._replace(harmonics=gaussians.harmonics)
    assert float((neuido.render(unturned, view)[0] - want).abs().max()) > 0.02


def test_alembic_archive_is_read_by_alembic(tmp_path):
    pytest.importorskip("alembic3d")
    from alembic3d import Abc, AbcGeom

    path = neuido.export(MOTION, tmp_path / "a.abc", speed=0.5)
    top = Abc.IArchive(str(path)).getTop()
    names = [top.getChild(i).getName() for i in range(top.getNumChildren())]
    assert names == ["particles_left part", "particles_right", "skin", "gripper"]
    schema = AbcGeom.IPoints(top, "particles_right").getSchema()
    sample = schema.getValue(Abc.ISampleSelector(2 * 3 * DT))
    assert np.array(memoryview(sample.getPositions())) == pytest.approx(MOTION.x[3, RIGHT].numpy())
    assert schema.getTimeSampling().getSampleTime(3) == pytest.approx(2 * 3 * DT)
    mesh = AbcGeom.IPolyMesh(top, "skin").getSchema().getValue(Abc.ISampleSelector(2 * 2 * DT))
    assert np.array(memoryview(mesh.getPositions())) == pytest.approx(SKIN[2])
    assert np.array(memoryview(mesh.getFaceIndices())).reshape(-1, 3)[:, ::-1] == pytest.approx(TETRAHEDRON.faces)


def test_reconstructed_surface_has_the_volume_of_the_body_and_looks_outwards():
    made = exchange_of(SimpleNamespace(x=torch.stack([BALL.x, BALL.x + 0.1]), times=[0.0, DT]))
    vertices, faces, normals = reconstruct_surface(made, made.parts[0]).placed(1)
    assert signed_volume(vertices, faces) == pytest.approx(float(BALL.volume.sum()), rel=0.05)
    out = vertices - np.array([0.6, 0.7, 0.6])
    distance = np.linalg.norm(out, axis=1)
    assert distance == pytest.approx(0.2, abs=0.02)
    assert np.einsum("ni,ni->n", out / distance[:, None], normals).min() > 0.85
    assert len(vertices) - len(faces) / 2 == 2  # Euler's formula for a closed surface of one piece


def test_particles_that_touch_nowhere_have_no_surface(tmp_path):
    apart = SimpleNamespace(x=torch.eye(4)[None, :, :3], v=torch.zeros(1, 4, 3), times=[0.0])
    with pytest.raises(UserError, match=r"too far apart for a surface_spacing of 0\.2 m"):
        neuido.export(apart, tmp_path / "a.glb", surface=True, surface_spacing=0.2)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("a.sud", {}, "did you mean '.usd'"),
        ("a.glb", {"gaussians": coloured_gaussians()}, r"gaussians has no place in \.glb files: leave it out, or export to \.usd or \.ply"),
        ("a.csv", {"surface": True}, "surface has no place"),
        ("a.abc", {"cameras": cameras.orbit(1, width=8, height=8)}, "cameras has no place"),
        ("a.usd", {"every": 0}, "every is 0"),
        ("a.usd", {"speed": 0.0}, "speed is 0"),
        ("a.usd", {"surface": True, "surface_spacing": -1.0}, "surface_spacing is -1"),
        ("a.usd", {"law": neuido.laws.FixedCorotated(torch.tensor([1e5, 2e5]), 0.3)}, "of 2 scenes"),
        ("a.usd", {"gaussians": coloured_gaussians()._replace(means=BALL.x.float() + 5)}, "of another body"),
    ],
)
def test_what_cannot_be_exported_is_one_line(name, options, words, tmp_path):
    with pytest.raises(UserError, match=words):
        neuido.export(MOTION, tmp_path / name, **options)
    assert not list(tmp_path.iterdir())


def test_positions_that_are_not_finite_and_missing_gradients_are_named(tmp_path):
    x = MOTION.x.clone()
    x[2, 5] = torch.nan
    with pytest.raises(UserError, match="1 particles of frame 2 are not at a finite place"):
        neuido.export(SimpleNamespace(x=x, v=MOTION.v, times=MOTION.times), tmp_path / "a.usd")
    for options in ({"law": LAW}, {"gaussians": coloured_gaussians()}):
        with pytest.raises(UserError, match="no deformation gradient F"):
            neuido.export(SimpleNamespace(x=MOTION.x, v=MOTION.v, times=MOTION.times), tmp_path / "a.usd", **options)
    assert not list(tmp_path.iterdir())


def test_a_library_that_is_missing_is_named_with_its_extra(tmp_path, monkeypatch):
    import sys

    for ending, module, extra in ((".usd", "pxr.Usd", "usd"), (".glb", "pygltflib", "gltf"), (".pvd", "vtkmodules.vtkIOXML", "vtk"),
                                  (".abc", "alembic3d", "alembic")):  # fmt: skip
        monkeypatch.setitem(sys.modules, module, None)
        with pytest.raises(UserError, match=rf"pip install 'neuido\[{extra}\]'"):
            neuido.export(MOTION, tmp_path / f"a{ending}")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow  # a simulation with a solid collider
def test_frames_save_themselves_in_every_format_with_their_colliders(tmp_path):
    """Of a simulation, of its file of frames, and of the file that this one is exported to."""
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom

    sphere = Sphere(radius=0.1, position=(0.2, 0.2, 0.2), velocity=(1.0, 0.0, 0.0))
    scene = neuido.Scene(cells=16, dt=1e-3, colliders=(*SCENE.colliders, sphere))
    frames = neuido.Simulator(scene, BALL, density=1000.0, device="cpu").rollout(10, LAW, every=5)
    (path,) = frames.save(tmp_path / "a.usd")
    (archive,) = frames.save(tmp_path / "a.npz")
    again = neuido.export(read_run(archive).motion, tmp_path / "again.usd")
    for each, name in ((path, "sphere_1"), (again, "collider_0")):
        stage = Usd.Stage.Open(str(each))
        prim = stage.GetPrimAtPath(f"/World/colliders/{name}")
        assert np.array(UsdGeom.Xformable(prim).GetLocalTransformation(2))[3, :3] == pytest.approx([0.21, 0.2, 0.2])
        assert np.linalg.norm(np.array(UsdGeom.Mesh(prim).GetPointsAttr().Get()), axis=1) == pytest.approx(0.1)
    stage = Usd.Stage.Open(str(path))
    floor = UsdGeom.Mesh(stage.GetPrimAtPath("/World/colliders/plane_0"))
    assert np.array(floor.GetPointsAttr().Get())[:, 1] == pytest.approx(0.05)
    assert neuido.export(frames, tmp_path / "b.npz", every=2).is_file()
    with np.load(tmp_path / "b.npz") as archive:
        assert archive["x"].shape[0] == 2 and archive["times"] == pytest.approx([0.0, 0.01])


def test_the_isosurface_is_that_of_warp_on_the_whole_grid():
    import warp as wp
    from warp.geometry import IsoSurfaceMarchingCubes

    field = np.zeros((14, 17, 12), np.float32)
    field[2:-2, 2:-2, 2:-2] = np.random.default_rng(0).random((10, 13, 8))
    vertices, faces, slopes = find_isosurface(field, 0.6)
    upper = tuple(float(n - 1) for n in field.shape)
    slow, corners = IsoSurfaceMarchingCubes.extract(wp.array(field, dtype=float, device="cpu"), 0.6, lower=(0.0, 0.0, 0.0), upper=upper)

    apart, same = KDTree(slow.numpy()).query(vertices)
    assert len(vertices) == len(slow.numpy()) == len(set(same.tolist())) and apart.max() < 1e-5

    def turned(triangles):
        return {tuple(np.roll(triangle, -triangle.argmin()).tolist()) for triangle in triangles}

    assert len(faces) > 1000 and turned(same[faces]) == turned(corners.numpy().reshape(-1, 3))
    for axis, slope in enumerate(np.gradient(field)):
        assert slopes[:, axis] == pytest.approx(map_coordinates(slope, vertices.T, order=1), abs=1e-6)


def test_edges_of_a_box_stay_sharp_and_a_ball_stays_smooth():
    corners = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([(q[0], q[i], q[i + 1]) for q in quads for i in (1, 2)], np.int32)
    vertices, split, normals = with_edges(corners, faces)
    assert len(vertices) == 24 and np.array_equal(vertices[split], corners[faces])
    flat = np.cross(vertices[split[:, 1]] - vertices[split[:, 0]], vertices[split[:, 2]] - vertices[split[:, 0]])
    assert normals[split] == pytest.approx(np.repeat(flat[:, None], 3, axis=1))
    ball = trimesh_of_a_ball()
    vertices, split, normals = with_edges(*ball)
    assert len(vertices) == len(ball[0])
    assert np.einsum("ni,ni->n", normals, vertices) == pytest.approx(np.linalg.norm(vertices, axis=1), rel=2e-3)


def trimesh_of_a_ball():
    trimesh = pytest.importorskip("trimesh")
    ball = trimesh.creation.icosphere(3, 0.5)
    return np.asarray(ball.vertices, np.float32), np.asarray(ball.faces, np.int32)
