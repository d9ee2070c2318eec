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
# # The latent space
#
# Stage I learns a latent vector z for each of its 90 trajectories. Each trajectory belongs to a family of materials. Do the latents of a
# family form a cluster? The command `neuido latents` measures this and writes tables, which this notebook reads.
#
# Open this file with jupytext (`pip install 'neuido[notebook]' scikit-learn`), or run it: `python notebooks/latent_space.py`.
# `NEUIDO_NOTEBOOK_OUT` is the folder of the tables, which are computed if they are missing. `NEUIDO_OPERATOR` selects another operator.

# %%
import csv
import os
import subprocess
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

out = Path(os.environ.get("NEUIDO_NOTEBOOK_OUT", "runs/notebooks/latent_space"))
operator = os.environ.get("NEUIDO_OPERATOR", "pretrained-family")


def read_rows(path: Path) -> list[dict]:
    """Read a CSV file; cells that hold numbers become floats."""

    def number(cell: str) -> float | str:
        try:
            return float(cell)
        except ValueError:
            return cell

    with path.open(newline="") as file:
        return [{key: number(cell) for key, cell in row.items()} for row in csv.DictReader(file)]


if not (out / "silhouettes.csv").is_file():  # neuido latents --config configs/experiments/latent_space.yaml
    options = ["--operator", operator, "--out", str(out), "--parts", '["space"]', "--device", "cpu"]
    subprocess.run([sys.executable, "-m", "neuido", "latents", *options], check=True)

# %% [markdown]
# ## t-SNE
#
# t-SNE draws the latents in a plane. The families are separate there. Within a family the latents are ordered by stiffness, although the
# training was never told the stiffness.

# %%
points = read_rows(out / "embedding.csv")
families = list(dict.fromkeys(p["family"] for p in points))
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
for i, family in enumerate(families):
    own = [p for p in points if p["family"] == family]
    left.scatter([p["x"] for p in own], [p["y"] for p in own], s=20, color=f"C{i}", label=family)
left.set(xticks=[], yticks=[], title="by family")
left.legend(frameon=False)
shown = right.scatter([p["x"] for p in points], [p["y"] for p in points], s=20, c=np.log10([p["modulus"] for p in points]), cmap="viridis")
right.set(xticks=[], yticks=[], title="by small-strain modulus")
figure.colorbar(shown, label="log10 of the modulus [Pa]")
figure.savefig(out / "tsne.png", dpi=120)

# %% [markdown]
# ## Silhouettes
#
# t-SNE can show clusters that the distances do not have, so the clusters need a number. The silhouette of a latent compares its mean
# distance to its own family with that to the nearest other family: one means separate, zero means mixed. The operator `pretrained-family`
# was trained with a prior that pulls each latent towards the mean of its family, so its latents have a high silhouette. The stresses of
# the laws at the same deformations have a high silhouette with and without this prior.

# %%
rows = {row["space"]: row for row in read_rows(out / "silhouettes.csv")}
print(f"{'space':24s}{'silhouette':>12s}{'neighbours':>12s}")
for name, row in rows.items():
    print(f"{name:24s}{row['silhouette']:12.3f}{row['neighbours']:12.2f}  {row['meaning']}")
assert rows["laws"]["silhouette"] > 0.3

# %% [markdown]
# ## Directions that the laws depend on
#
# A latent starts as noise in 128 dimensions, and the laws depend on few of them. Without the prior the noise in the other dimensions stays
# and mixes the families: the silhouette is then 0.08 (`NEUIDO_OPERATOR=pretrained`). The figure keeps only the directions with the largest
# influence. It shows how much a law changes without the others, and how much of the variance lies along those kept.

# %%
directions = read_rows(out / "directions.csv")
figure, axes = plt.subplots(figsize=(5, 3.2), layout="constrained")
count = [row["directions"] for row in directions]
axes.plot(count, [row["variance"] for row in directions], "o-", label="share of the latents' variance")
axes.plot(count, [row["law changes"] for row in directions], "s-", label="change of a law without the other directions")
axes.plot(count, [row["silhouette"] for row in directions], "^-", label="silhouette")
axes.set(xlabel="directions kept", ylim=(0, 1))
axes.legend(frameon=False, fontsize=8)
figure.savefig(out / "directions.png", dpi=120)
