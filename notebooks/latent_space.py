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
# # The space of the latents
#
# Stage I gives each of its 90 trajectories a latent z. Do latents of one family lie together? The command `neuido latents` measures
# it and writes tables; this notebook reads them.
#
# Open it with jupytext (`pip install 'neuido[notebook]' scikit-learn`), or run it: `python notebooks/latent_space.py`.
# `NEUIDO_NOTEBOOK_OUT` is the folder of the tables; they are made where they are missing. `NEUIDO_OPERATOR` names another operator.

# %%
import os
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from neuido.commands.latents import latents
from neuido.data.files.score_tables import read_rows

out = Path(os.environ.get("NEUIDO_NOTEBOOK_OUT", "runs/notebooks/latent_space"))
operator = os.environ.get("NEUIDO_OPERATOR", "pretrained-family")
if not (out / "silhouettes.csv").is_file():
    latents(operator=operator, out=str(out), parts=["space"])  # neuido latents --config configs/experiments/latent_space.yaml

# %% [markdown]
# ## t-SNE
#
# Families are apart in the plane of t-SNE, and within a family the latents are in the order of their stiffness, which no
# label told them.

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
# t-SNE draws clusters where distances are not clustered. The silhouette of a latent compares its mean distance to its own family with
# that to the nearest other one: one is apart, zero is mixed. The operator `pretrained-family` was fitted with a prior that draws each
# latent to the mean of its family, so that its latents as they are have a high one. What their laws answer to the same deformations has
# a high one with the prior and without it.

# %%
rows = {row["space"]: row for row in read_rows(out / "silhouettes.csv")}
print(f"{'space':24s}{'silhouette':>12s}{'neighbours':>12s}")
for name, row in rows.items():
    print(f"{name:24s}{row['silhouette']:12.3f}{row['neighbours']:12.2f}  {row['meaning']}")
assert rows["laws"]["silhouette"] > 0.3

# %% [markdown]
# ## What the laws feel of them
#
# A latent starts as noise in 128 dimensions, and the laws feel few of these. Along the other directions that noise would stay and widen
# every family, if the prior did not take it: without it (`NEUIDO_OPERATOR=pretrained`) the silhouette is 0.08. Below: how much a law
# changes when only its most felt directions are kept, and how much of the variance lies along them.

# %%
directions = read_rows(out / "directions.csv")
figure, axes = plt.subplots(figsize=(5, 3.2), layout="constrained")
count = [row["directions"] for row in directions]
axes.plot(count, [row["variance"] for row in directions], "o-", label="share of the latents' variance")
axes.plot(count, [row["law changes"] for row in directions], "s-", label="change of a law without the rest")
axes.plot(count, [row["silhouette"] for row in directions], "^-", label="silhouette")
axes.set(xlabel="directions that are kept", ylim=(0, 1))
axes.legend(frameon=False, fontsize=8)
figure.savefig(out / "directions.png", dpi=120)
