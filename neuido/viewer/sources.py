"""Read whatever can be viewed: rollouts, runs, experiments, recordings, diagnoses and Gaussian scenes. The files are not trusted."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from neuido.data.files.parsing import naming, read_arrays, read_json, read_yaml
from neuido.data.files.values import vector
from neuido.data.formats.frame_files import numbered_files, picked, read_frame_arrays, read_frame_times, read_surfaces
from neuido.data.formats.ply import read_ply_header, read_ply_vertices
from neuido.errors import UserError
from neuido.models.inference.simulated_run import scene_and_laws
from neuido.types import Gaussians, Plane
from neuido.viewer.content import Content, Motion, moved_surface, place_side_by_side, skin_surface, with_scene
from neuido.viewer.quantities import stress_by_body, stress_of

RATE = 20.0
"""Frames a second at which motions without times are played: that of the videos of `neuido predict`."""
KINDS = (
    "a rollout (.npz), a folder of `neuido simulate`, `neuido predict` or `neuido diagnose`, an experiment, a recording, PLY files of "
    "particles or Gaussians, or a scene file (.yaml)"
)


def read_content(path: str | Path, recording: str | None = None) -> Content:
    """Read what a file or a folder holds.

    Args:
        path: The file or folder.
        recording: Name of the recording, body or scene to show, where there are several; the first where absent.

    Raises:
        UserError: Nothing there can be viewed, or a file is damaged.
    """
    place = Path(path).expanduser()
    if not place.exists():
        raise UserError(f"{path} is missing: give {KINDS}")
    reader = _of_folder(place) if place.is_dir() else _of_file(place)
    with naming(place, "holds a value that cannot be shown"):
        content = reader(place, recording)
    if not any(motion.x.size for motion in content.motions) and not content.gaussians and content.cameras is None:
        raise UserError(f"{path} has nothing to show: no particles, no cameras and no Gaussians")
    return content


def is_scene(path: str | Path) -> bool:
    """Return whether a path is a scene file, which is simulated live."""
    place = Path(path)
    return place.suffix in (".yaml", ".yml") and place.is_file() and str(read_yaml(place).get("format", "")).startswith("neuido-scene/")


Reader = Callable[[Path, str | None], Content]


def _of_file(path: Path) -> Reader:
    if path.suffix.lower() == ".npz":
        return _archive
    if path.suffix.lower() == ".ply":
        return lambda place, _: _ply_series([place])
    if path.name == "experiment.yaml":
        return lambda place, recording: _experiment(place.parent, recording)
    if path.name == "diagnosis.json":
        return lambda place, recording: _diagnosis(place.parent, recording)
    raise UserError(f"{path} cannot be viewed: give {KINDS}")


def _of_folder(folder: Path) -> Reader:
    marks: tuple[tuple[str, Reader], ...] = (
        ("diagnosis.json", _diagnosis),
        ("frames.npz", lambda place, recording: _archive(place / "frames.npz", recording)),
        ("experiment.yaml", _experiment),
        ("particles", lambda place, _: _ply_series(numbered_files(place / "particles"))),
    )
    for name, reader in marks:
        if (folder / name).exists():
            return reader
    if numbered_files(folder):
        return lambda place, _: _ply_series(numbered_files(place))
    if list(folder.glob("*/particles/*.ply")):
        return _predictions
    return _multiview


def _archive(path: Path, recording: str | None) -> Content:
    """Read an .npz file of frames, with the scene and the law that lie beside it."""
    arrays = read_frame_arrays(path)
    x = arrays["x"]
    frames = len(x)
    given = arrays.get("times", arrays.get("t"))
    times, timed = _times(given if given is None or given.ndim == 1 else given[0], frames, path)
    scene, laws = scene_and_laws(path.parent)
    body = arrays.get("body")
    stress = stress_of(laws[0]) if len(laws) == 1 else None
    if body is not None and len(laws) > 1:
        stress = stress_by_body(laws, body)
    motion = Motion("simulated", times, x.astype(np.float32), arrays.get("v"), arrays.get("F"), stress=stress, body=body)
    content = Content(path.parent.name if path.name == "frames.npz" else path.stem, [motion], times=times, timed=timed)
    _add_surfaces(content, arrays, path)
    if "scene" in arrays and arrays["scene"].max() > 0:
        number = arrays["scene"].astype(int)
        wide = 1.35 * float(np.ptp(x[np.isfinite(x).all(axis=-1)][:, 0]))
        motion.x = motion.x + (wide * number)[None, :, None].astype(np.float32) * np.array([1, 0, 0], np.float32)
        motion.body = number
    return content if scene is None else with_scene(content, scene)


def _add_surfaces(content: Content, arrays: dict[str, np.ndarray], path: Path) -> None:
    """Add the skins and colliders that a file of frames has."""
    motion, (skins, colliders) = content.motions[0], read_surfaces(arrays, path)
    motion.skins = tuple(
        skin_surface(f"skin {i}", each["faces"], each["indices"], each["weights"], motion.x) for i, each in enumerate(skins)
    )
    content.surfaces = tuple(
        moved_surface(f"collider {i}", each["vertices"], each["faces"], each["poses"]) for i, each in enumerate(colliders)
    )


def _times(given: np.ndarray | None, frames: int, path: Path) -> tuple[np.ndarray, bool]:
    """Return the times of frames [s], or their numbers and False where none are known."""
    if given is None:
        return np.arange(frames) / RATE, False
    if len(given) != frames or not np.isfinite(given).all() or (np.diff(given) < 0).any():
        raise UserError(f"{path}: it has {len(given)} times for {frames} frames; they must be finite and increase")
    return given.astype(np.float64), True


def _ply_series(paths: Sequence[Path]) -> Content:
    """Read one PLY file a frame, of particles or of Gaussians."""
    if not paths:
        raise UserError("the folder of particles holds no numbered PLY files")
    title = paths[0].parent.name if len(paths) > 1 else paths[0].stem
    title = paths[0].parents[1].name if title in ("particles", "ply") else title
    times, timed = _times(read_frame_times(paths[0].parent, len(paths)), len(paths), paths[0].parent)
    if _has_gaussians(paths[0]):
        from neuido.models.render.gaussians import load_gaussians

        series: list[Gaussians] = [load_gaussians(path, device="cpu") for path in paths]
        return Content(title, gaussians=series, times=times, timed=timed)
    tables = [_points(path) for path in paths]
    if len({len(table) for table in tables}) > 1:
        raise UserError(f"{paths[0].parent}: the files have different numbers of particles: give a folder of one motion")
    x = np.stack([table[:, :3] for table in tables])
    v = np.stack([table[:, 3:] for table in tables]) if tables[0].shape[1] == 6 else None
    return Content(title, [Motion("particles", times, x, v)], times=times, timed=timed)


def _has_gaussians(path: Path) -> bool:
    names = {column.name for element in read_ply_header(path).elements for column in element.properties}
    return bool(names & {"f_dc_0", "scale_0", "packed_position"})


def _points(path: Path) -> np.ndarray:
    """Read x, y, z and, where they are there, vx, vy, vz of a PLY file, (P, 3 or 6) float32."""
    vertices = read_ply_vertices(path)
    names = vertices.dtype.names or ()
    if missing := [name for name in ("x", "y", "z") if name not in names or vertices.dtype[name].kind not in "iuf"]:
        raise UserError(f"{path} has no points: its vertices lack the column {missing[0]}")
    wanted = [name for name in ("x", "y", "z", "vx", "vy", "vz") if name in names]
    return np.stack([vertices[name].astype(np.float32) for name in (wanted if len(wanted) == 6 else wanted[:3])], axis=1)


def _predictions(folder: Path, recording: str | None) -> Content:
    names = sorted(path.parent.name for path in folder.glob("*/particles") if numbered_files(path))
    if not names:
        raise UserError(f"{folder} has no particles: give a folder of `neuido predict`")
    content = _ply_series(numbered_files(folder / picked(names, recording, folder) / "particles"))
    content.notes += [f"one of {len(names)}: --recording chooses from {', '.join(names)}"] if len(names) > 1 and recording is None else []
    return content


def _experiment(folder: Path, recording: str | None) -> Content:
    """Read an experiment: measured points and the body, with the cameras and images of a filmed recording."""
    from neuido.data.measured.experiment import read_experiment

    experiment = read_experiment(folder)
    names = [each.name for each in experiment.recordings]
    chosen = experiment[picked(names, recording, folder)]
    content = Content(f"{experiment.name}, {chosen.name}")
    if chosen.x is not None and chosen.t is not None:
        content.times = chosen.t.numpy()
        content.motions = [Motion("measured", content.times, chosen.x.numpy())]
    elif chosen.body is not None:
        content.motions = [Motion("body", content.times, chosen.body.x[None].numpy(), chosen.body.v[None].numpy())]
    if chosen.video is not None:
        _add_views(content, chosen.video)
    if chosen.gaussians is not None:
        content.gaussians = [_gaussians(chosen.gaussians)]
    content.notes += [f"one of {len(names)}: --recording chooses from {', '.join(names)}"] if len(names) > 1 and recording is None else []
    return with_scene(content, chosen.scene)


def _multiview(folder: Path, recording: str | None) -> Content:
    """Read a multi-view recording: its cameras with their images, and its body or Gaussians where the files have them."""
    from neuido.data.scenes.readers import detect, read_recording

    try:
        detect(folder)
    except UserError as error:
        raise UserError(f"{folder} holds nothing that can be viewed: give {KINDS}") from error
    found = read_recording(folder, recording=recording)
    content = Content(found.name)
    if found.body is not None:
        content.motions = [Motion("body", content.times, found.body.x[None].cpu().numpy(), found.body.v[None].cpu().numpy())]
    if found.gaussians is not None:
        content.gaussians = [_gaussians(found.gaussians)]
    _add_views(content, found)
    return content


def _gaussians(path: Path) -> Gaussians:
    from neuido.models.render.gaussians import load_gaussians

    return load_gaussians(path, device="cpu")


def _add_views(content: Content, found: Any) -> None:
    """Add cameras and images; frames are those of the motion where there is one, else those of the images."""
    content.cameras, content.views = found.cameras.at(0), found.views
    recorded = found.times.double().numpy()
    if content.frames == 1 and len(recorded) > 1:
        content.times = recorded - recorded[0]
        for motion in content.motions:
            motion.times = content.times
            motion.x = np.repeat(motion.x[:1], len(recorded), axis=0)
            motion.v = None
    nearest = np.abs(recorded[None] - recorded[0] - content.times[:, None]).argmin(axis=1)
    content.images = tuple(tuple(row[t] for t in nearest) for row in found.images)


def _diagnosis(folder: Path, recording: str | None) -> Content:
    """Read a diagnosis: measured points, and the predictions before and after the effect, each with its residual."""
    told = read_json(folder / "diagnosis.json")
    parts = told.get("bodies") or [told]
    found = {path.stem: read_arrays(path, None, what="file of predictions") for path in sorted((folder / "predicted").glob("*.npz"))}
    found = {name: arrays for name, arrays in found.items() if {"measured", "before", "t"} <= arrays.keys() and arrays["before"].ndim == 3}
    if not found:
        raise UserError(f"{folder} is a diagnosis without a motion in space: open its report.html")
    chosen = picked(list(found), recording, folder)
    arrays = found[chosen]
    part = next((each for each in parts if chosen in each.get("recordings", {})), parts[0])
    own = part.get("recordings", {}).get(chosen, {})
    named = [str(effect["name"]) for effect in part.get("effects", ())]
    kinds = {"before": "before", "after": "after"} if named and "after" in arrays else {"before": "predicted"}
    measured, times = arrays["measured"], arrays["t"].astype(np.float64)
    if any(arrays[kind].shape != measured.shape or len(times) != len(measured) for kind in kinds):
        raise UserError(f"{folder / 'predicted' / chosen}.npz: measured and predicted points have different shapes")
    content = Content(f"{told.get('experiment', folder.name)}, {chosen}", times=times)
    if own.get("gravity") is not None:
        content.gravity = vector(own["gravity"], "gravity")
    content.planes = tuple(Plane(vector(each["point"], "point"), vector(each["normal"], "normal")) for each in own.get("colliders", ()))
    content.motions = [Motion(words, times, arrays[kind].astype(np.float32), reference=measured) for kind, words in kinds.items()]
    place_side_by_side(content.motions, content.up)
    content.notes += [f"effect: {', '.join(named)}"] if named else []
    content.notes += [f"one of {len(found)}: --recording chooses from {', '.join(found)}"] if len(found) > 1 and recording is None else []
    return content
