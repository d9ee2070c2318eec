# ---
# jupyter:
#   jupytext:
#     formats: py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Between two latents
#
# Is a law halfway between two latents also halfway in stiffness? The test: a ball falls onto a floor under each law on the line from the
# softest to the stiffest elastic latent. The command `neuido latents` simulates these drops in one launch and writes tables, which this
# notebook reads.
#
# Open this file with jupytext (`pip install 'neuido[notebook]' scikit-learn`), or run it: `python notebooks/interpolation.py`.
# `NEUIDO_NOTEBOOK_OUT` is the folder of the tables, which are computed if they are missing. `NEUIDO_NOTEBOOK_SMALL=1` uses fewer laws,
# and `NEUIDO_OPERATOR` selects another operator.

# %%
import csv
import os
import subprocess
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

out = Path(os.environ.get("NEUIDO_NOTEBOOK_OUT", "runs/notebooks/interpolation"))
operator = os.environ.get("NEUIDO_OPERATOR", "pretrained-family")
small = os.environ.get("NEUIDO_NOTEBOOK_SMALL") == "1"


def read_rows(path: Path) -> list[dict]:
    """Read a CSV file; cells that hold numbers become floats."""

    def number(cell: str) -> float | str:
        try:
            return float(cell)
        except ValueError:
            return cell

    with path.open(newline="") as file:
        return [{key: number(cell) for key, cell in row.items()} for row in csv.DictReader(file)]


if not (out / "interpolation.csv").is_file():  # neuido latents --config configs/experiments/interpolation.yaml
    options = ["--operator", operator, "--out", out, "--parts", '["interpolation"]', "--count", 5 if small else 9, "--device", "cpu"]
    subprocess.run([sys.executable, "-m", "neuido", "latents", *map(str, options)], check=True)

# %% [markdown]
# ## The motion
#
# Each column is a law, each row a time. The ball is seen from the front.

# %%
with np.load(out / "interpolation.npz") as archive:
    x, shares, names = archive["x"], archive["shares"], archive["names"]
frames = np.linspace(0, len(x) - 1, 5).round().astype(int)
figure, panels = plt.subplots(len(frames), len(shares), figsize=(1.4 * len(shares), 1.3 * len(frames)), layout="constrained")
for row, frame in zip(panels, frames):
    for axes, body in zip(row, x[frame]):
        axes.scatter(body[:, 0], body[:, 1], s=1, linewidths=0)
        axes.set(xlim=(0.3, 0.7), ylim=(0.1, 0.5), aspect="equal", xticks=[], yticks=[])
for axes, share in zip(panels[0], shares):
    axes.set_title(f"{share:.2f}", fontsize=8)
figure.suptitle(f"share of {names[1]}; the rest is {names[0]}", fontsize=9)
figure.savefig(out / "motion.png", dpi=120)

# %% [markdown]
# ## Apparent stiffness
#
# Three numbers measure the stiffness: the modulus of the law at small strain, the greatest compression of the ball, and how long it touches
# the floor. If a number only rises along the line, or only falls, its rank correlation with the share is 1 or -1.

# %%
rows = read_rows(out / "interpolation.csv")
steady = {row["measure"]: row for row in read_rows(out / "monotonicity.csv")}
figure, panels = plt.subplots(1, 3, figsize=(10, 2.8), layout="constrained")
for axes, (name, label) in zip(
    panels, {"modulus": "small-strain modulus [Pa]", "compression": "greatest compression", "contact": "contact time [s]"}.items()
):
    axes.plot([row["share"] for row in rows], [row[name] for row in rows], "o-")
    axes.set(xlabel=f"share of {names[1]}", title=f"{label}; Spearman {steady[name]['spearman']:.2f}")
    print(f"{label}: Spearman {steady[name]['spearman']:.3f}, {100 * steady[name]['steps']:.0f} % of the steps")
figure.savefig(out / "stiffness.png", dpi=120)
assert steady["modulus"]["spearman"] > 0.9

# %% [markdown]
# ## All pairs
#
# The two laws above are the farthest apart. Between two arbitrary latents of a family the modulus rises steadily in most cases, not in all.

# %%
for row in read_rows(out / "pairs.csv"):
    print(f"{row['family']:12s}{row['pairs']:5.0f} pairs: {100 * row['monotone']:.0f} % monotone, mean Spearman {row['spearman']:.2f}")
