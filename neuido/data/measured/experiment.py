"""Experiments: measured motion of one object, in the folder format `neuido-experiment/1`, read, checked and written."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from torch import Tensor

from neuido.data.bodies import scene_files as scenes
from neuido.data.files.parsing import read_arrays
from neuido.data.files.values import check_keys, file_name, mapping, number, path_inside
from neuido.data.files.writing import copy_file, write_arrays, write_text
from neuido.data.formats import nerfstudio
from neuido.data.formats.layout import MultiView
from neuido.data.measured.clamps import Clamp, check_clamps, clamp_entries, held_scene, read_clamps, split_clamps, write_clamps
from neuido.data.measured.columns import errors_of, read_effects, read_entries, read_free, read_header, read_role, read_text
from neuido.data.measured.motion_plausibility import check_motion, check_positions, mask_unseen
from neuido.data.measured.plausibility import check_density
from neuido.errors import UserError
from neuido.physics.effects.parameters import LIBRARY
from neuido.types import Body, Box, Plane, Scene, Solid, Walls

FORMAT = "neuido-experiment/1"
OVERRIDES = ("gravity", "attached_masses", "colliders")
ELASTIC = ("fixed_corotated", "sigma", "neo_hookean")
PLASTIC = ("identity", "von_mises", "drucker_prager")
"""Laws that may be declared; what else a material does is found as an effect."""
NEEDED, OPTIONAL = ("x", "t", "x0", "v0", "volume"), ("F0", "track", "anchor")


@dataclass(frozen=True, eq=False)
class Recording:
    """One recorded motion: tracked points, images, or both; a field that was not recorded is None."""

    name: str
    role: str
    """`fit` or `held_out`; held-out recordings are scored but never fitted."""
    scene: Scene
    """The experiment's scene with this recording's own gravity, colliders and attached masses, without the clamps that have a name."""
    frame_interval: float
    """Nominal time from one frame to the next [s]; `t` has the true times."""
    noise: float | None = None
    """Standard deviation of the position error [m]; None if unknown."""
    x: Tensor | None = None
    """Position [m] of material point n in frame t, (T, N, 3) float32; NaN where it was not seen."""
    t: Tensor | None = None
    """Times of the frames [s], (T,) float64, increasing from 0."""
    body: Body | None = None
    """The particles at t = 0: x0, v0, volume and F0."""
    track: Tensor | None = None
    """Index of the particle that point n follows, (N,) int64; -1 if unknown."""
    anchor: Tensor | None = None
    """Position of point n in the body at t = 0 [m], (N, 3) float32; given instead of `track`."""
    video: MultiView | None = None
    """Cameras and images."""
    gaussians: Path | None = None
    """The first frame as a 3DGS PLY."""
    clamps: tuple[Clamp, ...] = ()
    """The clamps that have a name, with their motion and force in this recording."""

    @property
    def held_scene(self) -> Scene:
        """The scene with the clamps that have a name, for a simulation."""
        return held_scene(self.scene, self.clamps) if self.clamps else self.scene

    @property
    def seen(self) -> Tensor:
        """Whether point n was seen in frame t, (T, N)."""
        if self.x is None:
            raise UserError(f"recording {self.name} has no tracked points: particles.npz is missing")
        return ~self.x[..., 0].isnan()


@dataclass(frozen=True, eq=False)
class Experiment:
    """One object of one material, recorded one or more times."""

    name: str
    folder: Path
    scene: Scene
    model: dict[str, Any]
    """The declared model: density [kg/m^3], elasticity and plasticity (as for `physics.laws.material`), and optionally `effects` by
    flat names, such as {"viscosity_shear.eta": 12.0}."""
    free: tuple[str, ...]
    """The parameters of the model to fit; all others are taken as exact."""
    recordings: tuple[Recording, ...]

    def __getitem__(self, name: str) -> Recording:
        """Return the recording with this name."""
        for recording in self.recordings:
            if recording.name == name:
                return recording
        raise UserError(f"recording = {name!r} is not in {self.name}: choose from {', '.join(r.name for r in self.recordings)}")

    def of(self, role: str) -> tuple[Recording, ...]:
        """Return the recordings with this role."""
        return tuple(recording for recording in self.recordings if recording.role == role)


def read_experiment(path: str | os.PathLike, *, model: Mapping[str, Any] | None = None) -> Experiment:
    """Read an experiment's folder, or its `experiment.yaml`.

    Args:
        path: The folder or the file.
        model: Replaces the key `model` of the file.

    Raises:
        UserError: An unknown or missing key, a missing file, a value outside its physical range, a shape that does not fit, a box
            that contains no particle. The message names the file and the key.
    """
    file, content = read_header(Path(path), "experiment.yaml", FORMAT)
    folder = file.parent
    with errors_of(file):
        check_keys(content, "the file", ("format", "name", "scene", "model", "discretisation", "recordings"))
        name = read_text(content["name"], "name")
        content["scene"], boxes = split_clamps(content["scene"])
        scene = scenes.scene_from_dict(content["scene"], content["discretisation"])
        declared, free = read_declared_model(content["model"] if model is None else model, folder=folder)
        recordings = read_entries(
            content["recordings"], "recordings", "recording", lambda entry, where: _recording(entry, where, content, folder, boxes)
        )
    return Experiment(name, folder, scene, declared, free, recordings)


def write_experiment(experiment: Experiment, path: str | os.PathLike) -> None:
    """Write an experiment's folder, with copies of its images and Gaussians; `experiment.yaml` is written last, when all else is there.

    Raises:
        UserError: The folder already holds an experiment, or the experiment cannot be expressed in the format.
    """
    folder = Path(path).expanduser()
    if (folder / "experiment.yaml").exists():
        raise UserError(f"{folder} contains an experiment already: give another folder")
    scene, discretisation = scene_to_dict(experiment.scene)
    scene["clamps"] += clamp_entries(experiment.recordings[0].clamps)
    content: dict[str, Any] = {
        "format": FORMAT,
        "name": experiment.name,
        "scene": scene,
        "model": {**experiment.model, "free": list(experiment.free)},
        "discretisation": discretisation,
        "recordings": [],
    }
    for recording in experiment.recordings:
        own, grid = scene_to_dict(recording.scene)
        own["clamps"] += clamp_entries(recording.clamps)
        changed = {key: own[key] for key in OVERRIDES if own[key] != scene[key]}
        if grid != discretisation or any(own[key] != scene[key] for key in own if key not in OVERRIDES):
            raise UserError(f"recording {recording.name} differs from the experiment in more than {', '.join(OVERRIDES)}")
        entry = {"name": recording.name, "role": recording.role, "frame_interval": recording.frame_interval, **changed}
        entry |= {} if recording.noise is None else {"noise": recording.noise}
        path_inside(folder, recording.name, "name of the recording").mkdir(parents=True, exist_ok=True)
        _write_files(recording, folder / recording.name)
        held = write_clamps(recording.clamps, folder, recording.name)
        content["recordings"].append(entry | ({"clamps": held} if held else {}))
    write_text(folder / "experiment.yaml", yaml.safe_dump(content, sort_keys=False, default_flow_style=None, allow_unicode=True))


def scene_to_dict(scene: Scene) -> tuple[dict[str, Any], dict[str, Any]]:
    """Convert a scene to the keys `scene` and `discretisation` of an experiment file; the inverse of `scene_from_dict`."""

    def corners(box: Box) -> list[list[float]]:
        return [list(box.lower), list(box.upper)]

    def plane(p: Plane | Solid) -> dict[str, Any]:
        if not isinstance(p, Plane):
            raise UserError(f"a {type(p).__name__} among the colliders: an experiment has planes alone")
        return {"type": "plane", "point": list(p.point), "normal": list(p.normal), "contact": p.contact, "friction": p.friction}

    out: dict[str, Any] = {
        "domain": [list(scene.lower), list(scene.upper)],
        "gravity": list(scene.gravity),
        "colliders": [plane(p) for p in scene.colliders],
        "clamps": [{"box": corners(box)} for box in scene.clamps],
        "attached_masses": [{"box": corners(m.box), "mass": m.mass} for m in scene.attached_masses],
    }
    if scene.walls != Walls():
        out["walls"] = scene.walls and {"contact": scene.walls.contact, "friction": scene.walls.friction, "inset": scene.walls.inset}
    return out, {"grid": scene.cells, "dt": scene.dt}


def read_declared_model(given: Any, *, folder: Path = Path(".")) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Validate a declared model, in which a neural law may replace elasticity and plasticity; return it with its free parameters.

    Args:
        given: As for `read_model`, with an optional key `law`: the `file` of a neural law and `stiffness`, a factor on its stress that
            may be free.
        folder: The folder that the path of the law's file is relative to.

    Raises:
        UserError: An unknown key, an impossible material, an unknown effect.
    """
    given = mapping(given, "model")
    if "law" not in given:
        return read_model(given)
    law = mapping(given.pop("law"), "model.law")
    check_keys(law, "model.law", ("file", "stiffness"), ("stiffness",))
    file = folder / Path(read_text(law["file"], "model.law.file")).expanduser()
    stiffness = number(law.get("stiffness", 1.0), "model.law.stiffness", above=0.0)
    free = given.get("free", [])
    scaled = isinstance(free, list) and "stiffness" in free
    if scaled:
        given["free"] = [name for name in free if name != "stiffness"]
    model, own = read_model(given)
    return {**model, "law": {"file": str(file), "stiffness": stiffness}}, ("stiffness", *own) if scaled else own


def read_model(given: Any) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Validate the declared model of a file's key `model`; return it with the names of its free parameters."""
    given = mapping(given, "model")
    free = given.pop("free", [])
    effects = read_effects(given.pop("effects", None), "model.effects", known=tuple(entry.name for entry in LIBRARY if not entry.only))
    for part in ("elasticity", "plasticity"):
        if isinstance(given.get(part), Mapping):
            read_text(given[part].get("law"), f"model.{part}.law")
    model = scenes.model_from_dict(given)
    check_density(model["density"])
    for part, laws in (("elasticity", ELASTIC), ("plasticity", PLASTIC)):
        if model[part]["law"] not in laws:
            raise UserError(f"model.{part}.law = {model[part]['law']} is a law of scenes alone; declare {', '.join(laws)} here, and what "
                            "it lacks is found as an effect")  # fmt: skip
    known = ["density", *(key for part in ("elasticity", "plasticity") for key in model[part] if key != "law")]
    free = read_free(free, tuple(known))
    if effects:
        model["effects"] = effects
    return model, free


def _recording(entry: Any, where: str, content: Mapping[str, Any], folder: Path, boxes: Mapping[str, Box]) -> Recording:
    check_keys(entry, where, ("name", "role", "frame_interval", "noise", "clamps", *OVERRIDES), ("noise", "clamps", *OVERRIDES))
    name = file_name(entry["name"], f"{where}.name")
    where = f"{where} ({name})"
    role = read_role(entry["role"], where)
    interval = number(entry["frame_interval"], f"{where}.frame_interval", above=0.0)
    noise = number(entry["noise"], f"{where}.noise", least=0.0) if entry.get("noise") is not None else None
    merged = dict(content["scene"]) | {key: entry[key] for key in OVERRIDES if key in entry}
    try:
        scene = scenes.scene_from_dict(merged, content["discretisation"])
    except UserError as error:
        raise UserError(f"{where}: {error}") from error
    own = path_inside(folder, name, f"{where}.name")
    if own.resolve() == folder.resolve() or not own.is_dir():
        raise UserError(f"{where}: the folder {own} is missing")
    if not (own / "particles.npz").is_file() and not (own / "transforms.json").is_file():
        raise UserError(f"{where}: {own} has neither particles.npz nor transforms.json")
    fields: dict[str, Any] = {}
    if (own / "particles.npz").is_file():
        fields = _particles(own / "particles.npz", scene, interval)
        _check_boxes(scene, fields["body"].x, where)
    elif (own / "body.npz").is_file():
        fields["body"] = _body(own / "body.npz", scene)
        _check_boxes(scene, fields["body"].x, where)
    if (own / "transforms.json").is_file():
        fields["video"] = nerfstudio.read(own)
    if boxes or entry.get("clamps"):
        fields["clamps"] = read_clamps(entry.get("clamps"), boxes, folder, where)
        if "x" not in fields:
            raise UserError(f"{where}: clamps with a name need tracked points, and {own} has no particles.npz")
        check_clamps(fields["clamps"], scene, fields, where)
    gaussians = own / "gaussians.ply"
    return Recording(
        name=name,
        role=role,
        scene=scene,
        frame_interval=interval,
        noise=noise,
        gaussians=gaussians if gaussians.is_file() else None,
        **fields,
    )


def _particles(path: Path, scene: Scene, interval: float) -> dict[str, Any]:
    """Read and validate particles.npz; return it as fields of `Recording`.

    Raises:
        UserError: An array is missing or malformed, shapes do not match, or values are implausible.
    """
    arrays = _arrays(path)
    shapes = {"x": ("T", "N", 3), "t": ("T",), "x0": ("P", 3), "v0": ("P", 3), "volume": ("P",), "F0": ("P", 3, 3), "track": ("N",),
              "anchor": ("N", 3)}  # fmt: skip
    sizes: dict[str, int] = {}
    for key, shape in shapes.items():
        if key not in arrays:
            continue
        array = arrays[key]
        wanted = ", ".join(str(n) for n in shape)
        if array.ndim != len(shape) or any(isinstance(n, int) and n != m for n, m in zip(shape, array.shape)):
            raise UserError(f"{path}: {key} must have the shape ({wanted}), got {array.shape}")
        for n, m in zip(shape, array.shape):
            if isinstance(n, str) and sizes.setdefault(n, m) != m:
                raise UserError(f"{path}: {key} has the shape {array.shape}; it must be ({wanted}) with {n} = {sizes[n]}")
        if array.dtype.kind not in ("iu" if key == "track" else "f"):
            raise UserError(f"{path}: {key} must hold {'whole numbers' if key == 'track' else 'floating-point numbers'}, got {array.dtype}")
        if key != "x" and not np.isfinite(array).all():
            raise UserError(f"{path}: {key} contains a NaN or an infinity")
    if min(sizes.values()) < 1:
        raise UserError(f"{path}: {', '.join(f'{n} = {m}' for n, m in sizes.items())}; all must be at least 1")
    x, t = arrays["x"], arrays["t"]
    if not np.isinf(x).any():
        x = arrays["x"] = mask_unseen(x, str(path))
    if np.isinf(x).any() or (np.isnan(x).any(axis=2) != np.isnan(x).all(axis=2)).any():
        raise UserError(f"{path}: x contains an infinity, or a point that is NaN in some coordinates only")
    if t[0] != 0 or (np.diff(t) <= 0).any():
        raise UserError(f"{path}: t must increase from 0, got {', '.join(f'{time:g}' for time in t[:4])}, ...")
    if len(t) > 1 and not 0.5 < t[-1] / (len(t) - 1) / interval < 2:
        raise UserError(f"{path}: t has a frame every {t[-1] / (len(t) - 1):.3g} s, but frame_interval is {interval:g} s")
    lower, upper = np.array(scene.lower), np.array(scene.upper)
    outside = ((arrays["x0"] < lower) | (arrays["x0"] > upper)).any(axis=1)
    if outside.any():
        raise UserError(f"{path}: {outside.sum()} particles of x0 lie outside scene.domain")
    if not np.ptp(arrays["x0"], axis=0).any():
        raise UserError(f"{path}: x0 has {len(arrays['x0'])} particles in one place, which are no body: give more, or a track of a point")
    if not (arrays["volume"] > 0).all():
        raise UserError(f"{path}: volume must be positive, got {arrays['volume'].min():g} m^3")
    if arrays["volume"].sum(dtype=np.float64) > np.prod(upper - lower):
        raise UserError(f"{path}: the volumes add up to {arrays['volume'].sum():.3g} m^3, more than the whole domain has")
    if "F0" in arrays and not (np.linalg.det(arrays["F0"].astype(np.float64)) > 0).all():
        raise UserError(f"{path}: F0 must have positive determinants; one is {np.linalg.det(arrays['F0']).min():.3g}")
    if "track" in arrays and not ((arrays["track"] >= -1) & (arrays["track"] < sizes["P"])).all():
        raise UserError(f"{path}: track must lie in -1..{sizes['P'] - 1}, got {arrays['track'].min()}..{arrays['track'].max()}")
    check_positions(x, arrays["x0"], arrays.get("track"), lower, upper, str(path))
    check_motion(x, t, arrays["x0"], arrays["v0"], arrays["volume"], scene.gravity, str(path))
    tensors = {key: torch.from_numpy(array.astype(np.float32)) for key, array in arrays.items() if key not in ("t", "track")}
    return {
        "x": tensors["x"],
        "t": torch.from_numpy(t.astype(np.float64)),
        "body": Body(tensors["x0"], tensors["v0"], tensors["volume"], tensors.get("F0")),
        "track": torch.from_numpy(arrays["track"].astype(np.int64)) if "track" in arrays else None,
        "anchor": tensors.get("anchor"),
    }


def _body(path: Path, scene: Scene) -> Body:
    """Read and validate body.npz: the body at t = 0 of a recording without tracked points.

    Raises:
        UserError: An array is missing or malformed, or a particle lies outside the domain.
    """
    arrays = read_arrays(path, ("x0", "v0", "volume"), what="archive of arrays", others=False)
    count = len(arrays["x0"])
    for key, shape in (("x0", (count, 3)), ("v0", (count, 3)), ("volume", (count,))):
        if arrays[key].shape != shape or arrays[key].dtype.kind != "f" or not count or not np.isfinite(arrays[key]).all():
            raise UserError(f"{path}: {key} must hold finite floating-point numbers of the shape {shape}, got {arrays[key].shape}")
    outside = ((arrays["x0"] < np.array(scene.lower)) | (arrays["x0"] > np.array(scene.upper))).any(axis=1)
    if outside.any():
        raise UserError(f"{path}: {outside.sum()} particles of x0 lie outside scene.domain")
    if not np.ptp(arrays["x0"], axis=0).any() or not (arrays["volume"] > 0).all():
        raise UserError(f"{path}: a body needs particles in several places and positive volumes")
    x, v, volume = (torch.from_numpy(arrays[key].astype(np.float32)) for key in ("x0", "v0", "volume"))
    return Body(x, v, volume)


def _arrays(path: Path) -> dict[str, np.ndarray]:
    arrays = read_arrays(path, NEEDED, OPTIONAL, what="archive of arrays", others=False)
    if ("track" in arrays) == ("anchor" in arrays):
        raise UserError(f"{path} must have either track or anchor, got {'both' if 'track' in arrays else 'neither'}")
    return arrays


def _check_boxes(scene: Scene, x: Tensor, where: str) -> None:
    boxes = [(f"clamps[{i}]", box) for i, box in enumerate(scene.clamps)]
    boxes += [(f"attached_masses[{i}]", attached.box) for i, attached in enumerate(scene.attached_masses)]
    for key, box in boxes:
        if not bool(((x >= x.new_tensor(box.lower)) & (x <= x.new_tensor(box.upper))).all(dim=1).any()):
            raise UserError(f"{where}: {key}.box = {[list(box.lower), list(box.upper)]} contains no particle of x0")


def _write_files(recording: Recording, folder: Path) -> None:
    if recording.x is not None and recording.t is not None and recording.body is not None:
        body = recording.body
        arrays = {"x": recording.x, "t": recording.t, "x0": body.x, "v0": body.v, "volume": body.volume, "F0": body.F,
                  "track": recording.track, "anchor": recording.anchor}  # fmt: skip
        kinds = {"t": np.float64, "track": np.int32}
        given = {key: array.numpy().astype(kinds.get(key, np.float32)) for key, array in arrays.items() if array is not None}
        write_arrays(folder / "particles.npz", given)
    elif recording.body is not None:
        body = recording.body
        write_arrays(folder / "body.npz", {"x0": body.x.numpy(), "v0": body.v.numpy(), "volume": body.volume.numpy()})
    if recording.video is not None:
        source = recording.video.folder
        if not (source / "transforms.json").is_file():
            raise UserError(
                f"the video of recording {recording.name} has no transforms.json in {source}: write its images with nerfstudio.write"
            )
        for path in (path for grid in (recording.video.images, recording.video.masks or ()) for row in grid for path in row if path):
            copy_file(path, folder / path.relative_to(source))
        copy_file(source / "transforms.json", folder / "transforms.json")
    if recording.gaussians is not None:
        copy_file(recording.gaussians, folder / "gaussians.ply")
