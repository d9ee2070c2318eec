"""Generation of the clips of `neuido film`: random bodies, rollouts with classical laws, images, optical flow, samples of the law.

`neuido.data.clips` documents and reads the folder.
"""

import math
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from neuido.data.bodies.families import PARAMETERS, check_ranges, draw_parameters, effects, laws, sample_laws
from neuido.data.bodies.shapes import rigid_velocity
from neuido.data.cameras import intrinsics, look_at
from neuido.data.clips import FORMAT, is_complete
from neuido.data.files.output_folder import claimed_folder
from neuido.data.files.writing import is_as_written, noted_digest, sha256_of, write_arrays, write_json
from neuido.data.progress import Progress
from neuido.errors import UserError
from neuido.models.render.gaussians import deform, harmonics_of
from neuido.models.render.splatting import render
from neuido.models.video.clip_bodies import GROUPS, frame_steps, launch, random_body, random_shape
from neuido.models.video.flow import PRESETS, measure_velocities
from neuido.physics.mpm.simulator import COURANT_LIMIT, Simulator
from neuido.physics.runtime.device import choose_device
from neuido.types import Body, Cameras, Gaussians, ParticleState, Scene, Walls

DENSITY = 1000.0
"""Density of the bodies [kg/m^3]."""
FLOORS = (0.0, 0.5, math.inf)
"""Friction coefficients of the floor, one of which is sampled for each clip."""


@dataclass(frozen=True)
class ClipPlan:
    """Options that determine the content of the files; `neuido film` documents each of them."""

    count: int
    families: dict[str, dict[str, tuple[float, float]]]
    views: int
    frames: int
    frame_steps: int
    dts: tuple[float, ...]
    cells: int
    particles: int
    width: int
    flow_size: int
    flow_preset: str
    samples: int
    seed: int
    rates: tuple[float, float] | None = None
    shapes: str = "seen"
    published: bool = False
    held_out: float = 0.0
    speeds: tuple[float, float] = (0.5, 3.0)

    def __post_init__(self) -> None:
        for name, least in (("count", 1), ("views", 1), ("frames", 5), ("frame_steps", 1), ("cells", 4), ("particles", 8), ("samples", 1)):
            if getattr(self, name) < least:
                raise UserError(f"{name} must be at least {least}, got {getattr(self, name)}")
        if self.flow_size % 8 or not 16 <= self.flow_size <= self.width:
            raise UserError(f"flow_size = {self.flow_size} must be a multiple of 8 from 16 to width = {self.width}")
        if not self.dts or not all(dt > 0 for dt in self.dts) or self.flow_preset not in PRESETS:
            raise UserError(f"dts = {list(self.dts)} must be positive, and flow_preset = {self.flow_preset!r} one of {', '.join(PRESETS)}")
        if self.rates is not None and not (len(self.rates) == 2 and 0 < self.rates[0] <= self.rates[1] < math.inf):
            raise UserError(f"rates = {list(self.rates)} must be the smallest and the largest frame rate in 1/s, such as [24, 400]")
        if self.shapes not in GROUPS or not 0 <= self.held_out < 1:
            raise UserError(
                f"shapes = {self.shapes!r} must be one of {', '.join(GROUPS)}, and held_out = {self.held_out} from 0 to below 1"
            )
        if not (len(self.speeds) == 2 and 0 <= self.speeds[0] <= self.speeds[1] < math.inf):
            raise UserError(f"speeds = {list(self.speeds)} must be the smallest and the largest speed of a throw in m/s, such as [0.5, 3]")
        if not self.families:
            raise UserError(f"families is empty: name at least one of {', '.join(PARAMETERS)}")
        for family, ranges in self.families.items():
            check_ranges(family, ranges)

    def family_of(self, number: int) -> str:
        """Return the family of a clip; the families alternate."""
        return list(self.families)[number % len(self.families)]

    def shapes_of(self, number: int) -> str:
        """Return the group of shapes of a clip: the last ones have shapes that no other clip of the plan has."""
        return "held-out" if self.shapes == "seen" and number >= self.count - round(self.held_out * self.count) else self.shapes

    def body_options(self, number: int) -> tuple[int, str, bool]:
        """Return particles, group of shapes and whether published bodies are drawn, for `random_body`."""
        return self.particles, self.shapes_of(number), self.published


HALVINGS = 2
"""Maximum number of halvings of the time step of an unstable clip."""


class ClipSetup(NamedTuple):
    """Set-up of a clip before its simulation."""

    name: str
    family: str
    parameters: dict[str, float]
    shape: str
    """Name of the body's shape."""
    frame_steps: int
    """Substeps between frames."""
    scene: Scene
    body: Body
    gaussians: Gaussians
    cameras: Cameras


def generate_clips(
    plan: ClipPlan, out: str | os.PathLike, *, device: str = "auto", batch: int = 0, shard: int = 0, shards: int = 1, progress: bool = True
) -> None:
    """Generate the missing clips of a shard; the process that completes the set writes the index file."""
    folder, chosen = Path(out), choose_device(device)
    if not 0 <= shard < shards:
        raise UserError(f"shard = {shard} must be from 0 to shards - 1 = {shards - 1}")
    if batch < 0:
        raise UserError(f"batch must be 0 (automatic) or positive, got {batch}")
    content = {"format": FORMAT, "plan": asdict(plan)}
    with claimed_folder(folder, content, "clips of other options", compared="plan", shard=shard, shards=shards):
        _generate_shard(plan, folder, chosen, batch, range(shard, plan.count, shards), shards, progress)


def _generate_shard(plan: ClipPlan, folder: Path, chosen: torch.device, batch: int, own: range, shards: int, progress: bool) -> None:
    names = [f"clip-{i:05d}" for i in range(plan.count)]
    published = (folder / "index.json").is_file()  # by an earlier version, maybe, which noted no digests

    def whole(name: str) -> bool:
        return is_complete(folder / f"{name}.npz") and is_as_written(folder / f"{name}.npz", unnoted=published)

    def left_out(name: str) -> bool:
        return (folder / f"{name}.json").is_file()

    missing = [i for i in own if not left_out(names[i]) and not whole(names[i])]
    size, workers = batch or (16 if chosen.type == "cuda" else 1), max(1, (os.cpu_count() or 1) // shards)
    with Progress("clips", len(own), done=len(own) - len(missing), shown=progress) as work:
        for wanted in _launches(plan, missing, size):
            with ThreadPoolExecutor(workers if size > 1 else 1) as pool:
                group = list(pool.map(lambda i: sample_clip(plan, i), wanted))
                filmed = film_clips(plan, group, chosen, note=work.print)
                for written in [pool.submit(_write_clip, plan, folder, clip, seen) for clip, seen in zip(group, filmed)]:
                    written.result()
            work.update(len(group))
    kept = [i for i, name in enumerate(names) if not left_out(name)]
    if (missing or not published) and all((folder / f"{names[i]}.npz").is_file() for i in kept):  # else a shard that ends later does it
        _write_index(plan, folder, kept, own, whole, progress)


def _write_index(plan: ClipPlan, folder: Path, kept: list[int], own: range, whole: Callable[[str], bool], progress: bool) -> None:
    """Write index.json if the clips of other shards are whole; the own ones were checked before, or just written."""

    def digest(number: int) -> str | None:
        name = f"clip-{number:05d}"
        if number in own or whole(name):
            return noted_digest(folder / f"{name}.npz") or sha256_of(folder / f"{name}.npz")
        return None

    entries = []
    with Progress("check of all clips", len(kept), unit="clips", shown=progress) as work, ThreadPoolExecutor(os.cpu_count()) as pool:
        for number, found in zip(kept, pool.map(digest, kept)):
            if found is not None:
                entries.append(_entry(plan, number, found))
            work.update()
    if len(entries) == len(kept):
        write_json(folder / "index.json", {"format": FORMAT, "plan": asdict(plan), "clips": entries})


def _launches(plan: ClipPlan, numbers: list[int], size: int) -> list[list[int]]:
    """Return the numbers of clips in lists for one launch each, in a random order: a part of them has all families."""
    lists = [wanted[start : start + size] for wanted in alike(plan, numbers) for start in range(0, len(wanted), size)]
    return [lists[k] for k in np.random.default_rng(plan.seed).permutation(len(lists))]


def alike(plan: ClipPlan, numbers: list[int]) -> list[list[int]]:
    """Return the numbers of clips in lists of one family and one number of substeps between frames, which share a launch."""
    lists: dict[tuple[str, int], list[int]] = {}
    for i in numbers:
        lists.setdefault((plan.family_of(i), steps_of(plan, i)), []).append(i)
    return list(lists.values())


def steps_of(plan: ClipPlan, number: int) -> int:
    """Return the number of substeps between the frames of a clip."""
    return _timing(plan, number, *_material(plan, number))[1]


def _entry(plan: ClipPlan, number: int, digest: str) -> dict[str, Any]:
    """Return what index.json says of a clip whose file has a SHA-256."""
    family, parameters = _material(plan, number)
    shape = random_shape(_source(plan, number, "body"), plan.shapes_of(number), plan.published)
    return {"name": f"clip-{number:05d}", "family": family, "parameters": parameters, "shape": shape, "sha256": digest}


def _source(plan: ClipPlan, number: int, what: str) -> np.random.Generator:
    """Return the source of randomness of a part of a clip."""
    return np.random.default_rng([plan.seed, number, ("material", "timing", "body", "film").index(what)])


def _timing(plan: ClipPlan, number: int, family: str, parameters: dict[str, float]) -> tuple[float, int]:
    """Return the substep [s] and the number of substeps between the frames of a clip."""
    random = _source(plan, number, "timing")
    speed = math.sqrt(float(laws(family, [parameters])[0].modulus()) / DENSITY)
    limit = 0.9 * COURANT_LIMIT / plan.cells / max(speed, 1e-9)
    if plan.rates is not None:
        return frame_steps(plan.rates, min(limit, max(plan.dts)), random)
    dt = float(random.choice(plan.dts))
    return (min(plan.dts) if dt > limit else dt), plan.frame_steps


def sample_clip(plan: ClipPlan, number: int, *, fill: int = 0) -> ClipSetup:
    """Sample the set-up of the clip of a given number: material, frame rate, floor, body, launch, texture and cameras.

    Args:
        plan: The plan.
        number: Number of the clip.
        fill: Number of the filling of the body: 0 is the one that is filmed, another is the same body with other particles.
    """
    family, parameters = _material(plan, number)
    dt, steps = _timing(plan, number, family, parameters)
    shape, points, volume = random_body(_source(plan, number, "body"), *plan.body_options(number))
    random = _source(plan, number, "film")
    scene = Scene(cells=plan.cells, dt=dt, walls=Walls(friction=float(random.choice(FLOORS))))
    lift, velocity, spin = launch(random, points, dt * steps * (plan.frames - 1), plan.speeds)
    centre = tuple((points.mean(0) + lift).tolist())
    if fill:
        _, points, volume = random_body(_source(plan, number, "body"), *plan.body_options(number), fill=fill)
    x = torch.from_numpy(points + lift)
    v = rigid_velocity(x, centre=centre, velocity=velocity, angular_velocity=spin)  # type: ignore[arg-type]
    body = Body(x.float(), v.float(), torch.full((len(x),), volume / len(x)))
    gaussians, cameras = _textured_gaussians(random, body, volume), _cameras(random, plan, (0.5, 0.35, 0.5))
    return ClipSetup(f"clip-{number:05d}", family, parameters, shape, steps, scene, body, gaussians, cameras)


def film_clips(
    plan: ClipPlan, group: list[ClipSetup], device: torch.device, *, note: Callable[[str], Any] = lambda line: None
) -> Iterator[dict[str, Tensor] | None]:
    """Simulate and render clips of one family and one number of substeps between frames.

    Yields images, masks and samples of the law of each, on the CPU; None for a clip that no time step makes stable. `note` is called with a
    line for each event that makes a motion doubtful.
    """
    for clip, motion in zip(group, simulate_clips(group, plan.frames, device, note), strict=True):
        yield None if motion is None else {**render_clip(clip, motion, device), **_samples(motion, clip, plan.samples)}


def render_clip(clip: ClipSetup, motion: ParticleState, device: torch.device) -> dict[str, Tensor]:
    """Render the motion of a clip: images (V, T, H, W, 3) and masks (V, T, H, W), on the CPU."""
    gaussians = Gaussians(*(None if t is None else t.to(device) for t in clip.gaussians))
    cameras = clip.cameras._replace(viewmats=clip.cameras.viewmats.to(device), Ks=clip.cameras.Ks.to(device))
    with torch.no_grad():
        images, alphas = render(deform(gaussians, motion.F, motion.x), cameras, background=torch.ones(3, device=device))
    return {"images": images.transpose(0, 1).cpu(), "masks": alphas.transpose(0, 1).cpu()}


def simulate_clips(
    group: list[ClipSetup], frames: int, device: torch.device, note: Callable[[str], Any] = lambda line: None, halvings: int = 0
) -> list[ParticleState | None]:
    """Simulate clips together; an unstable clip is repeated alone with half and a quarter of the time step, and is None at last."""
    share = 2**halvings
    scenes = [replace(c.scene, dt=c.scene.dt / share) for c in group]
    family, parameters, every = group[0].family, [c.parameters for c in group], group[0].frame_steps * share
    try:
        simulator = Simulator(scenes, [c.body for c in group], density=DENSITY, device=device, graphs=False)
        with torch.no_grad():
            found = simulator.rollout(every * (frames - 1), *laws(family, parameters), effects=effects(family, parameters), every=every)
    except UserError as error:
        if len(group) > 1:
            middle = len(group) // 2
            return [part for half in (group[:middle], group[middle:]) for part in simulate_clips(half, frames, device, note, halvings)]
        if halvings == HALVINGS:
            note(f"note: {group[0].name} is left out: {error}")
            return [None]
        return simulate_clips(group, frames, device, note, halvings + 1)
    for event in found.events:
        own = event._replace(first=event.first - simulator.particles.offsets[event.scene])
        note(f"note: {group[event.scene].name}: {own.words}")
    return [ParticleState(*(part[:, a:b] for part in found)) for a, b in pairwise(simulator.particles.offsets)]


def _write_clip(plan: ClipPlan, folder: Path, clip: ClipSetup, filmed: dict[str, Tensor] | None) -> None:
    """Measure the optical flow of a clip and write its file; of a clip that is left out, a file that says so."""
    if filmed is None:
        write_json(folder / f"{clip.name}.json", {"left_out": "no time step makes it stable", "parameters": clip.parameters})
        return
    times = torch.arange(plan.frames) * clip.scene.dt * clip.frame_steps
    options = {"size": plan.flow_size, "preset": plan.flow_preset, "threads": 1}
    seen = measure_velocities(filmed.pop("images"), filmed.pop("masks"), times, clip.cameras, clip.body.x.mean(0), **options)
    content = {"flow": seen.flow.half(), "cell": seen.cell, "frame_interval": torch.tensor(seen.frame_interval), **filmed}
    write_arrays(folder / f"{clip.name}.npz", {name: t.numpy() for name, t in content.items()}, compressed=False, digest=True)


def _samples(motion: ParticleState, clip: ClipSetup, count: int) -> dict[str, Tensor]:
    """Sample the law at deformations of the motion: trial and corrected F, and stress, (n, 3, 3) each."""
    F, C = motion.F[1:].flatten(0, 1), motion.C[1:].flatten(0, 1)
    number = int(clip.name.removeprefix("clip-"))
    pick = torch.randint(len(F), (count,), generator=torch.Generator().manual_seed(number)).to(F.device)
    sampled = sample_laws(*laws(clip.family, [clip.parameters]), F[pick], C[pick], clip.scene.dt)
    return {name: t.cpu() for name, t in zip(("trial", "corrected", "stress"), sampled)}


def _material(plan: ClipPlan, number: int) -> tuple[str, dict[str, float]]:
    family = plan.family_of(number)
    return family, draw_parameters(family, plan.families[family], _source(plan, number, "material"))


def _textured_gaussians(random: np.random.Generator, body: Body, volume: float) -> Gaussians:
    """Attach a Gaussian to each particle, coloured by a random sum of waves."""
    x = body.x.double().numpy()
    waves = random.standard_normal((3, 3, 3)) * random.uniform(12, 60, (3, 3, 1))
    phases = random.uniform(0, 2 * math.pi, (3, 3))
    colour = 0.5 + 0.22 * np.sin(np.einsum("cwk,pk->pcw", waves, x) + phases).sum(2) + 0.08 * random.standard_normal((len(x), 3))
    spread = 0.6 * (volume / len(x)) ** (1 / 3)
    covariance = (spread**2 * torch.eye(3)).expand(len(x), 3, 3).contiguous()
    return Gaussians(body.x, covariance, torch.full((len(x),), 0.95), harmonics_of(torch.from_numpy(colour.clip(0, 0.95)).float()))


def _cameras(random: np.random.Generator, plan: ClipPlan, target: tuple[float, float, float]) -> Cameras:
    views = []
    for _ in range(plan.views):
        azimuth, elevation = random.uniform(0, 2 * math.pi), math.radians(random.uniform(0, 35))
        radius = random.uniform(1.6, 2.4)
        flat = radius * math.cos(elevation)
        offset = (flat * math.sin(azimuth), radius * math.sin(elevation), flat * math.cos(azimuth))
        views.append(look_at(tuple(t + o for t, o in zip(target, offset)), target))  # type: ignore[arg-type]
    K = intrinsics(plan.width, plan.width, angle=math.radians(random.uniform(35, 45))).float()
    return Cameras(torch.stack(views).float(), K.expand(plan.views, 3, 3).contiguous(), plan.width, plan.width)
