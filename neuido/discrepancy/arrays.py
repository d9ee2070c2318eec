"""Measured arrays written as a folder of one of the three formats, so that arrays are read and checked like files."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from neuido.data.files.values import file_name
from neuido.data.files.writing import write_text
from neuido.errors import UserError

TRACK, TEST, BODY = ("x", "y", "z", "angle"), ("stretch", "log_strain", "shear"), ("x0", "v0", "volume")
PARTICLES = ("x", "t", *BODY, "F0", "track", "anchor")
BODY_NAME = "body"


def write_arrays(
    data: Mapping[str, Mapping[str, Any]], model: Mapping[str, Any] | None, folder: Path, *, scene: Mapping[str, Any] | None = None
) -> Path:
    """Write measured arrays as a folder that `neuido diagnose` takes, and return the folder.

    Args:
        data: Recordings by name. Each is a mapping with its columns, named as in the formats, and the other keys of its entry, such as
            `role` (`fit` where absent), `noise` or `mode`. A track has `t` [s] and `x`, `y`, `z` [m] or `angle` [rad]. A material test
            has for example `stretch` and `nominal_stress` [Pa], and possibly `time` [s]. A body has `x` (T, N, 3) [m], `t` (T,) [s], `x0`,
            `v0`, `volume`, and `track` or `anchor`.
        model: Declared model, as the key `model` of the format. For a track it may also have `mass` and `diameter` of the body.
        folder: Empty folder.
        scene: For bodies only: the keys of `scene` and `discretisation` (`domain`, `gravity`, `colliders`, `grid`, `dt`) together.

    Raises:
        UserError: There are no recordings, columns are of an unknown kind or of different lengths, the model is missing, or a scene is
            missing or not allowed.
    """
    if not data or not all(isinstance(columns, Mapping) for columns in data.values()):
        raise UserError("arrays: give each recording's columns by its name: {'drop': {'t': t, 'y': y}}")
    if not isinstance(model, Mapping):
        raise UserError("arrays have no model of their own: give model, as the key `model` of the format")
    for name in data:
        file_name(name, "the name of a recording")
    names = set(next(iter(data.values())))
    kind = "body" if names & set(BODY) else "test" if any(n.startswith(TEST) for n in names) else "track" if names & set(TRACK) else ""
    if not kind:
        raise UserError(f"arrays: {', '.join(sorted(names))} are no columns of a track, a material test or a body")
    if (scene is not None) != (kind == "body"):
        raise UserError("scene is for arrays of bodies, and they need it: domain, gravity, colliders, grid, dt")
    folder.mkdir(parents=True, exist_ok=True)
    {"body": _write_bodies, "test": _write_tests, "track": _write_tracks}[kind](data, dict(model), folder, scene)
    return folder


def _table(path: Path, columns: Mapping[str, Any]) -> None:
    """Write columns of one length as CSV, with all digits of each number."""
    arrays = {key: np.asarray(values, dtype=np.float64) for key, values in columns.items()}
    if len({a.shape for a in arrays.values()}) != 1 or next(iter(arrays.values())).ndim != 1:
        shapes = ", ".join(f"{key} {a.shape}" for key, a in arrays.items())
        raise UserError(f"arrays of {path.stem}: columns must be vectors of one length, got {shapes}")
    rows = ([repr(float(v)) for v in row] for row in zip(*arrays.values()))
    write_text(path, "".join(f"{','.join(row)}\n" for row in (arrays, *rows)))


def _is_column(value: Any) -> bool:
    return not isinstance(value, str) and np.ndim(value) > 0


def _write_tracks(data: Mapping[str, Mapping[str, Any]], model: dict[str, Any], folder: Path, scene: Any) -> None:
    figures = {key: model.pop(key) for key in ("mass", "diameter", "shape") if key in model}
    recordings = []
    for name, given in data.items():
        columns = {key: given[key] for key in ("t", *TRACK) if key in given}
        more = {key: value for key, value in given.items() if key not in columns}
        _table(folder / f"{name}.csv", columns)
        entry = {"name": name, "body": BODY_NAME, "file": f"{name}.csv", "columns": {key: key for key in columns}}
        recordings.append(entry | {"role": "fit"} | _plain(more))
    content = {"name": "arrays", "model": _plain(model), "bodies": {BODY_NAME: _plain(figures) or None}, "recordings": recordings}
    _write(folder / "track.yaml", {"format": "neuido-track/1"} | content)


def _write_tests(data: Mapping[str, Mapping[str, Any]], model: dict[str, Any], folder: Path, scene: Any) -> None:
    tests = []
    for name, given in data.items():
        columns = {key: value for key, value in given.items() if _is_column(value) and key != "direction"}
        more = {key: value for key, value in given.items() if key not in columns}
        _table(folder / f"{name}.csv", columns)
        entry = {"name": name, "file": f"{name}.csv", "columns": {key: key for key in columns}, "mode": "uniaxial", "role": "fit"}
        tests.append(entry | _plain(more))
    _write(folder / "test.yaml", {"format": "neuido-material-test/1", "name": "arrays", "model": _plain(model), "tests": tests})


def _write_bodies(data: Mapping[str, Mapping[str, Any]], model: dict[str, Any], folder: Path, scene: Any) -> None:
    recordings = []
    for name, given in data.items():
        particles = {key: np.asarray(given[key]) for key in PARTICLES if key in given}
        more = {key: value for key, value in given.items() if key not in particles}
        (folder / name).mkdir()
        write_arrays(folder / name / "particles.npz", particles, compressed=False)
        times = np.asarray(given.get("t", [0.0, 1.0]), dtype=np.float64)
        interval = float(np.median(np.diff(times))) if len(times) > 1 else 1.0
        recordings.append({"name": name, "role": "fit", "frame_interval": interval} | _plain(more))
    grid = {key: scene[key] for key in ("grid", "dt") if key in scene}
    place = {key: value for key, value in scene.items() if key not in grid}
    content = {"name": "arrays", "scene": _plain(place), "model": _plain(model), "discretisation": _plain(grid), "recordings": recordings}
    _write(folder / "experiment.yaml", {"format": "neuido-experiment/1"} | content)


def _plain(value: Any) -> Any:
    """Return a value with Python's own numbers, lists and strings, as YAML needs them."""
    if isinstance(value, Mapping):
        return {str(key): _plain(own) for key, own in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(own) for own in value]
    return value.tolist() if hasattr(value, "tolist") else value


def _write(path: Path, content: Mapping[str, Any]) -> None:
    write_text(path, yaml.safe_dump(dict(content), sort_keys=False))
