"""A user's own multi-view video, from images to a law in three commands: no experiment file, no masks, other units and axes."""

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from neuido.commands.main import main
from neuido.data.formats.ply import read_ply_vertices
from neuido.data.scenes.film_options import Film
from neuido.data.scenes.filmed_scene import read_truth
from neuido.data.scenes.multiview import UP
from neuido.data.scenes.synthetic import make_scenes
from neuido.models.inference.law_file import load_law
from neuido.models.render.splatting import rasterize

BOX = {
    "name": "Box",
    "scene": {"domain": [[0, 0, 0], [1, 1, 1]], "gravity": [0, -9.8, 0], "walls": {"contact": "separate", "friction": float("inf")}},
    "discretisation": {"grid": 16, "dt": 2e-3},
    "model": {"density": 1000.0, "elasticity": {"law": "fixed_corotated", "young": 5e4, "poisson": 0.3}},
    "body": {"shape": "box", "lower": [0.32, 0.1, 0.37], "upper": [0.68, 0.35, 0.63], "spacing": 0.036, "jitter": 0.5},
    "velocity": [0.0, -1.8, 0.3],
}
FILM = Film(views=6, held_out=(2,), width=64, height=64, frames=13, substeps=9, density=3, angle=26.0, target=(0.5, 0.25, 0.5))
SCALE, SHIFT = 0.1, (0.5, 0.0, 0.5)
BACKGROUND = np.array([150, 160, 140])


@pytest.fixture(scope="module")
def video(tmp_path_factory) -> tuple[Path, torch.Tensor]:
    """A folder as a user has it, and the true motion (T, P, 3).

    Decimetres from the middle of the floor, z up, a plain grey-green background, one view for tests.
    """
    (made,) = make_scenes([BOX], FILM, tmp_path_factory.mktemp("made"), draw=rasterize, device="cpu", progress=False)
    (file,) = made.glob("*/transforms.json")
    content, folder = json.loads(file.read_text()), tmp_path_factory.mktemp("user") / "my-video"
    turn = np.asarray(UP["z"], dtype=float)
    (folder / "images").mkdir(parents=True)
    frames, tests = [], []
    for entry in content["frames"]:
        pose = np.array(entry["transform_matrix"])
        pose[:3] = np.c_[turn.T @ pose[:3, :3], turn.T @ (pose[:3, 3] - SHIFT) / SCALE]
        image = cv2.imread(str(file.parent / entry["file_path"]), cv2.IMREAD_UNCHANGED).astype(float)
        alpha = image[..., 3:] / 255
        name = f"images/{entry['view']}-{len(frames):03d}.png"
        cv2.imwrite(str(folder / name), (alpha * image[..., :3] + (1 - alpha) * BACKGROUND[::-1]).round().astype(np.uint8))
        frames.append({"file_path": name, "transform_matrix": pose.tolist(), "time": entry["time"], "view": entry["view"]})
        if str(entry["view"]) == "2":
            tests.append(name)
    given = content | content["frames"][0]
    lens = {key: given[key] for key in ("fl_x", "fl_y", "cx", "cy", "w", "h")}
    (folder / "transforms.json").write_text(json.dumps(lens | {"test_filenames": tests, "frames": frames}))
    return folder, read_truth(made).x


def neuido(*arguments: str) -> None:
    with pytest.raises(SystemExit) as ended:
        main(list(arguments))
    assert ended.value.code == 0


@pytest.mark.slow
def test_from_images_to_a_law_in_three_commands(video, tmp_path, monkeypatch):
    video, truth = video
    monkeypatch.chdir(tmp_path)
    placing = ["--scale", str(SCALE), "--shift", str(list(SHIFT)), "--up", "z", "--velocity", "[0.0, -1.8, 0.3]"]
    small = ["--steps", "150", "--start", "500", "--gaussians", "900", "--particles", "900", "--resolution", "48", "--device", "cpu"]
    neuido("reconstruct", str(video), *placing, *small, "--progress", "false")
    scene = [
        "--config",
        "predict",
        "--model.init_from",
        "pretrained-small",
        "--data.root",
        str(video.parent),
        "--data.scenes",
        "[my-video]",
    ]
    quiet = ["--trainer.accelerator", "cpu", "--trainer.enable_progress_bar", "false", "--model.out", str(tmp_path / "out")]
    neuido("predict", *scene, *quiet)
    neuido("test", *scene, *quiet)

    assert not (tmp_path / "config.yaml").exists()  # of which a second command would be afraid
    figures = json.loads((video / "reconstruction" / "report.json").read_text())
    assert figures["psnr_held_out"] > 25
    assert figures["volume"] == pytest.approx(0.36 * 0.25 * 0.26, rel=0.2)  # in cubic metres of the simulation, not of the user
    folder = tmp_path / "out" / "my-video"
    modulus = json.loads((folder / "law.json").read_text())["modulus"]
    assert 2e4 < modulus < 3e5  # the true P-wave modulus is 6.7e4
    elastic, _ = load_law(folder / "law.safetensors")
    assert float(elastic.modulus()[0]) == pytest.approx(modulus, rel=1e-5)
    clouds = [read_ply_vertices(folder / "particles" / f"{k:03d}.ply") for k in range(13)]
    assert len(clouds[0]) == figures["particles"]
    centre = torch.tensor(np.array([[float(cloud[axis].mean()) for axis in "xyz"] for cloud in clouds]), dtype=torch.float32)
    assert (centre - truth.mean(1)).norm(dim=1).max() < 0.03  # m; it falls by 0.12 m and rises by 0.17 m
    assert cv2.VideoCapture(str(folder / "prediction.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == 13
    (row,) = csv.DictReader((tmp_path / "out" / "scores.csv").open())
    assert "cd" not in row and float(row["psnr"]) > 22  # no truth, no distance; images of the view that was held out
    images = list(csv.DictReader((folder / "images.csv").open()))
    assert {image["view"] for image in images} == {"2"} and len(images) == 12
    assert torch.isfinite(torch.tensor([float(image["ssim"]) for image in images])).all()
