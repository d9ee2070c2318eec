"""One filmed body as Stage II takes it: images and cameras, the reconstructed body, the scene, and the truth where it is known.

The folder, with what writes each part:

    <folder>/
      experiment.yaml         an experiment (`data.experiments`); or only transforms.json and images of one's own
      <recording>/            transforms.json, images/
      motion.yaml             the body's motion at t = 0 where it is known: velocity, angular_velocity, centre
      truth.npz, truth.yaml   of synthetic scenes alone: x (T, P, 3), x0, volume, times; law and figures. Only scores read them.
      reconstruction/         of `neuido reconstruct <folder>`, or in another place
        gaussians.ply         the first frame, in the simulation's coordinates
        body.npz              x0 (P, 3), v0 (P, 3), volume (P,)
        scene.yaml            scene, model and discretisation, and how the recording's world lies in the simulation's domain
        report.json           PSNR, SSIM, and the errors against the truth where it is known
        comparison.png, log/  pictures and the losses of the optimisation as CSV

The `model` of an experiment is the declared one; the true law is only in truth.yaml.
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
from neuido.data.files.storage import write_text
from neuido.data.files.values import check_keys, mapping, number, vector
from neuido.data.files.yaml_files import located
from neuido.data.measured.experiment import read_experiment, scene_to_dict
from neuido.data.scenes.multiview import UP, SceneViews
from neuido.data.scenes.readers import read
from neuido.errors import UserError
from neuido.types import Body, MultiViewBatch, Scene, Vector

FORMAT, MOTION = "neuido-visual/1", "neuido-motion/1"
RECONSTRUCTION = "reconstruction"


class Truth(NamedTuple):
    """What a synthetic scene knows of itself."""

    x: Tensor
    """Positions of all frames [m], (T, P, 3) float32."""
    x0: Tensor
    """Positions at t = 0 [m], (P, 3)."""
    volume: Tensor
    """Volumes at t = 0 [m^3], (P,)."""
    times: Tensor
    """Times of the frames [s], (T,) float64."""
    law: dict[str, Any]
    """density [kg/m^3], elasticity and plasticity, as `physics.laws.material` takes them."""


class Motion(NamedTuple):
    """A rigid motion at t = 0."""

    velocity: Vector = (0.0, 0.0, 0.0)
    """Of the centre [m/s]."""
    angular_velocity: Vector = (0.0, 0.0, 0.0)
    """About the centre [rad/s]."""
    centre: Vector | None = None
    """[m]; none: the mean of the particles."""


@dataclass(frozen=True)
class Placement:
    """x -> scale R x + shift from the recording's world to the simulation's domain; R turns the axis `up` upwards (as `SceneViews`)."""

    scale: float = 1.0
    shift: Vector = (0.0, 0.0, 0.0)
    up: str = "y"


class SceneSetting(NamedTuple):
    """What is known of a body's surroundings and material, without any image."""

    name: str
    scene: Scene
    density: float
    """[kg/m^3]"""
    model: dict[str, Any]
    """The declared material: density, elasticity, plasticity."""
    placing: Placement = Placement()


class VisualScene(NamedTuple):
    """One filmed body, reconstructed."""

    name: str
    scene: Scene
    density: float
    """[kg/m^3]"""
    model: dict[str, Any]
    """The declared material: density, elasticity, plasticity; not the true one."""
    body: Body
    """The reconstructed particles at t = 0, with the velocity that is known."""
    gaussians: Path | None
    """The reconstructed first frame, a 3DGS PLY in the simulation's coordinates; none: the particles stand for it."""
    batch: MultiViewBatch
    """Images of all views (held-out ones marked) and frames, with the cameras in the simulation's coordinates."""
    truth: Truth | None
    """None where it is not known."""


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
    """Read a filmed and reconstructed body.

    Args:
        folder: An experiment's folder, or any recording that `data.formats` reads.
        reconstruction: What `neuido reconstruct` wrote; `<folder>/reconstruction` where absent.
        recording: Which recording of an experiment with several.
        views: Names of the views; all where absent.
        frame_step: Take each n-th frame.
        frame_count: Number of frames; all where absent.
        width: Width of the images [px]; as recorded where absent.
        background: `white` or `black`, where a mask is known.
        frame_interval: Seconds between frames where the recording does not say.

    Raises:
        UserError: A missing or malformed file; one line that names it.
    """
    folder = Path(folder).expanduser()
    own = Path(reconstruction).expanduser() if reconstruction is not None else folder / RECONSTRUCTION
    for name in ("scene.yaml", "body.npz", "gaussians.ply"):
        if not (own / name).is_file():
            raise UserError(f"{own / name} is missing: run `neuido reconstruct {folder}` first, or name its folder by reconstruction")
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
    """Read images and cameras of one recording, in the simulation's coordinates.

    The mask of an image that has none is what differs from the colour of the images' rims, which needs a plain background. Where no image
    has a mask, the images keep their background, and the batch's `background` is that colour.

    Args:
        folder: Any recording that `data.formats` reads.
        placing: How the recording's world lies in the simulation's domain.
        recording: Which recording of an experiment with several.
        frame_interval: Seconds between frames where the recording does not say.
        workers: Threads that read images; as many as cores where absent.
        options: As `SceneViews` takes them.

    Raises:
        UserError: As `readers.read` and `SceneViews`.
    """
    found = read(folder, recording=recording, frame_interval=frame_interval)
    views = SceneViews(found, scale=placing.scale, shift=placing.shift, up=placing.up, cache=False, find_masks=True, **options)
    pairs = [(v, t) for v in range(len(views.chosen)) for t in range(len(views.frames))]
    shape = (len(views.chosen), len(views.frames), views.cameras.height, views.cameras.width)
    images, masks = torch.empty(*shape, 3), torch.empty(shape)

    _ = views.unmasked, views.plain_background  # once, before several threads ask for it

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
    """Read `scene.yaml` of a reconstruction, or `experiment.yaml`.

    Args:
        path: The file.
        recording: Of an experiment, whose gravity and colliders may be its own; the only filmed one where absent.

    Raises:
        UserError: A missing file, an unknown or missing key, a figure outside its range.
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
    try:
        check_keys(content, "the file", ("format", "name", "scene", "discretisation", "model", "placing"))
        if content["format"] != FORMAT:
            raise UserError(f"format is {content['format']!r}, not {FORMAT!r}")
        scene = scenes.scene_from_dict(content["scene"], content["discretisation"])
        model = scenes.model_from_dict(content["model"])
        given = mapping(content["placing"], "placing")
        check_keys(given, "placing", ("scale", "shift", "up"))
        if given["up"] not in UP:
            raise UserError(f"placing.up = {given['up']!r}; one of {', '.join(UP)}")
        scale = number(given["scale"], "placing.scale", above=0.0)
        placing = Placement(scale, vector(given["shift"], "placing.shift"), given["up"])
    except UserError as error:
        raise located(path, error) from error
    return SceneSetting(str(content["name"]), scene, model["density"], model, placing)


def write_setting(setting: SceneSetting, path: Path) -> None:
    """Write `scene.yaml` of a reconstruction."""
    scene, discretisation = scene_to_dict(setting.scene)
    placing = {"scale": setting.placing.scale, "shift": list(setting.placing.shift), "up": setting.placing.up}
    content = {"format": FORMAT, "name": setting.name, "scene": scene, "discretisation": discretisation}
    content |= {"model": setting.model, "placing": placing}
    write_text(path, yaml.safe_dump(content, sort_keys=False, default_flow_style=None, allow_unicode=True))


def read_motion(folder: Path) -> Motion | None:
    """Read `motion.yaml`, none where it is missing.

    Raises:
        UserError: An unknown key, or a value that is no vector.
    """
    path = folder / "motion.yaml"
    if not path.is_file():
        return None
    content = read_yaml(path)
    try:
        check_keys(content, "the file", ("format", "velocity", "angular_velocity", "centre"), ("angular_velocity", "centre"))
        if content["format"] != MOTION:
            raise UserError(f"format is {content['format']!r}, not {MOTION!r}")
        vectors = {key: vector(value, key) for key, value in content.items() if key != "format"}
    except UserError as error:
        raise located(path, error) from error
    return Motion(**vectors)


def write_motion(motion: Motion, folder: Path) -> None:
    """Write `motion.yaml`."""
    content: dict[str, Any] = {"format": MOTION}
    content |= {key: list(value) for key, value in motion._asdict().items() if value is not None}
    write_text(folder / "motion.yaml", yaml.safe_dump(content, sort_keys=False, default_flow_style=None))


def read_body(path: Path) -> Body:
    """Read `body.npz` of a reconstruction.

    Raises:
        UserError: A missing array, a shape that does not fit, a number that is not finite.
    """
    arrays = _arrays(path, {"x0": (-1, 3), "v0": (-1, 3), "volume": (-1,)})
    if len({len(array) for array in arrays.values()}) != 1 or not (arrays["volume"] > 0).all():
        raise UserError(f"{path}: x0, v0 and volume must have one length, and volumes be positive")
    x, v, volume = (torch.from_numpy(arrays[key].astype(np.float32)) for key in ("x0", "v0", "volume"))
    return Body(x, v, volume)


def read_truth(folder: Path, *, frame_step: int = 1, frames: int | None = None) -> Truth | None:
    """Read truth.npz and truth.yaml of a synthetic scene, none where they are missing.

    Args:
        folder: The scene's folder.
        frame_step: Take each n-th frame.
        frames: Number of frames; all where absent.

    Raises:
        UserError: A file that is malformed, or the truth of another motion.
    """
    if not (folder / "truth.npz").is_file() or not (folder / "truth.yaml").is_file():
        return None
    path = folder / "truth.npz"
    arrays = _arrays(path, {"x": (-1, -1, 3), "x0": (-1, 3), "volume": (-1,), "times": (-1,)})
    if len({arrays["x"].shape[1], len(arrays["x0"]), len(arrays["volume"])}) != 1 or len(arrays["x"]) != len(arrays["times"]):
        raise UserError(f"{path}: the shapes of x, x0, volume and times do not fit one another")
    content = read_yaml(folder / "truth.yaml")
    try:
        law = scenes.model_from_dict(content.get("law", {}))
    except UserError as error:
        raise UserError(f"{folder / 'truth.yaml'}: {error}") from error
    x, times = torch.from_numpy(arrays["x"])[::frame_step][:frames].float(), torch.from_numpy(arrays["times"])[::frame_step][:frames]
    if frames is not None and len(times) < frames:
        raise UserError(f"{path} has {len(times)} frames, the recording {frames}")
    return Truth(x, torch.from_numpy(arrays["x0"]).float(), torch.from_numpy(arrays["volume"]).float(), times.double(), law)


def _arrays(path: Path, shapes: dict[str, tuple[int, ...]]) -> dict[str, np.ndarray]:
    arrays = read_arrays(path, shapes)
    for key, shape in shapes.items():
        array = arrays[key]
        if array.ndim != len(shape) or any(n not in (-1, m) for n, m in zip(shape, array.shape)) or not np.isfinite(array).all():
            raise UserError(f"{path}: {key} has the shape {array.shape}, or holds a NaN or an infinity")
    return arrays
