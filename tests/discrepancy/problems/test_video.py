"""Diagnosis from silhouettes alone."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import yaml

from neuido.data.measured.experiment import read_experiment
from neuido.data.scenes.synthetic import surround_with_gaussians
from neuido.discrepancy.inference.search.attribution import diagnose
from neuido.discrepancy.problems import silhouettes
from neuido.discrepancy.problems.filmed import Splats, looks, read_film
from neuido.discrepancy.problems.silhouettes import View
from neuido.discrepancy.problems.video import VideoProblem, video_problem
from neuido.models.render.gaussians import harmonics_of, save_gaussians
from neuido.types import Gaussians, ParticleState
from tests import command
from tests.discrepancy import made

EFFECTS = {"drag_linear.k": 4.0}


def run(capsys, *args) -> tuple[int, str, str]:
    return command.run(capsys, "diagnose", *args)


def disc(x: float, y: float, radius: float, size: int = 64) -> np.ndarray:
    """A soft disc (size, size), averaged over each pixel."""
    fine = (np.arange(8 * size) + 0.5) / 8
    inside = (fine[None] - x) ** 2 + (fine[:, None] - y) ** 2 < radius**2
    return inside.reshape(size, 8, size, 8).mean(axis=(1, 3)).astype(np.float32)


WHOLE = np.array([[0.0, 0.0, 64.0, 64.0]])


def test_outlines_measure_shift_and_growth_of_a_disc():
    first, moved, grown = (torch.from_numpy(disc(*a))[None] for a in ((30.3, 33.1, 14.0), (32.0, 31.9, 14.0), (30.3, 33.1, 15.5)))
    at = silhouettes.outlines(first.numpy(), WHOLE)
    assert float(at.perimeter) == pytest.approx(2 * np.pi * 14, rel=0.02)
    outward = at.points[0] - torch.tensor([30.3, 33.1])
    assert torch.allclose(at.normals[0], outward / outward.norm(dim=1, keepdim=True), atol=0.06)
    base = silhouettes.features(first, at)
    shift = (silhouettes.features(moved, at) - base)[0]
    torch.testing.assert_close(shift[:2], torch.tensor([1.7, -1.2]), atol=0.02, rtol=0)
    torch.testing.assert_close(shift[silhouettes.MOMENTS :], at.normals[0] @ torch.tensor([1.7, -1.2]), atol=0.25, rtol=0)
    wider = (silhouettes.features(grown, at) - base)[0]
    torch.testing.assert_close(wider[silhouettes.MOMENTS :], torch.full((silhouettes.SAMPLES,), 1.5), atol=0.12, rtol=0)
    assert float(wider[2]) == pytest.approx(1.5 * (1 + 1.5 / 28), rel=0.03)


def test_a_camera_that_is_off_shows_what_a_warped_image_shows():
    from neuido.discrepancy.problems.video import _warped

    box = np.zeros((64, 64), np.float32)
    box[20:40, 14:46] = 1.0
    mask = torch.from_numpy(cv2.GaussianBlur(box, (0, 0), 1.0))[None]
    at = silhouettes.outlines(mask.numpy(), WHOLE)
    view = View(1.2, -0.7, 0.02, 0.03)
    # corners are cut by interpolation: a tenth of a pixel
    torch.testing.assert_close(silhouettes.features(mask, at, view), silhouettes.features(_warped(mask, view), at), atol=0.12, rtol=0.0)


def test_displaced_is_the_slope_of_features():
    mask = torch.from_numpy(disc(30.3, 33.1, 14.0))[None]
    at = silhouettes.outlines(mask.numpy(), WHOLE)
    columns = silhouettes.displaced(at, mask)[0]
    shifted = (silhouettes.features(torch.from_numpy(disc(30.8, 33.1, 14.0))[None], at) - silhouettes.features(mask, at))[0]
    torch.testing.assert_close(0.5 * columns[:, 0], shifted, atol=0.1, rtol=0)
    stretched = (columns[:, 2] + columns[:, 5]) * 0.5  # as a growth by half a pixel at `size` from the centroid
    grown = silhouettes.features(torch.from_numpy(disc(30.3, 33.1, 14.0 * (1 + 0.5 / float(at.size))))[None], at)
    torch.testing.assert_close(stretched, (grown - silhouettes.features(mask, at))[0], atol=0.15, rtol=0.05)


def test_what_leaves_the_image_is_left_out():
    mask = disc(2.0, 32.0, 14.0)
    at = silhouettes.outlines(mask[None], WHOLE)
    assert not at.kept[0, : silhouettes.MOMENTS].any()
    own = at.kept[0, silhouettes.MOMENTS :]
    assert 0 < own.sum() < len(own)
    assert (at.points[0][own][:, 0] > 1.5).all()


def test_score_of_two_discs():
    a, b = disc(30.0, 32.0, 14.0)[None], disc(31.0, 32.0, 14.0)[None]
    same, other = silhouettes.score(a, a), silhouettes.score(a, b)
    assert same.iou == 1.0
    assert same.outline < 0.2
    assert other.outline == pytest.approx(2 / np.pi, abs=0.15)  # the mean of |cos| on a circle
    assert silhouettes.inset(disc(30.0, 32.0, 15.0)[None], a) == pytest.approx(1.0, abs=0.15)
    assert silhouettes.score(disc(30.0, 32.0, 15.0)[None], a, 1.0).iou > 0.98


@pytest.fixture(scope="module")
def folders(tmp_path_factory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("filmed")
    options = {"frames": 10, "side": 4, "width": 72}
    made.filmed(root / "drag", EFFECTS, **options)
    made.filmed(root / "null", {}, **options)
    made.filmed(root / "hull", EFFECTS, particles=False, views=6, frames=8, side=4, width=72)
    made.filmed(root / "turning", EFFECTS, **options, turn=50.0)
    return {name: root / name for name in ("drag", "null", "hull", "turning")}


def problem_of(folder: Path, *names: str, settings: int = 2) -> VideoProblem:
    """The problem with few candidates and one solver, so that it is quick."""
    found = video_problem(read_experiment(folder))
    return replace(found, candidates=tuple(c for c in found.candidates if c.name in names), solvers=(0,), settings=settings)


def test_the_truth_is_at_the_noise_and_the_declared_model_is_not(folders):
    problem = problem_of(folders["drag"])
    truth, declared = problem.predict([{"young": 6e4, **EFFECTS}, {}], 0)
    y, noise = problem.recordings[0].y, problem.recordings[0].noise
    assert problem.error(truth - y, 0) < 1.5 * noise
    assert problem.error(declared - y, 0) > 3 * noise
    assert noise < 0.5
    drawn = problem.predict([{"camera_x0:throw": problem.parameter("camera_x0:throw").value + 0.5}, {}], 0)
    first = problem.recordings[0].groups % (silhouettes.MOMENTS + silhouettes.SAMPLES) == 0
    view = problem.recordings[0].groups // (silhouettes.MOMENTS + silhouettes.SAMPLES)
    np.testing.assert_allclose((drawn[0] - drawn[1])[first & (view == 0)], 0.5, atol=1e-3)
    np.testing.assert_allclose((drawn[0] - drawn[1])[view == 1], 0.0, atol=1e-6)


@pytest.mark.slow
def test_drag_is_found_from_video_alone(folders):
    d = diagnose(problem_of(folders["drag"], "drag_linear", "viscosity_shear"), draws=39, most=1)
    assert d.answer == "effect"
    assert [t.candidate.name for t in d.effects] == ["drag_linear"]
    assert d.after["drag_linear.k"] == pytest.approx(4.0, rel=0.2)
    assert d.errors["after"]["drop"] < 0.35 * d.errors["before"]["drop"]
    shown = d.problem.silhouettes(d)
    for name, role in (("throw", "fit"), ("drop", "held_out")):
        before, after = (shown[name]["scores"][when][role] for when in ("before", "after"))
        assert after["iou"] > 0.93 > before["iou"]
        assert after["outline_px"] < 0.5 * before["outline_px"]
        assert after["outline_mm"] == pytest.approx(after["outline_px"] * problem_of(folders["drag"]).footage[0].millimetres, rel=0.05)


@pytest.mark.slow
def test_nothing_is_found_where_nothing_is_missing(folders):
    d = diagnose(problem_of(folders["null"], "drag_linear", "viscosity_shear", "uniform_acceleration"), draws=39)
    assert d.answer == "none"
    assert d.effects == []


@pytest.mark.slow
def test_a_body_is_made_of_silhouettes_where_none_is_given(folders):
    experiment = read_experiment(folders["hull"])
    assert experiment.recordings[0].body is None
    problem = problem_of(folders["hull"])
    body, truth = problem.measured[0].body, made.body((0.9, 0.6, 0.2), 5.0, 0.42, 4)
    assert float(body.volume.sum()) == pytest.approx(0.033, rel=0.25)  # a hull is never too small: the body has 0.027 m^3
    np.testing.assert_allclose(body.x.mean(dim=0), truth.x.mean(dim=0), atol=0.02)
    np.testing.assert_allclose(body.v.mean(dim=0), [0.9, 0.6, 0.2], atol=0.15)
    loose, firm = (problem_of(folders[name]).parameter("velocity_x:throw").scale for name in ("hull", "drag"))
    assert loose > 3 * firm
    assert problem.error(problem.predict([EFFECTS], 0)[0] - problem.recordings[0].y, 0) < 4.0


def test_cameras_that_turn_about_the_body_show_what_fixed_ones_show(folders):
    turning, fixed = problem_of(folders["turning"]), problem_of(folders["drag"])
    assert turning.footage[0].cameras.moving and not fixed.footage[0].cameras.moving
    truth, declared = turning.predict([{"young": 6e4, **EFFECTS}, {}], 0)
    y, noise = turning.recordings[0].y, turning.recordings[0].noise
    assert noise == pytest.approx(fixed.recordings[0].noise, rel=0.3)  # of the first frame, in which the cameras stand in the same places
    assert turning.error(truth - y, 0) < 1.5 * noise
    assert turning.error(declared - y, 0) > 3 * noise
    still = replace(turning, footage=tuple(f._replace(cameras=f.cameras.at(0)) for f in turning.footage))
    assert still.error(still.predict([{"young": 6e4, **EFFECTS}], 0)[0] - y, 0) > 5 * noise


@pytest.mark.slow
def test_drag_is_found_by_cameras_that_turn_about_the_body(folders):
    d = diagnose(problem_of(folders["turning"], "drag_linear", "viscosity_shear"), draws=39, most=1)
    assert d.answer == "effect"
    assert [t.candidate.name for t in d.effects] == ["drag_linear"]
    assert d.after["drag_linear.k"] == pytest.approx(4.0, rel=0.2)  # as by fixed cameras, above


@pytest.mark.slow
def test_a_body_is_made_of_silhouettes_of_cameras_that_turn(folders, tmp_path):
    made.filmed(tmp_path / "hull", EFFECTS, particles=False, views=6, frames=8, side=4, width=72, turn=50.0)
    turned, fixed = (problem_of(folder).measured[0].body for folder in (tmp_path / "hull", folders["hull"]))
    assert torch.equal(turned.x, fixed.x)
    np.testing.assert_allclose(turned.v.mean(dim=0), fixed.v.mean(dim=0), atol=0.05)


def test_gaussians_of_the_folder_are_what_is_drawn(folders, tmp_path):
    folder = tmp_path / "folder"
    shutil.copytree(folders["drag"], folder)
    for r in read_experiment(folder).recordings:
        dense = surround_with_gaussians(r.body, 27, seed="splats")
        means, covariances = dense.at(r.body.x[None], torch.eye(3).expand(1, len(r.body.x), 3, 3))
        opacity = torch.full((means.shape[1],), 0.9)
        save_gaussians(folder / r.name / "gaussians.ply", Gaussians(means[0], covariances[0], opacity, harmonics_of(dense.colour)))
    problem = problem_of(folder)
    assert all(isinstance(f.look, Splats) for f in problem.footage)
    (truth,) = problem.predict([{"young": 6e4, **EFFECTS}], 0)
    assert problem.error(truth - problem.recordings[0].y, 0) < 2 * problem.recordings[0].noise


@pytest.mark.slow
def test_command_writes_the_silhouettes(folders, tmp_path, capsys):
    """The whole command, with its report; the model that comes out, put back, lacks nothing."""
    folder = tmp_path / "folder"
    shutil.copytree(folders["drag"], folder)
    options = ["--effects", "drag_linear", "--draws", "19", "--data", "video", "--device", "cpu"]
    status, out, err = run(capsys, folder, "--out", tmp_path / "out", *options)
    assert status == 0, err
    assert out.startswith("The model lacks linear air drag: k = ") and "Held-out error" in out and " px before" in out
    content = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert (content["error"]["measure"], content["error"]["unit"]) == ("outline", "px")
    own = content["silhouettes"]["drop"]
    assert own["after"]["held_out"]["iou"] > own["before"]["held_out"]["iou"]
    page = (tmp_path / "out" / "report.html").read_text()
    assert "data:image/png" in page
    assert "overlap (IoU)" in page
    with np.load(tmp_path / "out" / "predicted" / "drop.npz") as archive:
        assert archive["masks"].shape == archive["drawn_after"].shape
        off = {when: np.abs(archive["masks"].astype(float) - archive[f"drawn_{when}"]).mean() for when in ("before", "after")}
        assert off["after"] < off["before"]
    status, out, err = run(
        capsys, folder, "--out", tmp_path / "second", *options, "--model", tmp_path / "out" / "model_after.yaml", "--max_effects", "1"
    )
    assert status == 0, err
    assert out.startswith("Nothing is missing")


def test_measured_film_shows_the_body_that_goes_with_it(data_root):
    """The silicone bar: eight frames are fitted, five held out, and the body of t = 0 covers the first silhouette."""
    experiment = read_experiment(data_root / "measured" / "silicone-video")
    (r,) = experiment.recordings
    film = read_film(experiment, r)
    assert film.masks.shape[:2] == (13, 1)
    t = film.times.numpy()
    assert np.sum(t[1:] <= t[1] + 0.6 * (t[-1] - t[1])) + 1 == 8
    motion = ParticleState(r.body.x[None], r.body.v[None], torch.zeros(1, len(r.body.x), 3, 3), r.body.F[None])
    drawn = looks(r, experiment, r.body, film, "cpu").draw(motion, film.cameras)[0].numpy()
    inside = silhouettes.inset(drawn, film.masks[0])
    assert abs(inside) < 1.0
    assert silhouettes.score(drawn, film.masks[0], inside).iou > 0.85


def edit(change):
    def done(folder: Path) -> None:
        path = folder / "throw" / "transforms.json"
        content = json.loads(path.read_text())
        change(content)
        path.write_text(json.dumps(content))

    return done


def images(change):
    def done(folder: Path) -> None:
        for path in sorted((folder / "throw" / "images").iterdir()):
            cv2.imwrite(str(path), change(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)))

    return done


def roles(folder: Path) -> None:
    content = yaml.safe_load((folder / "experiment.yaml").read_text())
    for recording in content["recordings"]:
        recording["role"] = "held_out"
    (folder / "experiment.yaml").write_text(yaml.safe_dump(content))


def moved(content: dict) -> None:
    for frame in content["frames"]:
        frame["transform_matrix"][0][3] += 0.6


def turned(content: dict) -> None:
    for frame in content["frames"]:
        for row in frame["transform_matrix"][:3]:
            row[0], row[2] = -row[0], -row[2]


def one_view(folder: Path) -> None:
    for name in ("throw", "drop"):
        path = folder / name / "transforms.json"
        content = json.loads(path.read_text())
        content["frames"] = [f for f in content["frames"] if f["view"] == 0]
        path.write_text(json.dumps(content))


def cut_short(folder: Path) -> None:
    path = sorted((folder / "throw" / "images").iterdir())[3]
    path.write_bytes(path.read_bytes()[:60])


WRONG = {  # folder, what is done to it, words of the line
    "no-video": ("drag", lambda f: (f / "throw" / "transforms.json").unlink(), "transforms.json"),
    "no-image": ("drag", lambda f: sorted((f / "throw" / "images").iterdir())[2].unlink(), "throw"),
    "cut-short": ("drag", cut_short, "image"),
    "not-json": ("drag", lambda f: (f / "throw" / "transforms.json").write_text("{"), "transforms.json"),
    "no-frames": ("drag", edit(lambda c: c.update(frames=[])), "frames"),
    "three-frames": ("drag", edit(lambda c: c.update(frames=[f for f in c["frames"] if f["time"] < 0.05])), "at least 4"),
    "no-pose": ("drag", edit(lambda c: c["frames"][0].pop("transform_matrix")), "transform_matrix"),
    "no-focal-length": ("drag", edit(lambda c: [entry.pop("fl_x", None) for entry in (c, *c["frames"])]), "fl_x"),
    "lens": ("drag", edit(lambda c: c.update(camera_model="FISHEYE")), "FISHEYE"),
    "outside": ("drag", edit(lambda c: c["frames"][0].update(file_path="../../../secret.png")), "file_path"),
    "camera-beside": ("drag", edit(moved), "transform_matrix"),
    "camera-behind": ("drag", edit(turned), "behind"),
    "nothing-seen": ("drag", images(np.zeros_like), "no object"),
    "no-mask": ("drag", images(lambda a: np.full_like(a, 255)[..., :3]), "first frame"),
    "role": ("drag", roles, "role"),
    "one-view-no-body": ("hull", one_view, "one view"),
    "hull-outside": ("hull", edit(moved), "domain"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_video_is_one_line(name, folders, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("neuido.discrepancy.inference.search.attribution.diagnose", None)  # nobody gets as far
    kind, spoil, word = WRONG[name]
    folder = tmp_path / "folder"
    shutil.copytree(folders[kind], folder)
    spoil(folder)
    status, out, err = run(capsys, folder, "--out", tmp_path / "out", "--data", "video", "--device", "cpu")
    assert (status, len(err.splitlines()), out) == (2, 1, ""), err
    assert err.startswith("neuido: ")
    assert word in err
    assert not (tmp_path / "out").exists()


def test_points_are_taken_where_they_are_unless_told_otherwise(folders, tmp_path, capsys):
    from neuido.discrepancy.workflow import problems_of

    (points,), (film,), (alone,) = (
        problems_of("experiment", folders[name], None, "cpu", data=data)
        for name, data in (("drag", "auto"), ("drag", "video"), ("hull", "auto"))
    )
    assert [isinstance(p, VideoProblem) for p in (points, film, alone)] == [False, True, True]
    status, _, err = run(capsys, folders["drag"], "--out", tmp_path / "out", "--data", "sound")
    assert (status, len(err.splitlines())) == (2, 1)
    assert "sound" in err
    status, _, err = run(capsys, folders["hull"], "--out", tmp_path / "out", "--data", "points")
    assert (status, len(err.splitlines())) == (2, 1)
    assert "particles.npz" in err
