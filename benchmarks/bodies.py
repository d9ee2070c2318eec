"""Ten bodies under every learned law, 2,000 substeps: no NaN and no collapse.

    python benchmarks/bodies.py --operator pretrained-materials --out runs/bodies [--seconds 60] [--latents 480] [--steps 2000]

Each published body falls, as its scene has it, under the law of each latent of Stage I; the ten share a launch. Beside it stands the motion
with the classical law that the latent was trained on. A run goes on behind the rows that the file holds. A body collapsed if matter has a
det F below 0.001, or if its spread about its centre is less than half of that under the classical law. Writes OUT.csv and OUT.md.
"""

import argparse
import csv
import math
import time
from collections import defaultdict
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch

from neuido.data.bodies.families import effects, laws
from neuido.data.bodies.scene_files import load_scene
from neuido.data.files.writing import write_text
from neuido.models.inference.prepared_scene import as_device
from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
from neuido.models.operator.law_properties import p_wave_modulus
from neuido.models.stages.property_latents import materials_of
from neuido.models.video.clip_bodies import PUBLISHED
from neuido.physics.mpm.simulator import COURANT_LIMIT, Simulator
from neuido.physics.runtime.events import CRUSHED, INVERTED

BODIES = tuple(name for names in PUBLISHED.values() for name in names)
DENSITY = 1000.0
"""Density of the bodies [kg/m^3]."""
CELLS, FRAMES = 32, 20
STEP = 0.45
"""Share of the Courant limit: with 0.9 a nearly incompressible body (nu = 0.46) is torn apart by the classical law too."""
HALF = 0.5
"""Share of the spread under the classical law below which a body collapsed."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--operator", default="pretrained-materials")
    parser.add_argument("--bodies", default=",".join(BODIES))
    parser.add_argument("--latents", type=int, default=0, help="how many, spread over the families; 0: all")
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--thin", type=int, default=1, help="take every so many-th particle")
    parser.add_argument("--seconds", type=float, default=math.inf)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--out", default="runs/bodies", help="path of the tables without suffix")
    given = parser.parse_args()
    end, device = time.monotonic() + given.seconds, as_device(given.device)
    table, names = Path(f"{given.out}.csv"), given.bodies.split(",")
    operator = IntrinsicDynamicsOperator.load(given.operator).to(device).eval()
    rows = read_rows(table)
    done = {row["material"] for row in rows}
    chosen = spread([each for each in materials_of(operator) if each[0] in operator.latent_names], given.latents)
    for material, family, parameters in chosen:
        if material in done or time.monotonic() > end:
            continue
        rows += run(operator, names, material, family, parameters, given.steps, given.thin, device)
        write_rows(rows, table)
    text = summarise(rows, len(chosen), given)
    write_text(Path(f"{given.out}.md"), text)
    print(text)


def spread(found: list[tuple[str, str, dict[str, float]]], count: int) -> list[tuple[str, str, dict[str, float]]]:
    """Return materials of all families in turn."""
    families: dict[str, list] = defaultdict(list)
    for each in found:
        families[each[1]].append(each)
    turns = [own[k] for k in range(max(map(len, families.values()))) for own in families.values() if k < len(own)]
    return turns[: count or None]


@torch.no_grad()
def run(operator, names: list[str], material: str, family: str, parameters: dict[str, float], steps: int, thin: int, device) -> list[dict]:
    """Return a row for each body under the law of a latent and under the classical law."""
    z = operator.latent(material).to(device)
    elastic, plastic = laws(family, [parameters] * len(names))
    modulus = max(float(elastic.modulus().max()), float(p_wave_modulus(operator, z[None])[0]))
    setups = [load_scene(name) for name in names]
    dt = min(1e-3, STEP * COURANT_LIMIT / CELLS / math.sqrt(modulus / DENSITY))
    scenes = [replace(each.scene, cells=CELLS, dt=dt) for each in setups]
    bodies = [each.body._replace(**{name: t[::thin] for name, t in (("x", each.body.x), ("v", each.body.v))},
                                 volume=thin * each.body.volume[::thin], skin=None) for each in setups]  # fmt: skip
    rates = effects(family, [parameters] * len(names))
    learned = operator.laws(z.expand(len(names), -1))
    motions = {
        "classical": follow(scenes, bodies, (elastic, plastic), rates, steps, device),
        "learned": follow(scenes, bodies, learned, None, steps, device),
    }
    rows = []
    for k, name in enumerate(names):
        row: dict[str, Any] = {"material": material, "family": family, "body": name, "dt": scenes[k].dt}
        for law, found in motions.items():
            row |= {f"{key}_{law}": value for key, value in found[k].items()}
        row["verdict"] = verdict(row)
        rows.append(row)
    return rows


def follow(scenes, bodies, own_laws, rates, steps: int, device) -> list[dict[str, float]]:
    """Return of each body whether it stays finite, the least share of its first spread, and the particles that events concern."""
    simulator = Simulator(scenes, bodies, density=DENSITY, device=device, graphs=False)
    motion = simulator.rollout(steps, *own_laws, effects=rates, every=steps // FRAMES, nan_on_failure=True)
    found = []
    for scene, (a, b) in enumerate(pairwise(simulator.particles.offsets)):
        x = motion.x[:, a:b]
        size = (x - x.mean(1, keepdim=True)).square().sum(-1).mean(1).sqrt()
        own = [event for event in motion.events if event.scene == scene and event.kind in (CRUSHED, INVERTED)]
        finite = bool(torch.isfinite(x).all())
        found.append({"finite": int(finite), "spread": float((size / size[0]).min()) if finite else math.nan,
                      "crushed": sum(event.count for event in own) / (b - a)})  # fmt: skip
    return found


def verdict(row: dict[str, Any]) -> str:
    """Return `well`, `nan` or `collapsed`; what the classical law does too is said."""
    if not row["finite_learned"]:
        return "nan" if row["finite_classical"] else "nan, as the classical law"
    if row["crushed_learned"] > 0:
        return "collapsed" if row["crushed_classical"] == 0 else "collapsed, as the classical law"
    small = row["finite_classical"] and row["spread_learned"] < HALF * row["spread_classical"]
    return "collapsed" if small else "well"


def summarise(rows: list[dict[str, Any]], materials: int, given: argparse.Namespace) -> str:
    """Return the table by family as Markdown."""
    lines = [f"{given.operator}: {len({row['material'] for row in rows})} of {materials} materials, {given.steps} substeps", "",
             "| family | runs | well | NaN | collapsed | the classical law fails too | least spread, learned / classical |",
             "| --- | " + "---: | " * 6]  # fmt: skip
    for family in [*dict.fromkeys(row["family"] for row in rows), "all"]:
        own = [row for row in rows if family in ("all", row["family"])]
        count = [sum(row["verdict"] == word for row in own) for word in ("well", "nan", "collapsed")]
        shares = [float(r["spread_learned"]) / float(r["spread_classical"]) for r in own if r["finite_learned"] and r["finite_classical"]]
        cells = [len(own), *count, len(own) - sum(count), f"{min(shares, default=math.nan):.2f}"]
        lines.append(f"| {family} | " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines) + "\n"


def read_rows(path: Path) -> list[dict[str, Any]]:
    if not path.is_file():
        return []
    with path.open(newline="") as file:
        return [
            {key: value if key in ("material", "family", "body", "verdict") else float(value) for key, value in row.items()}
            for row in csv.DictReader(file)
        ]


def write_rows(rows: list[dict[str, Any]], path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
