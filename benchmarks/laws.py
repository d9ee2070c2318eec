"""Compare the motion of real bodies under learned laws with the motion under the classical law, also for the networks of NCLaw.

    python benchmarks/laws.py --data FOLDER [--weights pretrained] [--steps 400] [--device cuda] [--out laws.csv]

Each of the ten real bodies is simulated for 400 substeps with each of NCLaw's three materials: with the classical law, with the law of
the operator (the latent of the training trajectory of the material), and with the networks of NCLaw. The table shows the
matched-particle RMSE with respect to the classical motion over frames and particles, in 1e-3 of the unit cube. All three laws use the
same time step: that of the scene, halved until the classical law is well within the stability limit.
"""

import argparse
import csv
import dataclasses
import math
import os
from pathlib import Path

import torch

from neuido.data.bodies.families import PUBLISHED, laws
from neuido.data.bodies.scene_files import load_scene, scene_names
from neuido.errors import UserError
from neuido.models.baselines.nclaw import load_nclaw
from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
from neuido.physics.mpm.simulator import Simulator

COURANT = 0.6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=os.environ.get("NEUIDO_DATA"))
    parser.add_argument("--weights", default="pretrained")
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--bodies", nargs="+", default=[name for name in scene_names() if name != "nclaw-cube"])
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    if options.data is None:
        parser.error("give --data or set NEUIDO_DATA")
    operator = IntrinsicDynamicsOperator.load(options.weights).to(options.device)
    rows = []
    print("| body | material | dt [s] | ours | NCLaw | ours / NCLaw |\n| --- | --- | --- | --- | --- | --- |")
    # bodies with equal grids are simulated in one launch
    setups = [load_scene(name, options.data) for name in options.bodies]
    for cells in sorted({setup.scene.cells for setup in setups}):
        group = [(name, setup) for name, setup in zip(options.bodies, setups) if setup.scene.cells == cells]
        for family, (name, parameters) in PUBLISHED.items():
            classical = laws(family, [parameters])
            wave = math.sqrt(float(classical[0].modulus()) / 1000.0)
            scenes = []
            for _, setup in group:
                dt = setup.scene.dt
                while dt * wave / setup.scene.dx > COURANT:
                    dt /= 2
                scenes.append(dataclasses.replace(setup.scene, dt=dt))
            sim = Simulator(scenes, [setup.body for _, setup in group], device=options.device)
            with torch.no_grad():
                truth = sim.rollout(options.steps, *classical, every=5).x
                errors = {}
                for label, learned in (
                    ("ours", operator.laws(operator.latent(name))),
                    ("nclaw", load_nclaw(Path(options.data) / f"peers/nclaw-{name}.npz")),
                ):
                    try:
                        x = sim.rollout(options.steps, *learned, every=5).x
                        errors[label] = (x - truth).square().sum(-1)
                    except UserError as error:
                        print(f"| {label} {name} failed: {error} |")
                        errors[label] = torch.full(truth.shape[:2], math.nan, device=truth.device)
            for s, (body, _) in enumerate(group):
                own = slice(sim.particles.offsets[s], sim.particles.offsets[s + 1])
                ours, theirs = (1e3 * float(errors[label][:, own].mean().sqrt()) for label in ("ours", "nclaw"))
                rows.append({"body": body, "material": name, "dt": scenes[s].dt, "ours": ours, "nclaw": theirs, "ratio": ours / theirs})
                print(f"| {body} | {name} | {scenes[s].dt:g} | {ours:.3f} | {theirs:.3f} | {ours / theirs:.3f} |", flush=True)
    for name, _ in PUBLISHED.values():
        own = [row for row in rows if row["material"] == name]
        ours, theirs = (math.sqrt(sum(row[key] ** 2 for row in own) / len(own)) for key in ("ours", "nclaw"))
        print(f"| all | {name} | | {ours:.3f} | {theirs:.3f} | {ours / theirs:.3f} |")
    if options.out:
        with options.out.open("w", newline="") as file:
            writer = csv.DictWriter(file, rows[0])
            writer.writeheader()
            writer.writerows(rows)


if __name__ == "__main__":
    main()
