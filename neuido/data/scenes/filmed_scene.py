"""A filmed and reconstructed body, the sample of Stage II: images, cameras, particles, scene, and the truth if it is known.

Files of the folder:

    <folder>/
      experiment.yaml         an experiment; or transforms.json and images/ of a recording in another format
      <recording>/            transforms.json, images/
      motion.yaml             initial motion of the body, if known: velocity, angular_velocity, centre
      truth.npz, truth.yaml   synthetic scenes only: x (T, P, 3), x0, volume, times; law and options. Only scoring reads them.
      reconstruction/         output of `neuido reconstruct <folder>`; it may lie elsewhere
        gaussians.ply         the first frame, in simulation coordinates
        body.npz              x0 (P, 3), v0 (P, 3), volume (P,)
        scene.yaml            scene, model and discretisation, and the transformation from recording to simulation coordinates
        report.json           PSNR, SSIM, and the errors if the truth is known
        comparison.png, log/  pictures, and the losses of the optimisation as CSV

The `model` of an experiment is the declared model; the true law stands in truth.yaml only.
"""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import yaml
from torch import Tensor

from neuido.data.bodies import scene_files as scenes
from neuido.data.files.parsing import read_arrays, read_yaml
from neuido.data.files.values import check_keys, mapping, number, vector
from neuido.data.files.writing import write_text
from neuido.data.files.yaml_files import checking
from neuido.data.measured.experiment import read_experiment, scene_to_dict
from neuido.data.scenes.multiview import UP, SceneViews
from neuido.data.scenes.readers import read_recording
from neuido.errors import UserError
from neuido.types import Body, Gaussians, MultiViewBatch, Scene, Vector

FORMAT, MOTION = "neuido-visual/1", "neuido-motion/1"
RECONSTRUCTION = "reconstruction"


class Truth(NamedTuple):
    """True motion and material law of a synthetic scene."""

    x: Tensor
    """Positions of the particles in all frames [m], (T, P, 3) float32."""
    x0: Tensor
    """Positions of the particles at t = 0 [m], (P, 3) float32."""
    volume: Tensor
    """Volumes of the particles at t = 0 [m^3], (P,) float32."""
    times: Tensor
    """Times of the frames [s], (T,) float64."""
    law: dict[str, Any]
    """density [kg/m^3], and elasticity and plasticity as arguments of `physics.laws.material`."""


class Motion(NamedTuple):
    """Initial rigid motion of a body."""

    velocity: Vector = (0.0, 0.0, 0.0)
    """Velocity of the centre [m/s]."""
    angular_velocity: Vector = (0.0, 0.0, 0.0)
    """Angular velocity about the centre [rad/s]."""
    centre: Vector | None = None
    """Centre of the rotation [m]; None: the mean of the particles."""


@dataclass(frozen=True)
class Placement:
    """Transformation x -> scale R x + shift from recording to simulation coordinates; R rotates the axis `up` to +y."""

    scale: float = 1.0
    shift: Vector = (0.0, 0.0, 0.0)
    up: str = "y"


class SceneSetting(NamedTuple):
    """Scene and declared material of a filmed body, without its images."""

    name: str
    scene: Scene
    density: float
    """Declared density [kg/m^3]."""
    model: dict[str, Any]
    """Declared material: density, elasticity and plasticity."""
    placing: Placement = Placement()


class VisualScene(NamedTuple):
    """A filmed body, reconstructed or with known particles."""

    name: str
    scene: Scene
    density: float
    """Declared density [kg/m^3]."""
    model: dict[str, Any]
    """Declared material: density, elasticity and plasticity; not the true material."""
    body: Body
    """Particles at t = 0, with the initial velocity if it is known."""
    gaussians: Path | Gaussians | None
    """Path of the reconstructed first frame, a 3DGS PLY file in simulation coordinates; or one Gaussian for each particle; None: the
    particles are rendered."""
    batch: MultiViewBatch
    """Images of all views and frames, and cameras in simulation coordinates; `held_out` marks the held-out views."""
    truth: Truth | None
    """True motion and law; None if unknown."""


def load_visual_scene(
    folder: str | os.PathLike,
    *,
    reconstruction: str | os.PathLike | None = None,
    recording: str | None = None,
    views: Sequence[str] | None = None,
    frame_step: int = 1,
    frame_count: int | None = None,
    width: int | None = None,
    background: str = "white",
    frame_interval: float | None = None,
) -> VisualScene:
    """Read a filmed body and its reconstruction.

    Args:
        folder: An experiment folder, or a recording in any format that `read_recording` reads.
        reconstruction: Output folder of `neuido reconstruct`; None: `<folder>/reconstruction`.
        recording: Name of the recording, if the experiment has several.
        views: Names of the views; None: all.
        frame_step: Use every n-th frame.
        frame_count: Number of frames; None: all.
        width: Width of the images [px]; None: as recorded.
        background: Colour behind the object if a mask is known, `white` or `black`.
        frame_interval: Time between frames [s], if the recording has no times.

    Raises:
        UserError: A file is missing or malformed; the message names it.
    """
    folder = Path(folder).expanduser()
    own = Path(reconstruction).expanduser() if reconstruction is not None else folder / RECONSTRUCTION
    for name in ("scene.yaml", "body.npz", "gaussians.ply"):
        if not (own / name).is_file():
            raise UserError(
                f"{own / name} is missing: run `neuido reconstruct {folder}` first, or give its output folder as reconstruction"
            )
    setting = read_setting(own / "scene.yaml")
    options = {"views": views, "frame_step": frame_step, "frame_count": frame_count, "width": width, "background": background}
    batch = load_views(folder, placing=setting.placing, recording=recording, frame_interval=frame_interval, **options)
    body = read_body(own / "body.npz")
    truth = read_truth(folder, frame_step=frame_step, frames=len(batch.times))
    return VisualScene(setting.name, setting.scene, setting.density, setting.model, body, own / "gaussians.ply", batch, truth)


def load_views(
    folder: str | os.PathLike,
    *,
    placing: Placement = Placement(),
    recording: str | None = None,
    frame_interval: float | None = None,
    workers: int | None = None,
    **options: Any,
) -> MultiViewBatch:
    """Read images and cameras of one recording, in simulation coordinates.

    The mask of an image without one is computed from its difference from the background colour, which is that of the image borders. This
    requires a plain background. If no image has a mask, the images keep their background, and `background` of the batch is its colour.

    Args:
        folder: A recording in any format that `read_recording` reads.
        placing: Transformation from recording to simulation coordinates.
        recording: Name of the recording, if the experiment has several.
        frame_interval: Time between frames [s], if the recording has no times.
        workers: Number of threads that read images; None: the number of cores.
        options: Options of `SceneViews`.

    Raises:
        UserError: As `read_recording` and `SceneViews`.
    """
    found = read_recording(folder, recording=recording, frame_interval=frame_interval)
    views = SceneViews(found, scale=placing.scale, shift=placing.shift, up=placing.up, cache=False, find_masks=True, **options)
    pairs = [(v, t) for v in range(len(views.chosen)) for t in range(len(views.frames))]
    shape = (len(views.chosen), len(views.frames), views.cameras.height, views.cameras.width)
    images, masks = torch.empty(*shape, 3), torch.empty(shape)

    _ = views.unmasked, views.plain_background  # computed once, before several threads use it

    def fill(pair: tuple[int, int]) -> None:
        image, mask = views.load([pair[0]], [pair[1]])
        images[pair], masks[pair] = image[0, 0], mask[0, 0]

    with ThreadPoolExecutor(workers or os.cpu_count()) as pool:
        for _ in pool.map(fill, pairs):
            pass
    colour = torch.from_numpy(views.background_colour)
    held_out = torch.tensor(views.held_out)
    return MultiViewBatch(0, views.name, images, masks, views.cameras, views.times, held_out, colour)


def read_setting(path: Path, *, recording: str | None = None) -> SceneSetting:
    """Read scene and declared material from `scene.yaml` of a reconstruction, or from `experiment.yaml`.

    Args:
        path: The file.
        recording: Name of the recording of an experiment, because gravity and colliders may differ between recordings; None: the only
            recording with images.

    Raises:
        UserError: The file is missing, a key is unknown or missing, or a value is outside its range.
    """
    if path.name == "experiment.yaml":
        experiment = read_experiment(path)
        filmed = [one.name for one in experiment.recordings if one.video is not None]
        if recording is None and len(filmed) != 1:
            raise UserError(f"{path} has {len(filmed)} recordings with images ({', '.join(filmed)}): give the option recording")
        return SceneSetting(experiment.name, experiment[recording or filmed[0]].scene, experiment.model["density"], experiment.model)
    if not path.is_file():
        raise UserError(f"{path} is missing")
    content = read_yaml(path)
    with checking(path):
        check_keys(content, "the file", ("format", "name", "scene", "discretisation", "model", "placing"))
        if content["format"] != FORMAT:
            raise UserError(f"format = {content['format']!r} must be {FORMAT!r}")
        scene = scenes.scene_from_dict(content["scene"], content["discretisation"])
        model = scenes.model_from_dict(content["model"])
        given = mapping(content["placing"], "placing")
        check_keys(given, "placing", ("scale", "shift", "up"))
        if given["up"] not in UP:
            raise UserError(f"placing.up = {given['up']!r} is unknown: choose from {', '.join(UP)}")
        scale = number(given["scale"], "placing.scale", above=0.0)
        placing = Placement(scale, vector(given["shift"], "placing.shift"), given["up"])
    return SceneSetting(str(content["name"]), scene, model["density"], model, placing)


def write_setting(setting: SceneSetting, path: Path) -> None:
    """Write scene, declared material and placement to `scene.yaml` of a reconstruction."""
    scene, discretisation = scene_to_dict(setting.scene)
    placing = {"scale": setting.placing.scale, "shift": list(setting.placing.shift), "up": setting.placing.up}
    content = {"format": FORMAT, "name": setting.name, "scene": scene, "discretisation": discretisation}
    content |= {"model": setting.model, "placing": placing}
    write_text(path, yaml.safe_dump(content, sort_keys=False, default_flow_style=None, allow_unicode=True))


def read_motion(folder: Path) -> Motion | None:
    """Read the initial motion of a body from `motion.yaml` of a folder; return None if the file is missing.

    Raises:
        UserError: A key is unknown, or a value is not a vector.
    """
    path = folder / "motion.yaml"
    if not path.is_file():
        return None
    content = read_yaml(path)
    with checking(path):
        check_keys(content, "the file", ("format", "velocity", "angular_velocity", "centre"), ("angular_velocity", "centre"))
        if content["format"] != MOTION:
            raise UserError(f"format = {content['format']!r} must be {MOTION!r}")
        vectors = {key: vector(value, key) for key, value in content.items() if key != "format"}
    return Motion(**vectors)


def write_motion(motion: Motion, folder: Path) -> None:
    """Write the initial motion of a body to `motion.yaml` of a folder."""
    content: dict[str, Any] = {"format": MOTION}
    content |= {key: list(value) for key, value in motion._asdict().items() if value is not None}
    write_text(folder / "motion.yaml", yaml.safe_dump(content, sort_keys=False, default_flow_style=None))


def read_body(path: Path) -> Body:
    """Read the particles of a reconstruction from `body.npz`.

    Raises:
        UserError: An array is missing, a shape does not match, or a value is not finite.
    """
    arrays = _arrays(path, {"x0": (-1, 3), "v0": (-1, 3), "volume": (-1,)})
    if len({len(array) for array in arrays.values()}) != 1 or not (arrays["volume"] > 0).all():
        raise UserError(f"{path}: x0, v0 and volume must have the same length, and volumes must be positive")
    x, v, volume = (torch.from_numpy(arrays[key].astype(np.float32)) for key in ("x0", "v0", "volume"))
    return Body(x, v, volume)


def read_truth(folder: Path, *, frame_step: int = 1, frames: int | None = None) -> Truth | None:
    """Read the truth of a synthetic scene from truth.npz and truth.yaml; return None if they are missing.

    Args:
        folder: Folder of the scene.
        frame_step: Use every n-th frame.
        frames: Number of frames; None: all.

    Raises:
        UserError: A file is malformed, or has fewer frames than `frames`.
    """
    if not (folder / "truth.npz").is_file() or not (folder / "truth.yaml").is_file():
        return None
    path = folder / "truth.npz"
    arrays = _arrays(path, {"x": (-1, -1, 3), "x0": (-1, 3), "volume": (-1,), "times": (-1,)})
    if len({arrays["x"].shape[1], len(arrays["x0"]), len(arrays["volume"])}) != 1 or len(arrays["x"]) != len(arrays["times"]):
        raise UserError(f"{path}: the shapes of x, x0, volume and times do not match")
    content = read_yaml(folder / "truth.yaml")
    with checking(folder / "truth.yaml"):
        law = scenes.model_from_dict(content.get("law", {}))
    x, times = torch.from_numpy(arrays["x"])[::frame_step][:frames].float(), torch.from_numpy(arrays["times"])[::frame_step][:frames]
    if frames is not None and len(times) < frames:
        raise UserError(f"{path} has {len(times)} frames, but the recording has {frames}: it is the truth of another motion")
    return Truth(x, torch.from_numpy(arrays["x0"]).float(), torch.from_numpy(arrays["volume"]).float(), times.double(), law)


def _arrays(path: Path, shapes: dict[str, tuple[int, ...]]) -> dict[str, np.ndarray]:
    arrays = read_arrays(path, shapes)
    for key, shape in shapes.items():
        array = arrays[key]
        if array.dtype.kind not in "biuf":
            raise UserError(f"{path}: {key} holds {array.dtype} and not numbers")
        if array.ndim != len(shape) or any(n not in (-1, m) for n, m in zip(shape, array.shape)) or not np.isfinite(array).all():
            raise UserError(f"{path}: {key} has the wrong shape {array.shape}, or contains a NaN or an infinity")
    return arrays
