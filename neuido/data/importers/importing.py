"""Convert files of testing machines, trackers and motion capture to a folder that `neuido diagnose` reads."""

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from neuido.data.files.parsing import naming
from neuido.data.footage.filming import Filming
from neuido.data.footage.video_frames import is_video
from neuido.data.importers.checked_folder import write_checked
from neuido.data.importers.testing_machine import Specimen, read_machine
from neuido.data.importers.titled_tables import read_cells
from neuido.data.importers.tracker_exports import Motion, read_motion
from neuido.data.importers.units import conversion_factor
from neuido.errors import UserError

KINDS = ("auto", "material", "track", "body")


def import_file(
    files: str | os.PathLike | Sequence[str | os.PathLike],
    out: str | os.PathLike | None,
    *,
    kind: str = "auto",
    mode: str = "uniaxial",
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    specimen: Specimen | None = None,
    filming: Filming | None = None,
    compression: bool = False,
    density: float | None = None,
    young: float | None = None,
    poisson: float | None = None,
    scale: float | None = None,
    y_down: bool = False,
    up: str = "y",
    frame_rate: float | None = None,
    point: str | None = None,
    mass: float | None = None,
    diameter: float | None = None,
    volume: float | None = None,
    floor: float | None = None,
    held_out: Sequence[str] = (),
) -> list[str]:
    """Convert files of a testing machine, a tracker or a camera to a folder for `neuido diagnose`.

    `neuido import --help` describes the options.

    Args:
        files: One file per recording.
        out: The folder to create; it must not exist. None: check the files and write nothing.

    Returns:
        The lines of the summary: what each column was taken for, in which unit, and what was assumed.

    Raises:
        UserError: A file cannot be read, or something is missing. The message names the option that supplies it.
    """
    paths = [Path(file).expanduser() for file in ([files] if isinstance(files, str | os.PathLike) else files)]
    if not paths:
        raise UserError("no file is given: name at least one")
    if kind not in KINDS:
        raise UserError(f"--kind {kind} is unknown: choose from {', '.join(KINDS)}")
    if up not in ("y", "z"):
        raise UserError(f"--up {up} must be y or z")
    if out is not None and Path(out).expanduser().exists():
        raise UserError(f"--out {out} exists already: give another folder")
    for path in paths:
        if not path.is_file():
            raise UserError(f"{path} is missing" if not path.exists() else f"{path} is not a file")
    names = [re.sub(r"[^\w-]+", "-", path.stem).strip("-_") or f"recording-{i}" for i, path in enumerate(paths)]
    if len(set(names)) < len(names):
        raise UserError(f"two files give a recording the same name ({', '.join(names)}): rename one of them")
    unknown = [name for name in held_out if name not in names]
    if unknown:
        raise UserError(f"--held_out has the unknown recording {unknown[0]!r}: choose from {', '.join(names)}")
    held = set(held_out) or (set(names[-1:]) if len(names) > 1 else set())
    if len(held) == len(names):
        raise UserError("--held_out lists every recording: leave at least one to fit")
    roles = {name: "held_out" if name in held else "fit" for name in names}
    columns, units = dict(columns or {}), dict(units or {})
    summary: list[str] = []
    filming, sheet = filming or Filming(), None
    if films := [path for path in paths if is_video(path)]:
        from neuido.data.footage.contact_sheet import Sheet

        if len(films) < len(paths):
            raise UserError(
                f"{films[0].name} is a video and {next(p for p in paths if p not in films).name} is not: import them one by one"
            )
        sheet = Sheet()
        if filming.cameras is None and kind not in ("auto", "track"):
            raise UserError(f"--kind {kind} is not for videos: leave it out, and give --cameras if the clips are views of one motion")
    with naming(paths[0]):
        chosen = "track" if films else _kind(paths[0], columns) if kind == "auto" else kind
    if chosen == "material":
        tables, tests, secants = {}, [], []
        for path, name in zip(paths, names):
            with naming(path):
                measured = read_machine(path, specimen or Specimen(), mode, columns, units, compression)
                secants.append(_modulus(measured.columns))
            summary += [f"{path.name}: {note}" for note in measured.summary]
            tables[f"{name}.csv"] = measured.columns
            quantities = {key: key for key in measured.columns}
            tests.append({"name": name, "file": f"{name}.csv", "mode": mode, "columns": quantities, "role": roles[name]})
        guess = young or float(f"{np.median(secants):.2g}")
        summary.append(f"model: neo-Hooke, Young's modulus {guess:g} Pa {'as given' if young else 'from the first rows'}, fitted; density "
                    f"{density or 1000.0:g} kg/m^3{'' if density else ' (assumed: --density)'}")  # fmt: skip
        nu = poisson if poisson is not None else 0.499
        model = {"density": density or 1000.0, "elasticity": {"law": "neo_hookean", "young": guess, "poisson": nu},
                 "plasticity": {"law": "identity"}, "free": ["young"]}  # fmt: skip
        if poisson is None:
            model["incompressible"] = True
            summary.append("incompressible (else give --poisson)")
        content = {"format": "neuido-material-test/1", "name": names[0], "model": model, "tests": tests}
        _write(out, "test.yaml", content, tables)
    elif chosen == "track":
        tables, recordings, scale_error = {}, [], 0.0
        for path, name in zip(paths, names):
            with naming(path):
                if sheet is None:
                    motion = read_motion(path, columns)
                else:
                    from neuido.data.footage.centre_track import read_centres

                    found = read_centres(path, filming, frame_rate=frame_rate, diameter=diameter, scaled=scale is not None, sheet=sheet)
                    motion = Motion(found.t, {"object": found.x}, found.unit, False, found.notes)
                    scale_error = max(scale_error, found.scale_error)
                t, points, notes = _motion(path, motion, scale, y_down and sheet is None, up, frame_rate, units)
                x = _one_point(points, point, path)
            summary += [f"{path.name}: {note}" for note in notes]
            seen = np.isfinite(x).all(axis=1)
            if seen.sum() < 3:
                raise UserError(f"{path.name}: the point is seen in {seen.sum()} frames; at least 3 are needed")
            if not seen.all():
                summary.append(f"{path.name}: {int((~seen).sum())} frames without the point are left out")
            axes = "xyz"[: x.shape[1]]
            tables[f"{name}.csv"] = {"t": t[seen] - t[seen][0], **{axis: x[seen, a] for a, axis in enumerate(axes)}}
            recordings.append({"name": name, "body": "body", "file": f"{name}.csv", "columns": {key: key for key in ("t", *axes)},
                               "role": roles[name]})  # fmt: skip
        figures = {key: value for key, value in (("mass", mass), ("diameter", diameter)) if value is not None}
        if len(figures) < 2:
            summary.append("mass or diameter of the body is unknown (--mass in kg, --diameter in m): forces are reported per unit mass")
        content = {"format": "neuido-track/1", "name": names[0], "model": {"gravity": [0.0, -9.81, 0.0]}, "bodies": {"body": figures},
                   "recordings": recordings}  # fmt: skip
        if scale_error:
            content["nuisances"] = {"length_scale": float(f"{scale_error:.2g}")}
        _write(out, "track.yaml", content, tables)
    else:
        from neuido.data.importers.deforming import write_deforming_body

        takes = {}
        for path, name in zip(paths, names):
            with naming(path):
                t, points, notes = _motion(path, read_motion(path, columns), scale, y_down, up, frame_rate, units)
            summary += [f"{path.name}: {note}" for note in notes]
            takes[name] = (t, points)
        with naming(paths[0]):
            summary += write_deforming_body(
                takes, out, roles=roles, density=density, young=young, poisson=poisson, volume=volume, floor=floor
            )
    if sheet is not None and filming.picture is not None:
        sheet.write(Path(filming.picture).expanduser())
        summary.append(f"contact sheet in {filming.picture}")
    if out is not None:
        summary.append(f"next: neuido check {out}; neuido diagnose {out} --out {out}-answer")
    return summary


def _kind(path: Path, columns: Mapping[str, str]) -> str:
    """Detect what a file contains; return `material`, `track` or `body`."""
    from neuido.data.importers.titled_tables import read_titled
    from neuido.data.importers.titles import find_columns

    if path.suffix.lower() in (".c3d", ".trc"):
        return "track"
    rows, _ = read_cells(path)
    first = rows[0][0].lower() if rows and rows[0] else ""
    if first in ("scorer", "trajectories", "format version") or first.startswith("pathfiletype"):
        return "track"
    found = find_columns(read_titled(path).titles, dict(columns))
    if {"x", "y", "z"} & set(found) and {"time", "frame"} & set(found):
        return "body" if "id" in found else "track"
    return "material"


def _motion(
    path: Path, motion: Motion, scale: float | None, y_down: bool, up: str, rate: float | None, units: Mapping[str, str]
) -> tuple[np.ndarray, dict[str, np.ndarray], list[str]]:
    """Convert a motion to SI units; return increasing times from 0 [s], points [m] with +y up, and notes for the summary."""
    if not motion.points:
        raise UserError(f"{path.name} contains no positions: name their columns with --columns.x TITLE --columns.y TITLE")
    notes, t = list(motion.notes), motion.t
    if motion.frames:
        if rate is None:
            raise UserError(f"{path.name} has frame numbers and no times: give --frame_rate (frames per second)")
        t = t / rate
    elif "time" in units:
        t = t * conversion_factor(units["time"], "s", "--units.time")
    unit = units.get("x", motion.unit)
    if scale is not None:
        ratio = scale
    elif unit.lower() in ("px", "pixel", "pixels"):
        raise UserError(f"{path.name} has positions in pixels: give --scale (metres per pixel), and --y_down true if y points down")
    else:
        ratio = conversion_factor(unit, "m", f"{path.name}, positions") if unit else 1.0
        notes.append(f"positions in {unit}" if unit else "positions without a unit, taken as metres (--scale)")
    order = np.argsort(t, kind="stable")
    order = order[np.isfinite(t[order])]
    kept = order[np.concatenate([[True], np.diff(t[order]) > 0])] if len(order) else order
    if len(kept) < 3:
        raise UserError(f"{path.name} has {len(kept)} frames with distinct times; at least 3 are needed")
    if (np.diff(order) < 0).any():
        notes.append("rows sorted by time")
    if len(kept) < len(t):
        notes.append(f"{len(t) - len(kept)} rows with a missing or repeated time are left out")
    t = t[kept]
    if t[0] != 0:
        notes.append(f"times start at {t[0]:g} s, which becomes 0 s")
    points = {}
    for name, x in motion.points.items():
        x = x[kept].copy()
        x[(x == -9999).any(axis=1) | (x == 9999).any(axis=1)] = np.nan
        zero = (x == 0).all(axis=1)
        if zero.any() and x.shape[1] == 3 and not zero[0]:
            x[zero] = np.nan
        x = x * ratio
        if y_down and x.shape[1] > 1:
            x[:, 1] *= -1
        if up == "z" and x.shape[1] == 3:
            x = np.stack([x[:, 0], x[:, 2], -x[:, 1]], 1)
        points[name] = x
    return t - t[0], points, notes


def _one_point(points: Mapping[str, np.ndarray], point: str | None, path: Path) -> np.ndarray:
    """Select the point to track by name; `mean` is the mean of all points."""
    if point == "mean":
        return np.mean(list(points.values()), axis=0)
    if point is None and len(points) == 1:
        return next(iter(points.values()))
    if point is None or point not in points:
        raise UserError(
            f"{path.name} has the points {', '.join(list(points)[:12])}: select one with --point NAME, or give --point mean or --kind body"
        )
    return points[point]


def _modulus(columns: Mapping[str, np.ndarray]) -> float:
    """Estimate Young's modulus [Pa] from the rows of smallest strain, as the starting value of the fit."""
    path, stress = next(iter(columns.values())), next(values for key, values in columns.items() if "stress" in key)
    strain = path - (0.0 if next(iter(columns)) in ("shear", "log_strain") else 1.0)
    kept = np.abs(strain) > 0.02 * np.abs(strain).max() if len(strain) else strain > 0
    near = np.argsort(np.abs(strain[kept]))[:10]
    secant = float(np.median(np.abs(stress[kept][near] / strain[kept][near]))) if kept.any() else 0.0
    if not secant > 0:
        raise UserError("the stress is zero although the specimen deforms: name the right columns with --columns")
    return secant * (3.0 if next(iter(columns)) == "shear" else 1.0)


def _write(out: str | os.PathLike | None, name: str, content: dict[str, Any], tables: Mapping[str, Mapping[str, np.ndarray]]) -> None:
    """Write CSV tables and their YAML file to a new folder if the reader accepts them; without `out`, only check them."""
    from neuido.data.measured.material_test import read_material_tests
    from neuido.data.measured.track import read_tracks

    def fill(folder: Path) -> None:
        for file, columns in tables.items():
            lines = [",".join(columns), *(",".join(repr(float(v)) for v in row) for row in zip(*columns.values()))]
            (folder / file).write_text("\n".join(lines) + "\n")
        (folder / name).write_text(yaml.safe_dump(content, sort_keys=False, default_flow_style=None, allow_unicode=True))

    write_checked(out, fill, read_tracks if name == "track.yaml" else read_material_tests)
