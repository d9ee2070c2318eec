"""A second attempt at a reader of families and properties: silhouettes and flow themselves, and clips without end.

    python benchmarks/motion_reader.py film --out data/motions --shard 0 --shards 10 --seconds 500 &   # one a core, stopped by the clock
    python benchmarks/motion_reader.py train --root data/motions --out runs/motion/reader.pt --seconds 400
    python benchmarks/motion_reader.py score --reader runs/motion/reader.pt --count 40 --out runs/motion/unseen

The first attempt (`neuido fit --config stage2_warmup_materials`) read latents of the flow of 3,600 clips of 20 shapes, and overfitted. Here
the network sees flow and silhouette of the body in 32 x 32 cells, so that clips can be zoomed, shifted, slowed down, cut and enlarged anew
in each step; the law is not a second output of the network, but that of the operator for the properties that were read. `score` writes the
tables of `benchmarks/unseen_scenes.py`.
"""

import argparse
import math
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import unseen_scenes
from torch import Tensor, nn
from torch.nn import functional

from neuido.data.files.writing import write_text
from neuido.data.files.yaml_files import read_configuration
from neuido.models.inference.prepared_scene import as_device, prepare
from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
from neuido.models.stages.made_scenes import made_scenes
from neuido.models.stages.property_latents import property_latents
from neuido.models.stages.true_properties import properties_of
from neuido.models.video.clip_generation import ClipPlan, _launches, film_clips, sample_clip
from neuido.models.video.encoder import scale_conditions
from neuido.models.video.flow import _crop_flow, body_window, optical_flow, pixel_length
from neuido.models.video.material_properties import LENGTH_POWERS, LOGARITHMIC, UNITS, to_scale
from neuido.models.video.pooling import AttentionPool, positions
from neuido.models.video.reader import Block, Reader

SIDE = 32
"""Cells along each side of the window around the body."""
MOVED = 5
"""Channels that the network sees of each cell: two of velocity, two of motion in cells a frame, and the body's coverage."""


class Motion(NamedTuple):
    """What is seen of a body in V views."""

    cells: Tensor
    """Velocity in the image plane [m/s] and coverage, (V, T - 1, 3, SIDE, SIDE)."""
    cell: Tensor
    """Side of a cell [m], (V,)."""
    interval: float
    """Time between frames [s]."""


def watch(images: Tensor, masks: Tensor, interval: float, cameras, centre: Tensor, preset: str) -> Motion:
    """Measure flow and coverage in a window about the body, of images (V, T, H, W, 3) and masks (V, T, H, W)."""
    flow, side = _crop_flow(optical_flow(images, preset=preset, threads=1), masks, SIDE)
    covered = []
    for mask in masks:
        top, left, width = body_window(mask)
        part = mask[:-1, None, top : top + width, left : left + width]
        covered.append(functional.interpolate(part, size=(SIDE, SIDE), mode="bilinear", antialias=True))
    pixel = pixel_length(cameras, centre)
    cells = torch.cat([(flow * (pixel / interval)[:, None, None, None, None]).permute(0, 1, 4, 2, 3), torch.stack(covered)], 2)
    return Motion(cells, pixel * side / SIDE, interval)


def plan_of(given: argparse.Namespace, shapes: str, held_out: float = 0.0) -> ClipPlan:
    ranges = read_configuration(given.films)["families"]
    families = {family: {name: (low, high) for name, (low, high) in own.items()} for family, own in ranges.items()}
    return ClipPlan(given.count, families, 2, given.frames, 5, (1e-3,), 32, given.particles, given.width, 64, "fast", 1, given.seed,
                    (24.0, 400.0), shapes, given.published, held_out, tuple(given.speeds))  # fmt: skip


# Clips.


def film(given: argparse.Namespace) -> None:
    """Film launches of a shard, in a random order, until the time is over; a launch that is there already is left as it is."""
    end = time.monotonic() + given.seconds
    plan, device, folder = plan_of(given, "seen", given.held_out), as_device(given.device), Path(given.out)
    folder.mkdir(parents=True, exist_ok=True)
    done = 0
    for wanted in _launches(plan, list(range(given.shard, plan.count, given.shards)), given.batch):
        path = folder / f"launch-{min(wanted):06d}.pt"
        if path.is_file():
            continue
        if time.monotonic() > end:
            break
        group = [sample_clip(plan, i) for i in wanted]
        rows = []
        for number, clip, seen in zip(wanted, group, film_clips(plan, group, device)):
            if seen is None:
                continue
            interval = clip.scene.dt * clip.frame_steps
            own = watch(seen["images"], seen["masks"], interval, clip.cameras, clip.body.x.mean(0), "fast")
            rows.append({"number": number, "held_out": plan.shapes_of(number) == "held-out", "family": clip.family,
                         "properties": properties_of(clip.family, clip.parameters), "cells": own.cells.half(), "cell": own.cell,
                         "interval": interval})  # fmt: skip
        part = path.with_suffix(".part")
        torch.save(rows, part)
        part.rename(path)
        done += len(rows)
    print(f"shard {given.shard}: {done} clips", flush=True)


class Clips(NamedTuple):
    """N clips on one device."""

    cells: Tensor
    """(N, V, T - 1, 3, SIDE, SIDE) float16."""
    cell: Tensor
    """(N, V)."""
    interval: Tensor
    """(N,)."""
    family: Tensor
    """(N,)."""
    properties: Tensor
    """On the scale of `to_scale`; zero where the material has none, (N, properties)."""
    present: Tensor
    """(N, properties)."""
    held_out: Tensor
    """(N,)."""


def load(root: Path, families: list[str], device: torch.device) -> Clips:
    with ThreadPoolExecutor(8) as pool:
        files = sorted(root.glob("launch-*.pt"))
        rows = [row for part in pool.map(lambda path: torch.load(path, weights_only=True), files) for row in part]
    values = torch.tensor([[to_scale(n, r["properties"][n]) if n in r["properties"] else math.nan for n in UNITS] for r in rows])
    return Clips(
        torch.stack([row["cells"] for row in rows]).to(device),
        torch.stack([row["cell"] for row in rows]).to(device),
        torch.tensor([row["interval"] for row in rows], dtype=torch.float32, device=device),
        torch.tensor([families.index(row["family"]) for row in rows], device=device),
        values.nan_to_num().to(device),
        (~values.isnan()).float().to(device),
        torch.tensor([row["held_out"] for row in rows], device=device),
    )


def inputs(cells: Tensor, cell: Tensor, interval: Tensor) -> tuple[Tensor, Tensor]:
    """Return the network's input (N, MOVED, T - 1, SIDE, SIDE) and conditions (N, 2) of N views."""
    velocity, covered = cells[:, :, :2], cells[:, :, 2:]
    step = velocity * (interval / cell)[:, None, None, None, None]
    seen = torch.cat([torch.asinh(velocity / 0.2), torch.asinh(step / 0.2), 2 * covered], 2).transpose(1, 2)
    return seen, torch.stack([(interval / 5e-3).log(), scale_conditions(interval, cell * SIDE / 64)[:, 1]], -1)


def vary(cells: Tensor, cell: Tensor, interval: Tensor, largest: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return cells (N, V, T - 1, 3, S, S), cell (N, V), interval (N,) of another film of each body, and the factor on its lengths (N,).

    Mirrored, turned by a few degrees and seen from nearer or farther; every second frame left out; cut at both ends; with noise; and
    enlarged at the same gravity and density, by which velocities and times grow as the root of lengths.
    """
    n, v, t = cells.shape[:3]
    like = {"device": cells.device}
    grow = largest ** (2 * torch.rand(n, **like) - 1)
    side = torch.where(torch.rand(n, v, **like) < 0.5, 1.0, -1.0)
    angle, zoom = 0.12 * (torch.rand(n, v, **like) - 0.5), torch.exp(0.5 * torch.rand(n, v, **like) - 0.15)
    shift = 0.25 * (torch.rand(n, v, 2, **like) - 0.5)
    c, s = angle.cos(), angle.sin()
    turn = torch.stack([torch.stack([side * c, -side * s], -1), torch.stack([s, c], -1)], -2)  # an orthogonal matrix, from new to old
    theta = torch.cat([zoom[..., None, None] * turn, shift[..., None]], -1).flatten(0, 1)
    frames = cells.flatten(0, 1).flatten(1, 2)
    grid = functional.affine_grid(theta, (n * v, 1, SIDE, SIDE), align_corners=False)
    cells = functional.grid_sample(frames, grid.to(frames.dtype), align_corners=False).unflatten(1, (t, 3)).unflatten(0, (n, v))
    speed = torch.einsum("nvji,nvtjhw->nvtihw", turn.to(cells), cells[:, :, :, :2])
    fuzz = 1 + 0.05 * torch.randn(n, v, 1, 1, 1, 1, **like)
    grain = 0.02 * cell[..., None, None, None, None] / interval[:, None, None, None, None, None]
    speed = fuzz * speed + grain * torch.randn(speed.shape, **like) * cells[:, :, :, 2:]
    cells = torch.cat([speed.to(cells) * grow.sqrt()[:, None, None, None, None, None], cells[:, :, :, 2:]], 3)
    half = torch.rand(n, **like) < 0.3
    pairs = t // 2
    slow = torch.zeros_like(cells)
    slow[:, :, :pairs, :2] = 0.5 * (cells[:, :, 0 : 2 * pairs : 2, :2] + cells[:, :, 1 : 2 * pairs : 2, :2])
    slow[:, :, :pairs, 2:] = cells[:, :, 0 : 2 * pairs : 2, 2:]
    cells = torch.where(half[:, None, None, None, None, None], slow, cells)
    length = torch.where(half, pairs, t)
    first = (torch.rand(n, **like) * 0.1 * length * (torch.rand(n, **like) < 0.5)).long()
    last = (length * (1 - 0.4 * torch.rand(n, **like) * (torch.rand(n, **like) < 0.5))).long()
    at = torch.arange(t, **like)[None] + first[:, None]
    kept = (at < last[:, None])[:, None, :, None, None, None]
    cells = cells.gather(2, at.clamp(max=t - 1)[:, None, :, None, None, None].expand_as(cells)) * kept
    return cells, cell * zoom * grow[:, None], interval * grow.sqrt() * (1 + half), grow


# The network.


class MotionReader(Reader):
    """`Reader` that sees flow and silhouettes instead of latents of the flow."""

    def __init__(self, families: list[str], width: int = 240, dropout: float = 0.2):
        super().__init__(families, channels=MOVED, width=width, dropout=dropout)
        del self.entry, self.film, self.down, self.blocks
        sizes = [width // 5, 2 * width // 5, 4 * width // 5, width]
        self.downs = nn.ModuleList(
            nn.Conv3d(a, b, 3, stride=2 if k else (1, 2, 2), padding=1) for k, (a, b) in enumerate(zip([MOVED, *sizes], sizes))
        )
        self.stages = nn.ModuleList(nn.Sequential(Block(size), Block(size)) for size in sizes)
        self.films = nn.ModuleList(nn.Sequential(nn.Linear(2, 64), nn.SiLU(), nn.Linear(64, 2 * size)) for size in sizes)
        self.pool = AttentionPool(width, 4)

    def describe(self, volume: Tensor, conditions: Tensor) -> Tensor:
        x = volume
        for down, film_, stage in zip(self.downs, self.films, self.stages):
            gain, shift = film_(conditions)[..., None, None, None].chunk(2, 1)
            x = stage(functional.silu(down(x)) * (1 + gain) + shift)
        tokens = (x + positions(x)).flatten(2).transpose(1, 2)
        return self.features(self.pool(self.dropout(self.norm(tokens))))


def train(given: argparse.Namespace) -> None:
    begun, device = time.monotonic(), as_device(given.device)
    torch.manual_seed(given.seed)
    families = list(read_configuration(given.films)["families"])
    clips = load(Path(given.root), families, device)
    own, held = (~clips.held_out).nonzero()[:, 0], clips.held_out.nonzero()[:, 0]
    print(f"{len(own)} clips, {len(held)} held out, loaded in {time.monotonic() - begun:.0f} s", flush=True)
    reader = MotionReader(families, given.reader_width, given.dropout).to(device)
    told = clips.present[own].bool()
    for p in range(len(UNITS)):
        values = clips.properties[own, p][told[:, p]]
        reader.centre[p], reader.spread[p] = values.mean(), values.std().clamp(min=1e-6)
    reader.known.copy_(torch.stack([clips.present[clips.family == f].sum(0) > 0 for f in range(len(families))]))
    powers = torch.tensor([LENGTH_POWERS[name] for name in UNITS], device=device)
    decayed = [p for p in reader.parameters() if p.ndim > 1]
    groups = [{"params": decayed}, {"params": [p for p in reader.parameters() if p.ndim < 2], "weight_decay": 0.0}]
    optimiser = torch.optim.AdamW(groups, lr=given.lr, weight_decay=0.05)
    average = torch.optim.swa_utils.AveragedModel(reader, multi_avg_fn=torch.optim.swa_utils.get_ema_multi_avg_fn(0.998))
    start, step, shown = time.monotonic(), 0, 0.0
    length = max(1.0, given.seconds - (start - begun) - given.reserve)
    while (passed := (time.monotonic() - start) / length) < 1 and step < given.steps:
        for group in optimiser.param_groups:
            group["lr"] = given.lr * min(1.0, (step + 1) / 200) * 0.5 * (1 + math.cos(math.pi * passed))
        chosen = own[torch.randint(len(own), (given.rows,), device=device)]
        views = slice(None) if torch.rand(()) < 0.6 else slice(k := int(torch.randint(clips.cell.shape[1], ())), k + 1)
        cells, cell, interval, grow = vary(
            clips.cells[chosen][:, views].float(), clips.cell[chosen][:, views], clips.interval[chosen], given.scale
        )
        target = (clips.properties[chosen] + powers * grow.log()[:, None] - reader.centre) / reader.spread
        with torch.autocast(device.type, torch.bfloat16, enabled=device.type == "cuda"):
            found = _found(reader, cells, cell, interval)
        found = type(found)(*(t.float() for t in found))
        loss = reader.loss(found, clips.family[chosen], target, clips.present[chosen])
        optimiser.zero_grad()
        loss.backward()
        if torch.isfinite(nn.utils.clip_grad_norm_(reader.parameters(), 1.0)):
            optimiser.step()
            average.update_parameters(reader)
        step += 1
        shown = float(loss.detach()) if step == 1 else 0.98 * shown + 0.02 * float(loss.detach())
        if step % given.every == 0:
            print(f"step {step}, {time.monotonic() - begun:.0f} s, loss {shown:.3f}, {judge(average.module, clips, held)}", flush=True)
    reader = average.module.eval() if step else reader.eval()
    with torch.no_grad():
        found, features = _evaluate(reader, clips, held)
        target = (clips.properties[held] - reader.centre) / reader.spread
        reader.calibrate(found, clips.family[held], target, clips.present[held])
        _, usual = _evaluate(reader, clips, own[:: max(1, len(own) // 2000)])
        reader.familiarise(usual, features)
    path = Path(given.out)
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.save({"families": families, "width": given.reader_width, "state": reader.state_dict(), "steps": step, "clips": len(own)}, path)
    print(f"{step} steps in {time.monotonic() - start:.0f} s, {judge(reader, clips, held)}; training clips: "
          f"{judge(reader, clips, own[:: max(1, len(own) // 1000)])}\nreader: {path}", flush=True)  # fmt: skip


def _found(reader: MotionReader, cells: Tensor, cell: Tensor, interval: Tensor):
    n, v = cell.shape
    seen, conditions = inputs(cells.flatten(0, 1), cell.flatten(), interval[:, None].expand(n, v).flatten())
    return reader(seen.unflatten(0, (n, v)), conditions.unflatten(0, (n, v)))


@torch.no_grad()
def _evaluate(reader: MotionReader, clips: Clips, numbers: Tensor):
    """Return the distributions of clips from all their views, and features with conditions of each view."""
    was, parts, features = reader.training, [], []
    reader.eval()
    for some in numbers.split(64):
        n, v = clips.cell[some].shape
        interval = clips.interval[some][:, None].expand(n, v).flatten()
        seen, conditions = inputs(clips.cells[some].float().flatten(0, 1), clips.cell[some].flatten(), interval)
        own = reader.describe(seen, conditions)
        features.append(torch.cat([own, conditions], 1))
        parts.append(reader.predict(own.unflatten(0, (n, v)).mean(1)))
    reader.train(was)
    return type(parts[0])(*(torch.cat(each) for each in zip(*parts))), torch.cat(features)


def judge(reader: MotionReader, clips: Clips, numbers: Tensor) -> str:
    """Return how often the family is named, and the median error of each property if it is told the family."""
    found, _ = _evaluate(reader, clips, numbers)
    family, row = clips.family[numbers], torch.arange(len(numbers), device=numbers.device)
    said = [f"named {100 * float((found.logits.argmax(1) == family).float().mean()):.0f} %"]
    error = ((found.mean[row, family] * reader.spread + reader.centre) - clips.properties[numbers]).abs()
    for p, name in enumerate(UNITS):
        own = error[clips.present[numbers, p].bool(), p]
        if len(own):
            said.append(f"{name} x {float(own.median().exp()):.2f}" if name in LOGARITHMIC else f"{name} +- {float(own.median()):.3g}")
    return ", ".join(said)


# Scores.


def score(given: argparse.Namespace) -> None:
    """Read unseen scenes, and roll out the operator's law for the family and properties that were read, and for the true ones."""
    device, end = as_device(given.device), time.monotonic() + given.seconds
    kept = torch.load(given.reader, weights_only=True, map_location=device)
    reader = MotionReader(kept["families"], kept["width"]).to(device).eval()
    reader.load_state_dict(kept["state"])
    operator = IntrinsicDynamicsOperator.load(given.operator).to(device).eval()
    latents = property_latents(operator)
    plan, rows, start = plan_of(given, "unseen"), [], time.perf_counter()
    out = Path(given.out)
    out.parent.mkdir(parents=True, exist_ok=True)
    for clip, _, scene in made_scenes(plan, range(given.count), device, fill=1):
        if time.monotonic() > end:
            break
        begun = time.perf_counter()
        interval = clip.scene.dt * clip.frame_steps
        seen = watch(scene.batch.images, scene.batch.masks, interval, clip.cameras, scene.body.x.mean(0), "fast")
        truth = properties_of(clip.family, clip.parameters)
        row: dict[str, Any] = {"scene": scene.name, "family": clip.family, "shape": clip.shape, "rate": 1 / interval, **truth}
        found = reader.read(*_views(seen, device))
        row |= unseen_scenes.compared(found, truth)
        row["backwards_unlike"] = int(reader.read(*_views(backwards(seen), device)).unlike)
        row["seconds"] = time.perf_counter() - begun
        prepared = prepare(scene, None, device=device, graphs=False)
        read = {one.name: one.value for one in found.properties}
        z = latents[found.family](read).to(device)
        row |= unseen_scenes.motions(prepared, operator, z, clip) | unseen_scenes.moduli(operator, z, clip)
        known = unseen_scenes.chamfer(prepared, operator, [latents[clip.family](truth).to(device)], 2)
        row["cd_properties"], row["cd_properties_ratio"] = known, known / row["cd_true"]
        rows.append(row)
        print(f"{len(rows)} {clip.family} as {found.family}, {clip.shape}, {row['rate']:.0f} fps, CD {row['cd_true']:.3g} true, "
              f"{row['cd_read']:.3g} read, {known:.3g} of the true properties", flush=True)  # fmt: skip
        unseen_scenes.write_rows(rows, out.with_suffix(".csv"))
    title = f"{kept['clips']} clips, {kept['steps']} steps, {len(rows)} scenes, {time.perf_counter() - start:.0f} s on {device}"
    oracle = unseen_scenes.quantile(sorted(row["cd_properties_ratio"] for row in rows), 0.5)
    text = unseen_scenes.summarise(rows, title) + f"\nCD with the law of the true properties, over CD of the true law: {oracle}.\n"
    write_text(out.with_suffix(".md"), text)
    print(text)


def backwards(seen: Motion) -> Motion:
    """Return the film played backwards."""
    cells = seen.cells.flip(1).clone()
    cells[:, :, :2] *= -1
    return seen._replace(cells=cells)


def _views(seen: Motion, device: torch.device) -> tuple[Tensor, Tensor]:
    return inputs(seen.cells.to(device), seen.cell.to(device), torch.full((len(seen.cell),), seen.interval, device=device))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=("film", "train", "score"))
    parser.add_argument("--films", default="configs/films_materials.yaml", help="configuration of `neuido film`, for the materials")
    parser.add_argument("--root", default="data/motions")
    parser.add_argument("--out", required=True)
    parser.add_argument("--count", type=int, default=24_000)
    parser.add_argument("--held-out", type=float, default=0.08, help="share of the clips whose shapes no training clip has")
    parser.add_argument("--frames", type=int, default=80)
    parser.add_argument("--particles", type=int, default=6000)
    parser.add_argument("--width", type=int, default=192)
    parser.add_argument("--speeds", type=float, nargs=2, default=(0.5, 3.0), help="downward speeds of throws [m/s]")
    parser.add_argument("--published", action="store_true", help="draw from the bodies of the literature too; they lie in NEUIDO_DATA")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--shard", type=int, default=0)
    parser.add_argument("--shards", type=int, default=1)
    parser.add_argument("--batch", type=int, default=16, help="clips of a launch")
    parser.add_argument("--seconds", type=float, default=1e9, help="when to stop")
    parser.add_argument("--reserve", type=float, default=15.0, help="of the seconds, for calibration and writing")
    parser.add_argument("--steps", type=int, default=1_000_000)
    parser.add_argument("--rows", type=int, default=64, help="clips of a step")
    parser.add_argument("--every", type=int, default=250)
    parser.add_argument("--lr", type=float, default=6e-4)
    parser.add_argument("--scale", type=float, default=2.0, help="largest factor on lengths")
    parser.add_argument("--dropout", type=float, default=0.2)
    parser.add_argument("--reader-width", type=int, default=240)
    parser.add_argument("--reader", default="runs/motion/reader.pt")
    parser.add_argument("--operator", default="pretrained-materials")
    parser.add_argument("--device", default="auto")
    given = parser.parse_args()
    np.seterr(all="ignore")
    {"film": film, "train": train, "score": score}[given.command](given)


if __name__ == "__main__":
    main()
