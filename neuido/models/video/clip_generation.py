"""Generation of the clips of `neuido film`: random bodies, rollouts with classical laws, images, optical flow, samples of the law.

`neuido.data.clips` documents and reads the folder.
"""

import math
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from neuido.data.bodies.families import PARAMETERS, check_ranges, draw_parameters, evaluate, laws
from neuido.data.bodies.shapes import rigid_velocity
from neuido.data.cameras import intrinsics, look_at
from neuido.data.clips import FORMAT, is_complete
from neuido.data.files.output_folder import claimed_folder
from neuido.data.files.writing import is_as_written, sha256_of, write_arrays, write_json
from neuido.data.progress import Progress
from neuido.errors import UserError
from neuido.models.render.gaussians import deform, harmonics_of
from neuido.models.render.splatting import render
from neuido.models.video.flow import PRESETS, measure_velocities
from neuido.physics.mpm.simulator import COURANT_LIMIT, Simulator
from neuido.physics.runtime.device import choose_device
from neuido.types import Body, Cameras, Gaussians, ParticleState, Scene, Walls

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

    def __post_init__(self) -> None:
        for name, least in (("count", 1), ("views", 1), ("frames", 5), ("frame_steps", 1), ("cells", 4), ("particles", 8), ("samples", 1)):
            if getattr(self, name) < least:
                raise UserError(f"{name} must be at least {least}, got {getattr(self, name)}")
        if self.flow_size % 8 or not 16 <= self.flow_size <= self.width:
            raise UserError(f"flow_size = {self.flow_size} must be a multiple of 8 from 16 to width = {self.width}")
        if not self.dts or not all(dt > 0 for dt in self.dts) or self.flow_preset not in PRESETS:
            raise UserError(f"dts = {list(self.dts)} must be positive, and flow_preset = {self.flow_preset!r} one of {', '.join(PRESETS)}")
        if not self.families:
            raise UserError(f"families is empty: name at least one of {', '.join(PARAMETERS)}")
        for family, ranges in self.families.items():
            check_ranges(family, ranges)


HALVINGS = 2
"""Maximum number of halvings of the time step of an unstable clip."""


class ClipSetup(NamedTuple):
    """Set-up of a clip before its simulation."""

    name: str
    family: str
    parameters: dict[str, float]
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

    missing = [i for i in own if not whole(names[i])]
    size = batch or (16 if chosen.type == "cuda" else 1)
    kinds, workers = list(plan.families), max(1, (os.cpu_count() or 1) // shards)
    with Progress("clips", len(own), done=len(own) - len(missing), shown=progress) as work:
        for k in range(len(kinds)):
            wanted = [i for i in missing if i % len(kinds) == k]
            for start in range(0, len(wanted), size):
                with ThreadPoolExecutor(workers if size > 1 else 1) as pool:
                    group = list(pool.map(lambda i: sample_clip(plan, i), wanted[start : start + size]))
                    filmed = film_clips(plan, group, chosen, note=work.print)
                    list(pool.map(lambda pair: _write_clip(plan, folder, *pair), zip(group, filmed)))
                work.update(len(group))
    if (missing or not (folder / "index.json").exists()) and all(whole(name) for name in names):
        entries = []
        for i, name in enumerate(names):
            family, parameters = _material(plan, np.random.default_rng([plan.seed, i]), i)
            digest = sha256_of(folder / f"{name}.npz")
            entries.append({"name": name, "family": family, "parameters": parameters, "sha256": digest})
        write_json(folder / "index.json", {"format": FORMAT, "plan": asdict(plan), "clips": entries})


def sample_clip(plan: ClipPlan, number: int) -> ClipSetup:
    """Sample the set-up of the clip of a given number: material, floor, body, texture and cameras."""
    random = np.random.default_rng([plan.seed, number])
    family, parameters = _material(plan, random, number)
    dt = float(random.choice(plan.dts))
    modulus = float(laws(family, [parameters])[0].modulus())
    if dt * math.sqrt(modulus / 1000.0) > 0.9 * COURANT_LIMIT / plan.cells:
        dt = min(plan.dts)
    scene = Scene(cells=plan.cells, dt=dt, walls=Walls(friction=float(random.choice(FLOORS))))
    x, volume = _shape(random, plan.particles)
    height = random.uniform(0.01, 0.06)
    # the horizontal offset is small enough for the walls
    x = x + np.array([0.5 + random.uniform(-0.05, 0.05), height - x[:, 1].min(), 0.5 + random.uniform(-0.05, 0.05)])
    x = torch.from_numpy(x)
    centre = tuple(x.mean(0).tolist())
    velocity = (random.uniform(-0.5, 0.5), random.uniform(-3.0, -0.5), random.uniform(-0.5, 0.5))
    v = rigid_velocity(x, centre=centre, velocity=velocity, angular_velocity=tuple(random.uniform(-3, 3, 3).tolist()))
    body = Body(x.float(), v.float(), torch.full((len(x),), volume / len(x)))
    return ClipSetup(
        f"clip-{number:05d}",
        family,
        parameters,
        scene,
        body,
        _textured_gaussians(random, body, volume),
        _cameras(random, plan, (0.5, 0.35, 0.5)),
    )


def film_clips(
    plan: ClipPlan, group: list[ClipSetup], device: torch.device, *, note: Callable[[str], Any] = lambda line: None
) -> Iterator[dict[str, Tensor]]:
    """Simulate and render clips of one family; yield images, masks and samples of the law of each, on the CPU.

    `note` is called with a line for each event that makes a motion doubtful.
    """
    for clip, motion in zip(group, _simulate(plan, group, device, note), strict=True):
        gaussians = Gaussians(*(None if t is None else t.to(device) for t in clip.gaussians))
        cameras = clip.cameras._replace(viewmats=clip.cameras.viewmats.to(device), Ks=clip.cameras.Ks.to(device))
        with torch.no_grad():
            images, alphas = render(deform(gaussians, motion.F, motion.x), cameras, background=torch.ones(3, device=device))
        seen = {"images": images.transpose(0, 1).cpu(), "masks": alphas.transpose(0, 1).cpu()}
        yield seen | _samples(motion, clip, plan.samples, int(clip.name.removeprefix("clip-")))


def _simulate(
    plan: ClipPlan, group: list[ClipSetup], device: torch.device, note: Callable[[str], Any], halvings: int = 0
) -> list[ParticleState]:
    """Simulate the clips together; an unstable clip is repeated alone with half and a quarter of the time step."""
    share = 2**halvings
    scenes = [replace(c.scene, dt=c.scene.dt / share) for c in group]
    try:
        simulator = Simulator(scenes, [c.body for c in group], device=device, graphs=False)
        pair = laws(group[0].family, [c.parameters for c in group])
        every = plan.frame_steps * share
        with torch.no_grad():
            frames = simulator.rollout(every * (plan.frames - 1), *pair, every=every)
    except UserError as error:
        if len(group) > 1:
            middle = len(group) // 2
            return [part for half in (group[:middle], group[middle:]) for part in _simulate(plan, half, device, note, halvings)]
        if halvings == HALVINGS:
            raise UserError(f"{group[0].name}: {error}") from error
        return _simulate(plan, group, device, note, halvings + 1)
    for event in frames.events:
        own = event._replace(first=event.first - simulator.particles.offsets[event.scene])
        note(f"note: {group[event.scene].name}: {own.words}")
    parts = zip(simulator.particles.offsets[:-1], simulator.particles.offsets[1:])
    return [ParticleState(*(part[:, a:b] for part in frames)) for a, b in parts]


def _write_clip(plan: ClipPlan, folder: Path, clip: ClipSetup, filmed: dict[str, Tensor]) -> None:
    """Measure the optical flow of a clip and write its file."""
    times = torch.arange(plan.frames) * clip.scene.dt * plan.frame_steps
    options = {"size": plan.flow_size, "preset": plan.flow_preset}
    seen = measure_velocities(filmed.pop("images"), filmed.pop("masks"), times, clip.cameras, clip.body.x.mean(0), **options)
    content = {"flow": seen.flow.half(), "cell": seen.cell, "frame_interval": torch.tensor(seen.frame_interval), **filmed}
    write_arrays(folder / f"{clip.name}.npz", {name: t.numpy() for name, t in content.items()}, compressed=False, digest=True)


def _samples(motion: ParticleState, clip: ClipSetup, count: int, seed: int) -> dict[str, Tensor]:
    """Sample the law at deformations of the motion: trial and corrected F, and stress, (n, 3, 3) each."""
    elastic, plastic = laws(clip.family, [clip.parameters])
    F, C = motion.F[1:].flatten(0, 1).double(), motion.C[1:].flatten(0, 1).double()
    pick = torch.randint(len(F), (count,), generator=torch.Generator().manual_seed(seed)).to(F.device)
    trial = (F[pick] + clip.scene.dt * C[pick] @ F[pick]).float()
    corrected = evaluate(plastic, trial)
    return {"trial": trial.cpu(), "corrected": corrected.cpu(), "stress": evaluate(elastic, corrected).cpu()}


def _material(plan: ClipPlan, random: np.random.Generator, number: int) -> tuple[str, dict[str, float]]:
    family = list(plan.families)[number % len(plan.families)]
    return family, draw_parameters(family, plan.families[family], random)


def _shape(random: np.random.Generator, particles: int) -> tuple[np.ndarray, float]:
    """Sample the points (P, 3) and the volume [m^3] of a randomly rotated ball, box, cylinder or union of ellipsoids about the origin.

    Half of the bodies are unions: three thick ellipsoids, or a trunk with four thin limbs, which bend long before the trunk yields.
    """
    kind = random.choice(["ball", "box", "cylinder", "blob", "limbs", "limbs"])
    half = random.uniform(0.09, 0.24, 3)
    points = random.uniform(-1, 1, (max(20_000, 25 * particles), 3))
    if kind == "ball":
        half, inside = np.full(3, half[0]), (points**2).sum(1) < 1
    elif kind == "box":
        inside = np.ones(len(points), dtype=bool)
    elif kind == "cylinder":
        inside = points[:, 0] ** 2 + points[:, 2] ** 2 < 1
    elif kind == "limbs":
        half = random.uniform(0.17, 0.3, 3)
        inside = (((points / random.uniform(0.3, 0.6, 3)) ** 2).sum(1) < 1) | _limbs(random, points)
    else:
        centres, radii = random.uniform(-0.45, 0.45, (3, 3)), random.uniform(0.35, 0.55, (3, 1, 3))
        inside = ((((points - centres[:, None]) / radii) ** 2).sum(2) < 1).any(0)
    volume = float(8 * half.prod() * inside.mean())
    filled = points[inside] * half
    # one point per cell of a jittered grid: even, without the rows of a lattice
    spacing = (volume / particles) ** (1 / 3)
    place = np.floor(filled / spacing).astype(np.int64) + 10_000
    cell = np.unique(place @ np.array([10**10, 10**5, 1]), return_index=True)[1]
    turn, _ = np.linalg.qr(random.standard_normal((3, 3)))
    return filled[cell] @ turn, volume


def _limbs(random: np.random.Generator, points: np.ndarray) -> np.ndarray:
    """Return a mask of the points in one of four capsules that start at the origin."""
    tips = random.standard_normal((4, 3))
    tips *= random.uniform(0.5, 0.95, (4, 1)) / np.linalg.norm(tips, axis=1, keepdims=True)
    along = np.clip(points @ tips.T / (tips**2).sum(1), 0, 1)
    distance = np.linalg.norm(points[:, None] - along[..., None] * tips, axis=2)
    return (distance < random.uniform(0.12, 0.3, 4)).any(1)


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
