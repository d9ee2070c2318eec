"""Clips of several cameras above a printed board: their cameras, clocks and masks, and the velocity of the ball."""

import json

import numpy as np
import pytest
import torch

import neuido
from neuido.data import cameras as convert
from neuido.data.footage import view_recording
from neuido.data.footage.board_cameras import parse_board
from neuido.data.footage.filming import Filming
from neuido.data.footage.known_cameras import reconstructed_cameras, recorded_cameras
from neuido.data.footage.video_frames import read_clip
from neuido.data.scenes.filmed_scene import load_views, read_motion
from neuido.errors import UserError
from neuido.types import Cameras
from tests.data.footage import drawn

EYES = ((0.45, 0.35, 0.65), (-0.3, 0.4, 0.45), (0.2, 0.45, -0.4))
EMPTY, COUNT, RATE = 13, 10, 60
V0 = np.array([0.6, 0.8, -0.4])


@pytest.fixture(scope="module")
def clips(tmp_path_factory):
    """Three clips with a flash before the throw; the second began three frames later. Return them, their cameras and the motion."""
    folder = tmp_path_factory.mktemp("views")
    views = torch.stack([convert.look_at(eye, (0.15, 0.05, 0.12)) for eye in EYES])
    K = convert.intrinsics(*drawn.STAGE, focal=560.0).float().expand(3, 3, 3).contiguous()
    cameras = Cameras(views.float(), K, *drawn.STAGE)
    t = np.arange(COUNT) / RATE
    x = np.array([0.05, 0.10, 0.15]) + np.outer(t, V0) + np.outer(t**2, [0.0, -4.905, 0.0])
    absent = np.tile([0.0, -50.0, 0.0], (EMPTY, 1))
    for v, images in enumerate(drawn.staged(cameras, np.concatenate([absent, x]))):
        lit = [image + 25 * (i == 5) for i, image in enumerate(images)]
        drawn.film(folder / f"cam{v}.mp4", lit[3 * (v == 1) :])
    return folder, cameras, x


@pytest.mark.slow
def test_a_board_on_the_floor_gives_the_cameras(clips, tmp_path, monkeypatch):
    folder, true, x = clips
    paths = sorted(folder.glob("*.mp4"))
    filming = Filming(start=EMPTY / RATE, cameras="board", board=drawn.BOARD, synchronise="flash")
    said = neuido.import_file(paths, tmp_path / "out", filming=filming, up="z", held_out=["cam1"])
    found = neuido.read_recording(tmp_path / "out")
    assert len(found.views) == 3 and len(found.times) == COUNT and found.held_out == (1,)
    shift = np.array([0.5 - x[0, 0], 0.0, 0.5 - x[0, 2]])  # the body starts in the middle, the board lies on the floor
    for v in range(3):
        own, given = found.cameras.viewmats[v].double().numpy(), true.viewmats[v].double().numpy()
        assert np.abs(-own[:3, :3].T @ own[:3, 3] - shift - EYES[v]).max() < 0.012  # m, of distances of about 0.7 m
        assert np.degrees(np.arccos(min((np.trace(own[:3, :3] @ given[:3, :3].T) - 1) / 2, 1.0))) < 0.4
        assert float(found.cameras.Ks[v, 0, 0]) == pytest.approx(560.0, rel=0.015)
    motion = read_motion(tmp_path / "out")
    assert motion is not None and np.abs(np.array(motion.velocity) - V0).max() < 0.06
    assert np.abs(np.array(motion.centre) - x[0] - shift).max() < 0.008
    assert any("cam1.mp4 +0.0500 s" in line for line in said) and "neuido reconstruct" in said[-1]
    masks = load_views(tmp_path / "out").masks
    P = (true.Ks.double() @ true.viewmats.double()[:, :3]).numpy()
    depth = np.einsum("vj,tj->vt", P[:, 2], np.c_[x, np.ones(COUNT)])
    assert masks.sum(dim=(2, 3)).numpy() == pytest.approx(np.pi * (0.02 * 560 / depth) ** 2, rel=0.06)
    # a recording with these views serves as cameras as well
    known = Filming(start=EMPTY / RATE, cameras=str(tmp_path / "named"), offsets=[0.0, 0.05, 0.0])
    text = (tmp_path / "out" / "transforms.json").read_text()
    (tmp_path / "named" / "images").mkdir(parents=True)
    for v in range(3):
        image = tmp_path / "out" / "images" / f"{v}_000.png"
        (tmp_path / "named" / "images" / image.name).write_bytes(image.read_bytes())
        text = text.replace(f'"view": {v}', f'"view": "cam{v}"')
    content = json.loads(text)
    content["frames"] = [frame for frame in content["frames"] if frame["time"] == 0.0]
    (tmp_path / "named" / "transforms.json").write_text(json.dumps(content))
    neuido.import_file(paths, tmp_path / "again", filming=known)
    again = neuido.read_recording(tmp_path / "again").cameras
    assert torch.allclose(again.Ks, found.cameras.Ks) and torch.allclose(
        again.viewmats[:, :3, :3], found.cameras.viewmats[:, :3, :3], atol=1e-5
    )
    # cameras without a scale are told of
    monkeypatch.setattr(view_recording, "reconstructed_cameras", lambda clips, _: recorded_cameras(tmp_path / "named", clips))
    for scale in (None, 1.0):
        said = neuido.import_file(paths, None, filming=known._replace(cameras="colmap"), scale=scale)
        assert any("not in metres: give --scale" in line for line in said) == (scale is None)


@pytest.mark.slow
def test_what_clips_cannot_tell(clips, tmp_path):
    folder, _, _ = clips
    paths = sorted(folder.glob("*.mp4"))[:2]
    board = Filming(cameras="board", board=drawn.BOARD)
    for chosen, filming, options, match in (
        (paths, board._replace(board="9x7 20 mm 15 mm 5X5_100"), {}, "never shows 8 corners of the board"),
        (paths, board, {"up": "x"}, "--up x must be one of y, -y, z, -z"),
        (paths[:1], board, {}, "needs the clips of at least two cameras"),
        (paths, board._replace(offsets=[0.0, 9.0]), {}, "share 0 frames"),
        (paths, board._replace(cameras="nowhere"), {}, "--cameras nowhere is neither board, colmap nor a recording"),
        (paths, board._replace(synchronise="flash"), {"up": "z"}, "two cameras see the object from 0.2.* give --start 0.2"),
    ):
        with pytest.raises(UserError, match=match):
            neuido.import_file(chosen, tmp_path / "out", filming=filming, **options)
        assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("text", [None, "", "7x5", "7x5 40 30 4X4_50", "7x5 40 mm 50 mm 4X4_50", "1x9 40 mm 30 mm 4X4_50",
                                  "7x5 40 mm 30 mm 4X4_51", "7x5 40 mm 30 mm 4X4_50; rm", "99x99 40 mm 30 mm 4X4_50"])  # fmt: skip
def test_boards_that_are_none(text):
    with pytest.raises(UserError, match="--board"):
        parse_board(text)
    assert parse_board("7x5 40 mm 3 cm 4x4_50") == (7, 5, 0.04, 0.03, "4X4_50")


@pytest.mark.slow
def test_colmap_finds_the_cameras_of_a_textured_scene(tmp_path):
    pytest.importorskip("pycolmap")
    eyes = np.array([(1.3 + 0.12 * i, 0.7 + 0.05 * (i % 2), 1.6 - 0.12 * i) for i in range(4)])
    views = torch.stack([convert.look_at(tuple(eye), (0.35, 0.3, 0.35)) for eye in eyes])
    cameras = Cameras(views.float(), convert.intrinsics(640, 480, focal=620.0).float().expand(4, 3, 3), 640, 480)
    clips = [read_clip(drawn.film(tmp_path / f"{v}.mp4", [image] * 3)) for v, image in enumerate(drawn.corner_of_a_room(cameras))]
    found, _ = reconstructed_cameras(clips, Filming())
    places = np.array([-view.viewmat[:3, :3].T @ view.viewmat[:3, 3] for view in found])
    own, true = (np.linalg.norm(c[:, None] - c[None], axis=2) for c in (places, eyes))  # up to scale and a rigid motion
    assert own / own.max() == pytest.approx(true / true.max(), abs=0.01)
    assert [view.K[0, 0] for view in found] == pytest.approx([620.0] * 4, rel=0.01)
    blank = [read_clip(drawn.film(tmp_path / f"blank{v}.mp4", [np.full((48, 64, 3), 90.0)] * 3)) for v in range(2)]
    with pytest.raises(UserError, match="COLMAP places 0 of 2 views"):
        reconstructed_cameras(blank, Filming())
