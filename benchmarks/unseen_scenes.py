"""Zero-shot readings of unseen scenes: family, properties with their intervals, and motion, against the truth.

    python benchmarks/unseen_scenes.py --encoder pretrained --operator pretrained --out unseen

Forty made scenes of bodies whose shapes no training clip has, filmed by our renderer; the flow is measured in the images. The body is
known up to its filling: the particles that are simulated are not those that were filmed, so that the true law has a Chamfer distance
(CD) too, beside which that of the read law stands. Writes OUT.csv, a row for each scene, and OUT.md, the summary.
"""

import argparse
import csv
import math
import statistics
import time
from pathlib import Path
from typing import Any

import torch

from neuido.data.bodies.families import effects, laws
from neuido.data.files.writing import write_text
from neuido.data.files.yaml_files import read_configuration
from neuido.errors import UserError
from neuido.models.inference.pipeline import rollout_latent, rollout_laws, rollout_with_retries
from neuido.models.inference.prepared_scene import PreparedScene, as_device, prepare
from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
from neuido.models.operator.law_properties import p_wave_modulus
from neuido.models.scoring.motion_scores import chamfer_per_frame
from neuido.models.stages.made_scenes import made_scenes
from neuido.models.stages.true_properties import properties_of
from neuido.models.video.clip_generation import ClipPlan
from neuido.models.video.encoder import DynamicsEncoder
from neuido.models.video.flow import Velocities
from neuido.models.video.material_properties import LOGARITHMIC
from neuido.models.video.reader import Readings

RANDOM = 3
"""Random latents of a scene, of whose Chamfer distances the median is taken."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--encoder", default="pretrained")
    parser.add_argument("--operator", default="pretrained")
    parser.add_argument("--films", default="configs/films_materials.yaml", help="configuration of `neuido film`, for the materials")
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--views", type=int, default=2)
    parser.add_argument("--frames", type=int, default=80)
    parser.add_argument("--rates", type=float, nargs=2, default=(24.0, 400.0))
    parser.add_argument("--cells", type=int, default=32)
    parser.add_argument("--particles", type=int, default=6000)
    parser.add_argument("--width", type=int, default=192)
    parser.add_argument("--published", action="store_true", help="draw from the bodies of the literature too; they lie in NEUIDO_DATA")
    parser.add_argument("--readings-only", action="store_true", help="no rollouts")
    parser.add_argument("--seed", type=int, default=4040, help="of the scenes; training clips have others")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--out", default="runs/unseen", help="path of the tables without suffix")
    given = parser.parse_args()

    device = as_device(given.device)
    ranges = read_configuration(given.films)["families"]
    families = {family: {name: (low, high) for name, (low, high) in own.items()} for family, own in ranges.items()}
    plan = ClipPlan(given.count, families, given.views, given.frames, 5, (1e-3,), given.cells,
                    given.particles, given.width, 64, "fast", 16, given.seed, tuple(given.rates), "unseen", given.published)  # fmt: skip
    operator = IntrinsicDynamicsOperator.load(given.operator).to(device).eval()
    encoder = DynamicsEncoder.load(given.encoder).to(device).eval()
    rows: list[dict[str, Any]] = []
    start = time.perf_counter()
    for clip, _, scene in made_scenes(plan, range(given.count), device, fill=1):
        begun = time.perf_counter()
        row: dict[str, Any] = {"scene": scene.name, "family": clip.family, "shape": clip.shape}
        row["rate"] = 1 / (clip.scene.dt * clip.frame_steps)
        seen = encoder.measure_flow(scene.batch, range(given.views), scene.body.x.mean(0))
        volume, conditions = encoder.embed(seen)
        with torch.no_grad():
            z = encoder(volume, conditions)
        row |= read(encoder, volume, conditions, clip, seen)
        row["seconds"] = time.perf_counter() - begun
        row |= moduli(operator, z, clip)
        if not given.readings_only:
            row |= motions(prepare(scene, None, device=device, graphs=False), operator, z, clip)
        rows.append(row)
        print(f"{len(rows)}/{given.count} {row['scene']} {clip.family} {clip.shape} {row['rate']:.0f} fps: "
              + ", ".join(f"{k} {row[k]:.3g}" for k in ("young", "young_read", "cd_true", "cd_read") if k in row)
              + f", {row.get('family_read')}", flush=True)  # fmt: skip
        write_rows(rows, Path(f"{given.out}.csv"))
        title = f"{Path(given.encoder).name}, {len(rows)} scenes, {time.perf_counter() - start:.0f} s on {device}"
        write_text(Path(f"{given.out}.md"), summarise(rows, title))
    print(Path(f"{given.out}.md").read_text())


def read(encoder: DynamicsEncoder, volume, conditions, clip, seen: Velocities) -> dict[str, Any]:
    """Return what the reader says beside the truth; and whether the same film backwards is found to be unlike the training."""
    truth = properties_of(clip.family, clip.parameters)
    found = encoder.read(volume, conditions)
    if found is None:
        return dict(truth)
    backwards = encoder.read(*encoder.embed(seen._replace(flow=-seen.flow.flip(1))))
    return truth | compared(found, truth) | {"backwards_unlike": int(backwards.unlike)}


def compared(found: Readings, truth: dict[str, float]) -> dict[str, Any]:
    """Return what was read, and whether the truth is inside the intervals."""
    row: dict[str, Any] = {"family_read": found.family, "probability": found.families[found.family], "unlike": int(found.unlike)}
    row |= {"novelty": found.novelty, "limit": found.limit}
    for one in found.properties:
        row[f"{one.name}_read"], row[f"{one.name}_low"], row[f"{one.name}_high"] = one.value, one.low, one.high
        if one.name in truth:
            row[f"{one.name}_inside"] = int(one.low <= truth[one.name] <= one.high)
    return row


@torch.no_grad()
def moduli(operator: IntrinsicDynamicsOperator, z, clip) -> dict[str, float]:
    """Return the P-wave modulus [Pa] of the true law and of that of z."""
    true = float(laws(clip.family, [clip.parameters])[0].modulus())
    return {"modulus": true, "modulus_law": float(p_wave_modulus(operator, z[None])[0])}


def motions(prepared: PreparedScene, operator: IntrinsicDynamicsOperator, z, clip) -> dict[str, Any]:
    """Return the Chamfer distances of the true law, the read law, the mean latent and random latents on the same body."""
    elastic, plastic = laws(clip.family, [clip.parameters])
    rates = effects(clip.family, [clip.parameters])
    row = {"cd_true": chamfer_of(prepared, lambda scene: rollout_laws(scene, (elastic, plastic), scene.frames, effects=rates), 2)}
    mean = operator.latents.mean(0)
    drawn = operator.random_latents(RANDOM, torch.Generator().manual_seed(0))
    for name, latents, retries in (("read", [z], 2), ("mean", [mean], 0), ("random", list(drawn), 0)):
        row[f"cd_{name}"] = chamfer(prepared, operator, [own.to(z) for own in latents], retries)
    row["cd_ratio"] = row["cd_read"] / row["cd_true"]
    return row


def chamfer(prepared: PreparedScene, operator: IntrinsicDynamicsOperator, latents: list[torch.Tensor], retries: int) -> float:
    """Return the median Chamfer distance with the laws of latents."""
    return statistics.median(chamfer_of(prepared, lambda scene, own=own: rollout_latent(scene, operator, own), retries) for own in latents)


def chamfer_of(prepared: PreparedScene, run, retries: int) -> float:
    """Return the mean Chamfer distance of a rollout; infinity if no time step makes it run."""
    try:
        with torch.no_grad():
            motion, _ = rollout_with_retries(prepared, run, retries)
        return float(chamfer_per_frame(prepared, motion).mean())
    except UserError:
        return math.inf


def summarise(rows: list[dict[str, Any]], title: str) -> str:
    """Return the summary as Markdown."""
    lines = [f"Unseen scenes: {title}", "", "| family | scenes | named | E: factor, median | E: 90th percentile | E of z's law | inside | "
             "CD true | CD read | ratio | CD mean latent | CD random |", "| --- | " + "---: | " * 11]  # fmt: skip
    families = list(dict.fromkeys(row["family"] for row in rows))
    for name in [*families, "all"]:
        own = [row for row in rows if name in ("all", row["family"])]
        factors = sorted(factor(row["young_read"], row["young"]) for row in own if "young" in row and "young_read" in row)
        law = sorted(factor(row["modulus_law"], row["modulus"]) for row in own if "young" in row)
        inside = [row[key] for row in own for key in row if key.endswith("_inside")]
        named = [row["family_read"] == row["family"] for row in own if "family_read" in row]
        cells = [len(own), share(named), quantile(factors, 0.5), quantile(factors, 0.9), quantile(law, 0.5), share(inside)]
        cells += [
            quantile(sorted(row[key] for row in own if key in row), 0.5)
            for key in ("cd_true", "cd_read", "cd_ratio", "cd_mean", "cd_random")
        ]
        lines.append(f"| {name} | " + " | ".join(map(str, cells)) + " |")
    lines += ["", "| property | scenes | error, median | inside the 90 % interval |", "| --- | ---: | ---: | ---: |"]
    for name in ("young", "poisson", "yield_stress", "friction_angle", "viscosity"):
        own = [row for row in rows if name in row and f"{name}_read" in row]
        if own:
            logarithmic = name in LOGARITHMIC
            errors = sorted(factor(r[f"{name}_read"], r[name]) if logarithmic else abs(r[f"{name}_read"] - r[name]) for r in own)
            shown = f"factor {quantile(errors, 0.5)}" if logarithmic else quantile(errors, 0.5)
            lines.append(f"| {name} | {len(own)} | {shown} | {share([row[f'{name}_inside'] for row in own])} |")
    flagged = share([row["unlike"] for row in rows if "unlike" in row])
    backwards = share([row["backwards_unlike"] for row in rows if "backwards_unlike" in row])
    seconds = quantile(sorted(row["seconds"] for row in rows), 0.5)
    lines += ["", f"Found unlike the training: {flagged}; played backwards: {backwards}. From images to readings: {seconds} s.", ""]
    return "\n".join(lines)


def factor(a: float, b: float) -> float:
    """Return the larger of a / b and b / a."""
    return max(a / b, b / a) if a > 0 and b > 0 else math.inf


def quantile(values: list[float], q: float) -> str:
    return "-" if not values else f"{values[min(len(values) - 1, int(q * len(values)))]:.3g}"


def share(values: list) -> str:
    return "-" if not values else f"{100 * sum(values) / len(values):.0f} %"


def write_rows(rows: list[dict[str, Any]], path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    names = list(dict.fromkeys(name for row in rows for name in row))
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
