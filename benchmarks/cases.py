"""Shared inputs that once failed: what each gives now beside what is right.

    NEUIDO_DATA=FOLDER python benchmarks/cases.py --write

runs all cases of FOLDER/cases in about five minutes of one core and prints a table, which --write also puts into research/results/cases.md.
A case is right if the value is within the stated bound, or if the error is a line of `UserError` with the words that name its cause.
The status is 1 if one of them is not.
"""

import argparse
import contextlib
import io
import json
import math
import os
import shutil
import sys
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

import neuido
from neuido.commands.main import main as command
from neuido.data.files.parsing import read_yaml
from neuido.data.files.writing import write_text
from neuido.data.formats.gaussian_ply import read_gaussian_vertices
from neuido.data.scenes.filmed_scene import load_views
from neuido.errors import UserError
from neuido.physics.laws import FixedCorotated
from neuido.types import Body, Scene

PAGE = Path(__file__).parents[1] / "research" / "results" / "cases.md"
HEAD = """# Shared inputs that once failed, one by one

31 small recordings, PLY files, bodies, tracks, material tests and experiments of the kinds that people report (not in the repository).
"Today" is what the case gives by `benchmarks/cases.py`, "right" what its own description asks for; the tests run the same cases where
`NEUIDO_DATA` has them.

"""
YELLOW = (0.1, -0.2, -0.2)
"""Place of the mark that no other one overlaps, in the recordings of four marks [m]."""
REACH = 6
"""Half the width of the window about the mark [px]."""
SHARE = 0.0565
"""Of the images, the object, in the recordings of masks."""
MADE = "tests/data/formats/test_shared_cases.py::"
TABLES = "tests/data/importers/test_plausibility.py::"
CURVES = "tests/discrepancy/test_shared_curves.py::"


class Found(NamedTuple):
    """What a case gives."""

    text: str
    right: bool


class Case(NamedTuple):
    """A shared input."""

    number: int
    wanted: str
    """The right value or line."""
    run: Callable[[Path], Found]
    """Runs the case in its folder."""
    test: str
    """Name of its test."""


def shares(folder: Path, **options) -> Found:
    """Read masks, and compare the share of the object in each view."""
    batch = load_views(folder, **options)
    own = batch.masks.mean(dim=(1, 2, 3)).tolist()
    size = f"{batch.images.shape[3]} x {batch.images.shape[2]} px, " if options else ""
    right = all(abs(share - SHARE) <= 0.002 for share in own) and (not options or tuple(batch.images.shape[2:4]) == (74, 100))
    return Found(f"{size}masks of {', '.join(f'{share:.4f}' for share in own)}", right)


def marks(folder: Path, focal: tuple[float, float] = (110.0, 110.0)) -> Found:
    """Read cameras, and compare the centre of the yellow mark in the images with its projection."""
    found, apart = neuido.read_recording(folder), []
    for view, pose, K in zip(load_views(folder).images[:, 0], found.cameras.viewmats, found.cameras.Ks, strict=True):
        weight = (torch.minimum(view[..., 0], view[..., 1]) - view[..., 2]).clamp(min=0)
        row, column = divmod(int(weight.argmax()), weight.shape[1])
        near = [slice(max(at - REACH, 0), at + REACH + 1) for at in (row, column)]
        own = weight[near[0], near[1]]
        rows, columns = (near[i].start + 0.5 + torch.arange(own.shape[i]) for i in (0, 1))
        seen = torch.stack([(own.sum(0) * columns).sum(), (own.sum(1) * rows).sum()]) / own.sum()
        place = K @ (pose[:3, :3] @ torch.tensor(YELLOW) + pose[:3, 3])
        apart.append(float((place[:2] / place[2] - seen).norm()))
    fx, fy = float(found.cameras.Ks[0, 0, 0]), float(found.cameras.Ks[0, 1, 1])
    right = max(apart) < 0.1 and abs(fx - focal[0]) < 1e-3 and abs(fy - focal[1]) < 1e-3 and len(found.views) == 3
    return Found(f"{len(found.views)} views, f = {fx:.6g}, {fy:.6g} px, yellow mark within {max(apart):.2g} px", right)


def line(words: str, run: Callable[[Path], object]) -> Callable[[Path], Found]:
    """Return a case that is right if it is refused in one line with these words."""

    def refused(folder: Path) -> Found:
        try:
            run(folder)
        except UserError as error:
            said = str(error).replace(f"{folder}{os.sep}", "").replace(str(folder), folder.name)
            return Found(f"refused: {said}", words in said and "\n" not in said and len(str(error)) <= 300)
        return Found("no error", False)

    return refused


def vertices(count: int) -> Callable[[Path], Found]:
    """Return a case that is right if its PLY file gives this number of Gaussians, with a line where one of five is left out."""

    def read(folder: Path) -> Found:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            own = len(read_gaussian_vertices(next(folder.glob("*.ply"))))
        told = f", said: {str(said[0].message).replace(f'{folder}{os.sep}', '')}" if said else ""
        return Found(f"{own} Gaussians{told}", own == count and bool(said) == (count < 5))

    return read


def reconstructed(folder: Path, then: Callable[[Path], Found]) -> Found:
    """Reconstruct a copy of a recording as its description asks, and look at it."""
    with tempfile.TemporaryDirectory() as place, contextlib.chdir(place):
        for part in ("images", "transforms.json"):
            (shutil.copytree if (folder / part).is_dir() else shutil.copy)(folder / part, Path(part))
        sizes = ["--steps", "40", "--start", "400", "--gaussians", "400", "--particles", "500", "--resolution", "24"]
        status, said = called("reconstruct", ".", *sizes, "--velocity", "[0,-1.9,0]")
        return then(Path()) if status == 0 else Found(said, False)


def called(*words: str) -> tuple[int, str]:
    """Run a command in this process; return its status and its last line."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        try:
            command(list(words))
        except SystemExit as stop:
            return int(stop.code or 0), (said.getvalue().strip().splitlines() or [""])[-1]
    return 0, ""


def volume(folder: Path) -> Found:
    """Return the volume of the reconstruction."""
    own = json.loads((folder / "reconstruction" / "report.json").read_text())["volume"]
    return Found(f"volume {own:.4f} m^3", abs(own / 0.034 - 1) < 0.05)


def predicted(folder: Path) -> Found:
    """Predict a reconstructed recording with the default options, and read the times."""
    status, said = called("predict", "--config", "predict", "--model.init_from", "pretrained-small", "--data.scenes", "[.]")
    if status:
        return Found(said, False)
    (result,) = (folder / "runs" / "predict").iterdir()
    times = np.loadtxt(result / "particles" / "times.csv", delimiter=",", skiprows=1)[:, -1]
    asked = neuido.read_recording(folder).times.numpy()
    return Found(f"status 0, {len(times)} frames 1/{1 / times[1]:.4g} s apart", np.allclose(times, asked))


def fallen(folder: Path) -> Found:
    """Let one particle fall."""
    x = torch.tensor([[0.5, 0.6, 0.5]])
    body = Body(x, torch.zeros_like(x), torch.full((1,), 1e-6))
    sim = neuido.Simulator(Scene(cells=32, dt=5e-4, walls=None), body, device="cpu")
    y = sim.rollout(100, FixedCorotated(1e5, 0.3), every=100).x[:, 0, 1]
    return Found(f"{float(y[-1] - y[0]):.6f} m", abs(float(y[-1] - y[0]) + 0.012372) < 2e-6)


def crept(folder: Path) -> Found:
    """Let a body move slowly by small steps."""
    axis = torch.linspace(0.4, 0.5, 4)
    x = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    moved = []
    for dt, count, speed in ((1e-5, 5000, 1e-3), (1e-6, 20000, 0.02)):
        body = Body(x, torch.tensor([speed, 0.0, 0.0]).expand(64, 3).contiguous(), torch.full((64,), 1e-6))
        scene = Scene(lower=(0.3,) * 3, upper=(0.7,) * 3, cells=8, dt=dt, walls=None, gravity=(0, 0, 0))
        with torch.no_grad():
            own = neuido.Simulator(scene, body, device="cpu").rollout(count, FixedCorotated(1e6, 0.3), every=count).x
        moved.append(float((own[-1] - own[0])[:, 0].mean()) / (speed * count * dt))
    return Found(f"{5e-5 * moved[0]:.5g} m; at 0.02 m/s {moved[1]:.5f} of its way", max(abs(m - 1) for m in moved) < 2e-3)


def answered(
    *answers: str, error: tuple[float, float] = (0.0, math.inf), floor: bool = False, young: tuple[float, float] | None = None
) -> Callable[[Path], Found]:
    """Return a case that is right if its diagnosis has one of these answers and its figures lie between these values.

    Args:
        answers: The right answers.
        error: Least and largest error of held-out data, or floor.
        floor: Whether the floor is meant.
        young: Least and largest Young's modulus of the fitted model [Pa]; not asked where absent.
    """

    def run(folder: Path) -> Found:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = neuido.diagnose(folder, device="cpu", progress=False)
        value = found.error.floor if floor else found.error.after
        right = found.answer in answers and error[0] <= value <= error[1]
        named = f" ({', '.join(e.name for e in found.effects)})" if found.effects else ""
        text = f"{found.answer}{named}, {'floor' if floor else 'error'} {value:.3g} {found.error.unit}"
        if young is not None:
            own = read_yaml(found.model_after)["elasticity"]["young"]
            right, text = right and young[0] <= own <= young[1], f"{text}, E = {own:.4g} Pa"
        return Found(text, right)

    return run


def dialects(folder: Path) -> Found:
    """Diagnose a table of decimal commas, and import a Tracker export."""
    found = answered("none", "insufficient", young=(1.19e6, 1.206e6))(folder)
    with tempfile.TemporaryDirectory() as place:
        made = Path(place) / "track"
        neuido.import_file(folder / "tracker-export.csv", made, diameter=0.1)
        rows = len(neuido.read_tracks(made).recordings[0].t)
    return Found(f"{found.text}; Tracker export: {rows} frames", found.right and rows == 45)


CASES = (
    Case(1, "100 x 74 px, masks 0.0565 ± 0.002", lambda f: shares(f, width=100), f"{MADE}test_share_of_the_object"),
    Case(2, "0.034 m^3 ± 5 %", lambda f: reconstructed(f, volume), f"{MADE}test_pincushion_keeps_the_volume"),
    Case(3, "masks 0.0565 ± 0.002", shares, f"{MADE}test_share_of_the_object"),
    Case(4, "f = 110, 150 px; within 0.1 px", lambda f: marks(f, (110.0, 150.0)), f"{MADE}test_cameras"),
    Case(5, "refused as a fisheye lens", line("fisheye", neuido.read_recording), f"{MADE}test_refused_by_name"),
    Case(6, "k4 refused by name", line("k4 = 0.3", neuido.read_recording), f"{MADE}test_refused_by_name"),
    Case(7, "the last row is named", line("row by row", neuido.read_recording), f"{MADE}test_refused_by_name"),
    Case(8, "3 views, within 0.1 px", marks, f"{MADE}test_cameras"),
    Case(9, "3 views, f = 110 px, within 0.1 px", marks, f"{MADE}test_cameras"),
    Case(10, "3 views within 0.1 px", marks, f"{MADE}test_cameras"),
    Case(11, "`predict` runs at 30 frames a second", lambda f: reconstructed(f, predicted),
         f"{MADE}test_thirty_frames_a_second_are_predicted"),
    Case(12, "an option that exists", line("frame_interval", neuido.read_recording), f"{MADE}test_refused_by_name"),
    Case(13, "5 Gaussians", vertices(5), f"{MADE}test_gaussians"),
    Case(14, "rows that are not finite are said", vertices(4), f"{MADE}test_gaussians"),
    Case(15, "rows that are not finite are said", vertices(4), f"{MADE}test_gaussians"),
    Case(16, "called compressed, with the way out", line("compressed PLY", lambda f: read_gaussian_vertices(next(f.glob("*.ply")))),
         f"{MADE}test_compressed_gaussians"),
    Case(17, "-0.012372 m", fallen, "tests/physics/mpm/test_degenerate_bodies.py::test_particles_in_one_place_fall_freely"),
    Case(18, "5.0e-5 m", crept, "tests/physics/runtime/test_precision.py::test_a_slow_body_gets_as_far_as_its_speed_takes_it"),
    Case(19, "none, 0.002 m", answered("none", error=(1.4e-3, 2.6e-3)), f"{CURVES}test_cases_of_late_clocks"),
    Case(20, "none, 0.002 m", answered("none", error=(1.4e-3, 2.6e-3)), f"{CURVES}test_cases_of_late_clocks"),
    Case(21, "a hint at units or y; no effect", line("scale: {y: -0.005}", neuido.diagnose), f"{TABLES}test_cases_are_refused"),
    Case(22, "a hint at 1e6; no effect", line("scale 1.0e+6", neuido.diagnose), f"{TABLES}test_cases_are_refused"),
    Case(23, "a hint at percent; no effect", line("strains in percent", neuido.diagnose), f"{TABLES}test_cases_are_refused"),
    Case(24, "none or insufficient, floor 1.5 to 3 kPa", answered("none", "insufficient", error=(1.5e3, 3e3), floor=True),
         f"{CURVES}test_case_of_a_biaxial_grid"),
    Case(25, "the order is no path; no effect", line("loading order", neuido.diagnose), f"{TABLES}test_cases_are_refused"),
    Case(26, "read, E = 1.198 MPa", dialects, "tests/data/importers/test_delimited.py::test_case_of_decimal_commas"),
    Case(27, "none, E 50 ± 1 kPa", answered("none", young=(4.9e4, 5.1e4)), f"{CURVES}test_case_of_unseen_markers"),
    Case(28, "refused when read", line("millimetres", neuido.diagnose), f"{TABLES}test_cases_are_refused"),
    Case(29, "one line", line("no point of x was seen", neuido.diagnose), f"{TABLES}test_cases_are_refused"),
    Case(30, "one line", line("zero in all 25 rows", neuido.diagnose), f"{TABLES}test_cases_are_refused"),
    Case(31, "masks 0.0565", shares, f"{MADE}test_share_of_the_object"),
)  # fmt: skip


def tried(case: Case, root: Path) -> tuple[str, Found]:
    """Return the folder's name, and what a case gives; an error that is none of the user's is a fault."""
    folder = next(root.glob(f"{case.number:02d}-*"))
    try:
        return folder.name, case.run(folder)
    except Exception as error:
        return folder.name, Found(f"{type(error).__name__}: {error}", False)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", type=int, nargs="+", help="numbers of the cases")
    parser.add_argument("--write", action="store_true", help="write the page of results")
    args = parser.parse_args()
    root = Path(os.environ["NEUIDO_DATA"]) / "cases"
    rows = []
    for case in CASES:
        if args.only and case.number not in args.only:
            continue
        name, found = tried(case, root)
        text = " ".join(found.text.replace("|", "/").split())
        rows.append(f"| {name} | {case.wanted} | {text} | {'yes' if found.right else '**no**'} | `{case.test.removeprefix('tests/')}` |")
        print(rows[-1], flush=True)
    wrong = sum("**no**" in row for row in rows)
    print(f"{len(rows) - wrong} of {len(rows)} right")
    if args.write and not args.only:
        table = "\n".join(["| case | right | today | right? | test (in `tests`) |", "| --- | --- | --- | --- | --- |", *rows])
        write_text(PAGE, f"{HEAD}{table}\n\n{len(rows) - wrong} of {len(rows)} right.\n")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
