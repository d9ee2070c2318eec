"""Faulty recordings that people sent, read where NEUIDO_DATA has them: the right value of each, or the line that says what is wrong."""

import json
import os
import shutil
from pathlib import Path

import pytest
import torch

from neuido.data.formats.gaussian_ply import read_gaussian_vertices
from neuido.data.scenes.filmed_scene import load_views
from neuido.data.scenes.readers import read_recording
from neuido.errors import UserError
from tests.command import run

CASES = Path(os.environ.get("NEUIDO_DATA", "")) / "cases"
pytestmark = pytest.mark.skipif(not os.environ.get("NEUIDO_DATA") or not CASES.is_dir(), reason="NEUIDO_DATA has no folder cases")
SHARE = pytest.approx(0.0565, abs=0.002)
"""Of the images, the object."""


def case(number: int) -> Path:
    return next(CASES.glob(f"{number:02d}-*"))


@pytest.mark.parametrize(("number", "width"), [(1, 100), (1, 37), (3, None), (31, None)])
def test_share_of_the_object(number, width):
    batch = load_views(case(number), width=width)
    assert batch.masks.mean(dim=(1, 2, 3)).tolist() == [SHARE] * len(batch.masks)
    assert width != 100 or batch.images.shape[2:4] == (74, 100)


def test_pincushion_without_a_mask(tmp_path):
    """The masks are about those of the same images without distortion."""
    masks = load_views(case(2)).masks
    shutil.copytree(case(2) / "images", tmp_path / "images")
    content = json.loads((case(2) / "transforms.json").read_text())
    (tmp_path / "transforms.json").write_text(json.dumps(content | {"k1": 0.0}))
    assert float(masks[..., 0, :].max()) == 0
    assert float(masks.mean()) == pytest.approx(float(load_views(tmp_path).masks.mean()), rel=0.05)


@pytest.fixture
def copied(tmp_path, capsys, monkeypatch):
    """Run `reconstruct` on a copy of a case, which it may write into; return its report."""

    def reconstructed(number: int) -> dict:
        for part in ("images", "transforms.json"):
            own = case(number) / part
            (shutil.copytree if own.is_dir() else shutil.copy)(own, tmp_path / part)
        monkeypatch.chdir(tmp_path)
        sizes = ["--steps", "40", "--start", "400", "--gaussians", "400", "--particles", "500", "--resolution", "24"]
        status, _, said = run(capsys, "reconstruct", ".", *sizes, "--velocity", "[0,-1.9,0]")
        assert status == 0, said
        return json.loads(Path("reconstruction/report.json").read_text())

    return reconstructed


@pytest.mark.slow
def test_pincushion_keeps_the_volume(copied):
    assert copied(2)["volume"] == pytest.approx(0.034, rel=0.05)


@pytest.mark.slow
def test_thirty_frames_a_second_are_predicted(copied, capsys):
    """With the default step, which 1/30 s does not divide."""
    copied(11)
    status, _, said = run(capsys, "predict", "--config", "predict", "--model.init_from", "pretrained-small", "--data.scenes", "[.]")
    assert status == 0, said
    (result,) = Path("runs/predict").iterdir()
    rows = (result / "particles" / "times.csv").read_text().splitlines()
    assert [float(row.split(",")[-1]) for row in rows[1:]] == pytest.approx(read_recording(case(11)).times.tolist())
    assert len(list(result.glob("particles/*.ply"))) == len(rows) - 1


@pytest.mark.parametrize(("number", "focal"), [(4, (110.0, 150.0)), (8, (110.0, None)), (9, (110.0, 110.0)), (10, (110.0, 110.0))])
def test_cameras(number, focal):
    found = read_recording(case(number))
    assert len(found.views) == 3 and len(found.times) == 1
    for i, value in enumerate(focal):
        assert value is None or torch.allclose(found.cameras.Ks[:, i, i], torch.tensor(value), atol=1e-3)


@pytest.mark.parametrize(("number", "match"), [(5, "is_fisheye"), (6, "k4 = 0.3"), (7, "write it row by row"), (12, "frame_interval")])
def test_refused_by_name(number, match):
    with pytest.raises(UserError, match=match):
        read_recording(case(number))


@pytest.mark.parametrize(("number", "count"), [(13, 5), (14, 4), (15, 4)])
@pytest.mark.filterwarnings("ignore:.*dropped. rows 1")
def test_gaussians(number, count):
    assert len(read_gaussian_vertices(next(case(number).glob("*.ply")))) == count


def test_compressed_gaussians():
    with pytest.raises(UserError, match=r"compressed PLY file .*export the Gaussians as an uncompressed .ply"):
        read_gaussian_vertices(next(case(16).glob("*.ply")))


def test_thirty_frames_a_second_divide_into_steps():
    from neuido.models.inference.prepared_scene import fitting_step, frame_substeps

    times = read_recording(case(11)).times
    dt = fitting_step(times, 5e-4)
    every, picks = frame_substeps(times, dt, "video")
    assert picks is None and dt <= 5e-4 and every * dt == pytest.approx(1 / 30)
