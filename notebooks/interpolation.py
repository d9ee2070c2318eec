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
# Is a point between two latents a material between theirs? The laws on the line from the softest to the stiffest elastic latent move
# a ball that falls onto a floor, all in one launch. The command `neuido latents` does it and writes tables; this notebook reads them.
#
# Open it with jupytext (`pip install 'neuido[notebook]' scikit-learn`), or run it: `python notebooks/interpolation.py`.
# `NEUIDO_NOTEBOOK_OUT` is the folder of the tables, made where they are missing; `NEUIDO_NOTEBOOK_SMALL=1` takes fewer laws.
# `NEUIDO_OPERATOR` names another operator.

# %%
import os
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from neuido.commands.latents import latents
from neuido.data.files.score_tables import read_rows

out = Path(os.environ.get("NEUIDO_NOTEBOOK_OUT", "runs/notebooks/interpolation"))
operator = os.environ.get("NEUIDO_OPERATOR", "pretrained-family")
small = os.environ.get("NEUIDO_NOTEBOOK_SMALL") == "1"
if not (out / "interpolation.csv").is_file():  # neuido latents --config configs/experiments/interpolation.yaml
    latents(operator=operator, out=str(out), parts=["interpolation"], count=5 if small else 9)

# %% [markdown]
# ## The motion
#
# Each column is one law, each row one time: the ball from the front.

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
figure.suptitle(f"share of {names[1]}, the rest {names[0]}", fontsize=9)
figure.savefig(out / "motion.png", dpi=120)

# %% [markdown]
# ## Apparent stiffness
#
# Three measures: the modulus of the law at small strain; the greatest compression; how long the floor carries the ball. The
# rank correlation with the share is one where a measure is monotone.

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
# The two ends above are the farthest apart. Between any two latents of a family the modulus is monotone in most cases, not in all.

# %%
for row in read_rows(out / "pairs.csv"):
    print(f"{row['family']:12s}{row['pairs']:5.0f} pairs: {100 * row['monotone']:.0f} % monotone, mean Spearman {row['spearman']:.2f}")
