"""Synthetic scenes: simulate a body of known material, film it from several views, and write images and truth.

The images are rendered from a denser set of Gaussians than any model sees. Each particle carries several Gaussians, which move with its x
and F and are coloured by a solid texture of the position at t = 0. A scene is an experiment folder with one recording, `drop`;
`neuido.data.scenes.filmed_scene` describes it. Scenes are written atomically, so a killed run continues with the missing ones.
"""

import os
import re
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
import yaml
from torch import Tensor

from neuido.data import cameras as convert
from neuido.data.bodies import scene_files as scenes
from neuido.data.bodies.shapes import rigid_velocity
from neuido.data.files.output_folder import claimed_folder
from neuido.data.files.parsing import read_yaml
from neuido.data.files.values import check_keys, mapping, vector
from neuido.data.files.writing import new_folder, write_arrays, write_json, write_png, write_text
from neuido.data.formats import nerfstudio
from neuido.data.measured.experiment import Experiment, Recording, read_experiment, write_experiment
from neuido.data.progress import Progress
from neuido.data.scenes.film_options import Film
from neuido.data.scenes.filmed_scene import Motion, write_motion
from neuido.errors import UserError
from neuido.physics.laws.classical import material
from neuido.physics.mpm.simulator import Simulator
from neuido.physics.runtime.device import choose_device
from neuido.physics.runtime.frames import Frames
from neuido.types import Body, Cameras, ParticleState, Scene

FORMAT = "neuido-scenes/1"
RECORDING = "drop"
PARTS = ("scene", "model", "body", "discretisation")
SCENE_KEYS = ("name", "base", "velocity", "angular_velocity", "shift", "declared", "belief", "split", "substeps")
SPLITS = ("train", "unseen")
JELLY = {"density": 1000.0, "elasticity": {"law": "fixed_corotated", "young": 1e5, "poisson": 0.2}, "plasticity": {"law": "identity"}}
"""Declared model of a scene that gives none: NCLaw's jelly, from which NeuMA starts too."""

IMAGES_AT_ONCE = {"cpu": 8, "cuda": 80}
WIDTH = 0.45
"""Standard deviation of a Gaussian over the spacing of the dense set; the overlapping Gaussians then look opaque."""

INSET = 0.8
"""Distance of the Gaussians from the border of the volume of their particle, in standard deviations; preserves the apparent size."""

OPACITY = 0.9
Draw = Callable[..., tuple[Tensor, Tensor]]
"""Type of `neuido.models.rasterize`, which is passed in because `neuido.data` does not import `neuido.models`."""


@dataclass(frozen=True)
class Plan:
    """A synthetic scene to generate."""

    name: str
    scene: Scene
    body: Body
    motion: Motion
    law: dict[str, Any]
    """The true density, elasticity and plasticity."""
    declared: dict[str, Any]
    """The declared density, elasticity and plasticity, written to experiment.yaml."""
    split: str
    substeps: int
    source: str


class DenseGaussians(NamedTuple):
    """Gaussians to render: M for each of P particles."""

    offset: Tensor
    """Offset from the particle at t = 0 [m], (P, M, 3)."""
    spread: Tensor
    """Isotropic standard deviation at t = 0 [m], (P,)."""
    colour: Tensor
    """RGB colours in [0, 1], (P M, 3)."""

    def at(self, x: Tensor, F: Tensor) -> tuple[Tensor, Tensor]:
        """Compute centres [m] (T, P M, 3) and covariances [m^2] (T, P M, 3, 3) for particles at x [m] (T, P, 3) with F (T, P, 3, 3)."""
        centres = x.unsqueeze(2) + torch.einsum("tpij,pmj->tpmi", F, self.offset)
        covariances = self.spread.square()[:, None, None] * (F @ F.mT)
        return centres.flatten(1, 2), covariances.repeat_interleave(self.offset.shape[1], dim=1)


def plan_scene(given: Mapping[str, Any], film: Film, *, data_root: str | os.PathLike | None = None) -> Plan:
    """Read one entry of the list `scenes` of `neuido scenes`.

    Args:
        given: `name`, and the keys scene, model, body and discretisation of a scene file; or `base`, the name of a built-in scene, and the
            keys that differ from it. Optionally velocity [m/s] and angular_velocity [rad/s] of the body, shift [m], declared (a model; the
            former name `belief` is accepted), split (train or unseen), and substeps between frames.
        film: Cameras and rendering options.
        data_root: Folder of the particle files.

    Raises:
        UserError: A key is unknown or missing, a value is outside its range, or the body lies outside the domain.
    """
    given = mapping(given, "a scene")
    name = given.get("name")
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]*", name):
        raise UserError(f"scenes: a name must consist of letters, digits, - and _, got {name!r}")
    try:
        content, source = dict[str, Any](), ""
        if "base" in given:
            path = scenes.scenes_folder() / f"{given['base']}.yaml"
            if given["base"] not in scenes.scene_names():
                raise UserError(f"base = {given['base']!r} is unknown: choose from {', '.join(scenes.scene_names())}")
            content = read_yaml(path)
            source = str(content.get("source", ""))
        for part in PARTS:
            own = mapping(given.get(part, {}), part)
            content[part] = own if part == "body" and own else {**content.get(part, {}), **own}
        check_keys(given, "the scene", (*SCENE_KEYS, *PARTS), (*SCENE_KEYS[1:], *PARTS))
        scene = scenes.scene_from_dict(content["scene"], content["discretisation"])
        law = scenes.model_from_dict(content["model"])
        if "declared" in given and "belief" in given:
            raise UserError("declared and its former name belief are both given: remove belief")
        own_model = given.get("declared") or given.get("belief")
        declared = scenes.model_from_dict(own_model or {**JELLY, "density": law["density"]})
        body = scenes.body_from_dict(content["body"], data_root)
        if "shift" in given:
            body = body._replace(x=body.x + torch.tensor(vector(given["shift"], "shift")))
        body, motion = _set_velocity(body, given)
        split, substeps = given.get("split", "train"), given.get("substeps", film.substeps)
        if split not in SPLITS:
            raise UserError(f"split = {split!r} is unknown: choose from {', '.join(SPLITS)}")
        if not isinstance(substeps, int) or substeps < 1:
            raise UserError(f"substeps must be a positive whole number, got {substeps!r}")
        if bool(((body.x < torch.tensor(scene.lower)) | (body.x > torch.tensor(scene.upper))).any()):
            raise UserError("particles of the body lie outside scene.domain: enlarge the domain or shift the body")
        Simulator(scene, body, density=law["density"], device="cpu").check_step(material(law["elasticity"], law["plasticity"])[0])
    except UserError as error:
        raise UserError(f"scenes: {name}: {error}") from error
    return Plan(name, scene, body, motion, law, declared, split, substeps, source)


def make_scenes(
    entries: list[dict[str, Any]],
    film: Film,
    out: str | os.PathLike,
    *,
    draw: Draw,
    data_root: str | os.PathLike | None = None,
    device: str = "auto",
    progress: bool = True,
) -> list[Path]:
    """Generate the missing scenes of a list; write `index.json` when all are complete.

    Args:
        entries: The scenes, as `plan_scene` reads them.
        film: Cameras and rendering options.
        out: Output folder, with one folder per scene.
        draw: The renderer, `neuido.models.rasterize`.
        data_root: Folder of the particle files; None: NEUIDO_DATA.
        device: auto, cpu or cuda.
        progress: Show a progress bar.

    Returns:
        The folders of the scenes.

    Raises:
        UserError: A scene is invalid, the simulation fails, or `out` holds other scenes.
    """
    _check(film)
    chosen = choose_device(device)
    plans = [plan_scene(entry, film, data_root=data_root) for entry in entries]
    if not plans or len({plan.name for plan in plans}) < len(plans):
        raise UserError("scenes must list at least one scene, and each name once")
    folder = Path(out).expanduser()
    paths = [folder / plan.name for plan in plans]
    content = {"format": FORMAT, "film": asdict(film), "scenes": entries}
    with claimed_folder(folder, content, "other scenes, or the same scenes with other film options"):
        missing = [(plan, path) for plan, path in zip(plans, paths) if not (path / "experiment.yaml").is_file()]
        images = film.views * film.frames
        with Progress("scenes", images * len(plans), unit="images", done=images * (len(plans) - len(missing)), shown=progress) as work:
            for plan, path in missing:
                work.say(plan.name)
                try:
                    with new_folder(path) as hidden:
                        make_scene(plan, film, hidden, draw=draw, device=chosen, advance=work.update, note=work.print)
                except UserError as error:
                    raise UserError(f"scenes: {plan.name}: {error}") from error
        index = [{"name": p.name, "split": p.split, "law": p.law, "particles": len(p.body.x), "substeps": p.substeps} for p in plans]
        write_json(folder / "index.json", {"format": FORMAT, "scenes": index})
    return paths


def make_scene(
    plan: Plan,
    film: Film,
    folder: Path,
    *,
    draw: Draw,
    device: torch.device,
    advance: Callable[[int], Any] = lambda images: None,
    note: Callable[[str], Any] = lambda line: None,
) -> None:
    """Simulate, film and write one scene; call `advance` with the number of images written, and `note` with what makes it doubtful."""
    frames = simulate_motion(plan, film, device)
    for event in frames.events:
        note(f"note: {plan.name}: {event.words}")
    times = torch.arange(film.frames, dtype=torch.float64) * plan.substeps * plan.scene.dt
    cameras = film_cameras(film)
    recording = folder / RECORDING
    nerfstudio.write_transforms(recording, cameras, times, held_out=film.held_out)
    dense = surround_with_gaussians(plan.body, film.density, seed=plan.name, device=device)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        previews = _film(dense, frames, cameras, film, recording, draw, pool, advance)
    _write_preview(previews, folder / "preview.png")
    x = frames.x.cpu().numpy()
    arrays = {"x": x, "x0": x[0], "volume": plan.body.volume.numpy(), "times": times.numpy()}
    write_arrays(folder / "truth.npz", arrays, compressed=False)
    truth = {"format": "neuido-truth/1", "name": plan.name, "law": plan.law, "split": plan.split, "substeps": plan.substeps}
    truth |= {"dt": plan.scene.dt, "particles": len(plan.body.x), "gaussians": len(dense.colour), "source": plan.source}
    write_text(folder / "truth.yaml", yaml.safe_dump(truth, sort_keys=False, default_flow_style=None))
    write_motion(plan.motion, folder)
    interval = plan.substeps * plan.scene.dt
    free = tuple(key for part in ("elasticity", "plasticity") for key in plan.declared[part] if key != "law")
    recorded = Recording(RECORDING, "fit", plan.scene, interval)
    write_experiment(Experiment(plan.name, folder, plan.scene, plan.declared, free, (recorded,)), folder)
    read_experiment(folder)  # raises if the written files cannot be read


def simulate_motion(plan: Plan, film: Film, device: torch.device) -> Frames:
    """Simulate the true motion of a scene; return its frames, with x (T, P, 3) and F (T, P, 3, 3)."""
    simulator = Simulator(plan.scene, plan.body, density=plan.law["density"], device=device)
    if film.frames == 1:
        return Frames(*(part[None] for part in simulator.state))
    laws = material(plan.law["elasticity"], plan.law["plasticity"])
    with torch.no_grad():
        return simulator.rollout((film.frames - 1) * plan.substeps, *laws, every=plan.substeps)


def film_cameras(film: Film) -> Cameras:
    """Place the cameras of a film around its target."""
    options = {"target": film.target, "radius": film.radius, "elevations": film.elevations, "angle": film.angle}
    return convert.orbit(film.views, width=film.width, height=film.height, start=18.0, **options)


def surround_with_gaussians(body: Body, density: int, *, seed: str, device: torch.device | str = "cpu") -> DenseGaussians:
    """Draw `density` textured Gaussians in the volume of each particle of a body; `seed` is any text."""
    generator = np.random.default_rng(list(seed.encode()))
    edge = body.volume.double().pow(1 / 3).numpy()
    spread = WIDTH * edge / density ** (1 / 3)
    offset = generator.uniform(-1, 1, (len(edge), density, 3)) * (0.5 * edge - INSET * spread).clip(0)[:, None, None]
    colour = solid_texture((body.x.double().numpy()[:, None] + offset).reshape(-1, 3), generator)
    parts = (offset, spread, colour)
    return DenseGaussians(*(torch.from_numpy(part).float().to(device) for part in parts))


def solid_texture(x: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Compute a random solid texture at points x (N, 3): RGB in [0, 1] (N, 3), patches of four colours with a fine grain.

    The width of the patches is some tenths of the size of the body, so that optical flow finds structure everywhere.
    """
    size = float(np.ptp(x, axis=0).max())
    hue = generator.uniform(0, 1) + np.array([0.0, 0.18, 0.5, 0.68])
    palette = np.stack([0.5 + 0.42 * np.cos(2 * np.pi * (hue - shift)) for shift in (0.0, 1 / 3, 2 / 3)], 1) * [
        [0.95],
        [0.6],
        [0.8],
        [0.45],
    ]
    fields = [_waves(x, generator, 0.3 * size) for _ in palette]
    weight = np.exp(5 * np.stack(fields, 1))
    colour = weight @ palette / weight.sum(1, keepdims=True)
    return np.clip(colour * (1 + 0.2 * _waves(x, generator, 0.1 * size))[:, None], 0.02, 0.98)


def _waves(x: np.ndarray, generator: np.random.Generator, length: float, count: int = 8) -> np.ndarray:
    """Compute a random field at x (N, 3) from waves of about this length in all directions; its mean square is 1/2."""
    k = generator.normal(size=(count, 3))
    k *= 2 * np.pi / (length * generator.uniform(0.7, 1.4, (count, 1)) * np.linalg.norm(k, axis=1, keepdims=True))
    return np.sin(x @ k.T + generator.uniform(0, 2 * np.pi, count)).sum(1) / np.sqrt(count)


def _film(
    dense: DenseGaussians,
    frames: ParticleState,
    cameras: Cameras,
    film: Film,
    folder: Path,
    draw: Draw,
    pool: ThreadPoolExecutor,
    advance: Callable[[int], Any],
) -> np.ndarray:
    """Render and write all images; return those of two views at eight times for the preview, (2, 8, H, W, 4) uint8."""
    device = frames.x.device
    opacity = torch.full((len(dense.colour),), OPACITY, device=device)
    viewmats, Ks = cameras.viewmats.to(device), cameras.Ks.to(device)
    shown = np.linspace(0, film.frames - 1, 8).round().astype(int)
    kept: dict[tuple[int, int], np.ndarray] = {}
    size = max(1, IMAGES_AT_ONCE[device.type] // film.views)
    waiting = []
    for start in range(0, film.frames, size):
        some = slice(start, start + size)
        means, covariances = dense.at(frames.x[some], frames.F[some])
        with torch.no_grad():
            images, alphas = draw(means, covariances, opacity, dense.colour, viewmats, Ks, film.width, film.height)
        straight = images / alphas.unsqueeze(-1).clamp(min=1 / 255)  # PNG stores colours that are not multiplied by alpha
        pixels = torch.cat([straight, alphas.unsqueeze(-1)], -1).clamp(0, 1).mul(255).round().byte().cpu().numpy()
        for t, v in np.ndindex(*pixels.shape[:2]):
            path = folder / "images" / f"{v}_{start + t:03d}.png"
            waiting.append(pool.submit(_write_png, path, pixels[t, v], film.compression))
            if v in (0, film.views // 4) and start + t in shown:
                kept[v, start + t] = pixels[t, v]
        while len(waiting) > 2 * IMAGES_AT_ONCE["cuda"]:
            waiting.pop(0).result()
            advance(1)
    for one in waiting:
        one.result()
        advance(1)
    return np.array([[kept[v, t] for t in shown] for v in (0, film.views // 4)])


def _write_png(path: Path, rgba: np.ndarray, compression: int) -> None:
    write_png(path, cv2.cvtColor(rgba, cv2.COLOR_RGBA2BGRA), compression=compression)


def _write_preview(images: np.ndarray, path: Path, side: int = 160) -> None:
    """Write a contact sheet of two views over time, on white."""
    rows = []
    for row in images:
        rgb = [(i[..., :3] * (i[..., 3:] / 255) + 255 - i[..., 3:]).astype(np.uint8) for i in row]
        rows.append(np.concatenate([cv2.resize(i, (side, side), interpolation=cv2.INTER_AREA) for i in rgb], 1))
    nerfstudio.write_image(path, np.concatenate(rows, 0))


def _set_velocity(body: Body, given: Mapping[str, Any]) -> tuple[Body, Motion]:
    """Give the body the rigid motion of the entry, or else its own if that is rigid; return body and motion."""
    centre = tuple(round(c, 6) for c in body.x.double().mean(0).tolist())
    if "velocity" in given or "angular_velocity" in given:
        velocity = vector(given.get("velocity", [0.0, 0.0, 0.0]), "velocity")
        spin = vector(given.get("angular_velocity", [0.0, 0.0, 0.0]), "angular_velocity")
    else:
        velocity, spin = _rigid(body, centre)
    motion = Motion(velocity, spin, centre)  # type: ignore[arg-type]
    v = rigid_velocity(body.x.double(), centre=centre, velocity=velocity, angular_velocity=spin).float()  # type: ignore[arg-type]
    return body._replace(v=v), motion


def _rigid(body: Body, centre: tuple[float, ...]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Compute the velocity of the centre [m/s] and the angular velocity [rad/s] of a rigidly moving body.

    Raises:
        UserError: The motion is not rigid.
    """
    r, v = body.x.double() - torch.tensor(centre, dtype=torch.float64), body.v.double()
    mean = v.mean(0)
    inertia = r.square().sum() * torch.eye(3, dtype=torch.float64) - r.T @ r
    spin = torch.linalg.solve(inertia, torch.linalg.cross(r, v - mean).sum(0))
    rest = (v - mean - torch.linalg.cross(spin.expand_as(r), r)).norm(dim=1).max()
    if rest > 1e-3 * v.norm(dim=1).max() + 1e-9:
        raise UserError("the initial motion of the body is not rigid: give velocity and angular_velocity")
    return tuple(round(c, 6) for c in mean.tolist()), tuple(round(c, 6) for c in spin.tolist())


def _check(film: Film) -> None:
    for name in ("views", "width", "height", "frames", "substeps", "density"):
        if getattr(film, name) < 1:
            raise UserError(f"film.{name} must be at least 1, got {getattr(film, name)}")
    if any(not 0 <= v < film.views for v in film.held_out) or len(set(film.held_out)) >= film.views:
        raise UserError(f"film.held_out = {list(film.held_out)} must list some of the views 0..{film.views - 1}, not all")
    if not 0 <= film.compression <= 9:
        raise UserError(f"film.compression must lie in 0..9, got {film.compression}")
