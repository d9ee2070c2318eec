"""Made recordings with one fault each: the check that finds it, and a good one in which nothing is wrong."""

import math
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from neuido.commands.check import check
from neuido.data import cameras as convert
from neuido.data.formats import nerfstudio
from neuido.data.scenes.capture_quality import capture_findings
from neuido.data.scenes.readers import read_recording
from neuido.errors import UserError
from neuido.types import Cameras
from tests.command import run

SIZE, RADIUS, INTERVAL = (160, 120), 0.09, 0.02


def cameras_of(count: int, spread: float = 360.0) -> Cameras:
    eyes = [(0.5 + 2 * math.sin(a), 0.8, 0.5 + 2 * math.cos(a)) for a in np.radians(np.arange(count) * spread / count)]
    views = torch.stack([convert.look_at(eye, (0.5, 0.5, 0.5)) for eye in eyes])
    return Cameras(views.float(), convert.intrinsics(*SIZE, focal=200.0).float().expand(count, 3, 3).contiguous(), *SIZE)


def place(t: float) -> np.ndarray:
    return np.array([0.4 + 1.0 * t, 0.6 + 0.5 * t - 4.905 * t * t, 0.5])


def disc(centre, radius: float, smear=(0.0, 0.0)) -> np.ndarray:
    i, j = np.mgrid[: SIZE[1], : SIZE[0]]
    out = np.zeros((SIZE[1], SIZE[0]), np.float32)
    parts = np.linspace(-0.5, 0.5, 15) if np.any(smear) else [0.0]
    for s in parts:
        out += np.clip(radius - np.hypot(j + 0.5 - centre[0] - s * smear[0], i + 0.5 - centre[1] - s * smear[1]) + 0.5, 0, 1)
    return out / len(parts)


def recording(
    folder: Path,
    *,
    count=4,
    frames=9,
    spread=360.0,
    late=lambda v: 0.0,
    path=place,
    radius=RADIUS,
    exposure=0.0,
    colour=(200, 60, 60),
    background=(255, 255, 255),
    unit=1.0,
    interval=INTERVAL,
) -> Path:
    """Write a ball in flight, seen by `count` views; `late(v)` [s] by how much view v is behind."""
    cameras = cameras_of(count, spread)
    P = (cameras.Ks.double() @ cameras.viewmats.double()[:, :3]).numpy()

    def project(v, t):
        h = P[v] @ [*path(t), 1.0]
        return h[:2] / h[2], radius * 200.0 / h[2]

    images = []
    for v in range(count):
        row = []
        for k in range(frames):
            t = k * interval - late(v)
            (centre, size), (ahead, _) = project(v, t), project(v, t + exposure)
            mask = disc(centre, size, ahead - centre if exposure else (0.0, 0.0))[..., None]
            row.append(np.rint(mask * np.array(colour) + (1 - mask) * np.array(background)).astype(np.uint8))
        images.append(row)
    moved = cameras._replace(viewmats=cameras.viewmats.clone())
    moved.viewmats[:, :3, 3] *= unit
    nerfstudio.write(folder, moved, torch.arange(frames).double() * interval, images)
    return folder


def said(folder) -> list[tuple[str, bool, str]]:
    return [tuple(each) for each in capture_findings(read_recording(folder))]


def test_nothing_is_wrong_with_a_good_one(tmp_path, capsys):
    assert said(recording(tmp_path / "good")) == []
    status, out, err = run(capsys, "check", tmp_path / "good")
    assert (status, err) == (0, "") and "4 views, 9 frames" in out and "neuido reconstruct" in out


@pytest.mark.parametrize(
    ("options", "check", "wrong", "words"),
    [
        ({"count": 1}, "views", True, "1 to train on; 2 are needed"),
        ({"count": 3}, "views", False, "3 to train on"),
        ({"spread": 20.0}, "views", False, "all look within 15 degrees"),
        ({"frames": 2}, "frames", True, "2 moments"),
        ({"interval": 0.08, "frames": 4}, "frames", False, "one every 80 ms"),
        ({"path": lambda t: np.array([0.4 + 8 * t, 0.5, 0.5]), "frames": 4}, "frames", False, "of its size from one frame to the next"),
        ({"path": lambda t: np.array([0.4, 0.6, 0.5])}, "motion", True, "a body at rest"),
        ({"radius": 0.02}, "masks", True, "px across in view 0; 16 are needed"),
        ({"path": lambda t: place(t) - np.array([0.69, 0.0, 0.0])}, "framing", True, r"border of view 0 in \d of 9 frames, .* frame 0"),
        ({"colour": (255, 252, 251), "background": (0, 80, 0)}, "exposure", False, r"\d+% of the object is overexposed in view 0"),
        ({"exposure": 0.012, "path": lambda t: np.array([0.2 + 3.0 * t, 0.5, 0.5])}, "blur", False, "an exposure of about"),
        ({"late": lambda v: 0.012 * (v == 2)}, "synchronisation", True, "view 2 seems 1[0-4] ms behind the others"),
        ({"late": lambda v: -0.012 * (v == 1)}, "synchronisation", True, "view 1 seems 1[0-4] ms ahead of the others"),
        ({"unit": 10.0}, "scale", False, "--scale 0.1 --up y"),
    ],
)  # fmt: skip
def test_each_fault_is_found(tmp_path, options, check, wrong, words):
    found = said(recording(tmp_path / "made", **options))
    assert any(own == check and own_wrong is wrong and re.search(words, text) for own, own_wrong, text in found), found


def test_views_that_disagree_and_backgrounds_that_are_not_plain(tmp_path):
    folder = recording(tmp_path / "a")
    text = (folder / "transforms.json").read_text()
    found = read_recording(folder)
    wrong = found.cameras.viewmats.clone()
    wrong[1, 0, 3] += 0.15
    nerfstudio.write_transforms(folder, found.cameras._replace(viewmats=wrong), found.times)
    assert [each[0] for each in said(folder) if each[1]] == ["cameras"]
    (folder / "transforms.json").write_text(text)
    for path in (folder / "images").iterdir():
        image = cv2.imread(str(path)).astype(float)
        cv2.imwrite(str(path), np.clip(image - 90 * np.random.default_rng(0).random(image.shape), 0, 255).astype(np.uint8))
    (masks,) = (each for each in said(folder) if each[1])
    assert masks[0] == "masks" and "border pixels differ from one colour" in masks[2]


def test_command_ends_with_status_2_where_something_is_wrong(tmp_path, capsys):
    recording(tmp_path / "one", count=1)
    status, out, err = run(capsys, "check", tmp_path / "one")
    assert status == 2 and "wrong   views: 1 to train on" in out and err.count("\n") == 1 and "1 thing to mend before training" in err
    with pytest.raises(UserError, match="has none of"):
        check(str(tmp_path))


def test_each_check_stands_in_the_guide():
    guide = (Path(__file__).parents[3] / "docs" / "howto" / "capture.md").read_text()
    source = (Path(__file__).parents[3] / "neuido" / "data" / "scenes" / "capture_quality.py").read_text()
    names = set(re.findall(r'Finding\(\s*"(\w+)"', source))
    assert len(names) == 10 and all(f"**{name}**" in guide for name in names)
