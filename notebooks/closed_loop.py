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
# # The closed loop
#
# Measured motion goes in. The declared model is fitted; what it leaves is traced to an effect that it lacks; that effect is added;
# the error on recordings that no fit has seen is compared before and after. First on a simulated body whose truth is known, then on
# rubber that Treloar stretched in 1944.
#
# Open it with jupytext (`pip install 'neuido[notebook]'`), or run it: `python notebooks/closed_loop.py`. `NEUIDO_NOTEBOOK_OUT` is the
# folder for what it writes, `NEUIDO_NOTEBOOK_SMALL=1` makes it short, `NEUIDO_DATA` is the folder of the measured data.

# %%
import json
import os
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from neuido.commands.demo.closed_loop import record
from neuido.commands.diagnose import diagnose

out = Path(os.environ.get("NEUIDO_NOTEBOOK_OUT", "runs/notebooks/closed_loop"))
small = os.environ.get("NEUIDO_NOTEBOOK_SMALL") == "1"
out.mkdir(parents=True, exist_ok=True)


def read(folder: Path) -> dict:
    """What a diagnosis says."""
    return json.loads((folder / "diagnosis.json").read_text())


def ranking(folder: Path, axes) -> None:
    """What each effect that was fitted would bring, in the first step."""
    (first, *_), found = json.loads((folder / "trace.json").read_text())["rounds"], read(folder)["effects"]
    trials = sorted(first["trials"], key=lambda t: t["gain"])[-10:]
    named = {name for effect in found for name in effect["class"]}
    axes.barh(
        [t["key"] for t in trials], [np.exp(t["gain"]) for t in trials], color=["C0" if t["name"] in named else "0.8" for t in trials]
    )
    axes.set(xscale="log", xlabel="error before over error after")


# %% [markdown]
# ## A simulated block
#
# A block of jelly is thrown twice. It feels a drag that its model does not mention, and its modulus is declared a third too high. One
# throw is fitted, the other is held out. A folder like this is what a motion-capture experiment gives: tracked points, the declared
# scene, the declared law.

# %%
measured = out / "block"
experiment = record(measured, {"drag_linear.k": 3.0})
for r in experiment.recordings:
    print(f"{r.name} ({r.role}): {r.x.shape[1]} points, {len(r.t)} frames, noise {1e3 * r.noise:.1f} mm")

# %% [markdown]
# The command line says `neuido diagnose runs/.../block --out DIR`; this is the same function. Without `effects` every effect that could
# act on such a body is tried, more than twenty.

# %%
diagnose(
    str(measured),
    out=str(out / "block-diagnosis"),
    effects="drag_linear,drag_quadratic,viscosity_shear" if small else None,
    draws=39 if small else 199,
    device="cpu",
    progress=False,
)
block = read(out / "block-diagnosis")
for effect in block["effects"]:
    for name, figure in effect["parameters"].items():
        low, high = figure["interval90"]
        print(f"{effect['name']}.{name} = {figure['value']:.3g} {figure['unit']} (90 %: {low:.3g} to {high:.3g}; truth: 3)")

# %% [markdown]
# The held-out error falls to the noise. What was left before has a pattern in time that no clock, ruler or launch that is slightly off
# explains.

# %%
with np.load(out / "block-diagnosis" / "predicted" / "toss.npz") as archive:
    m = {name: archive[name] for name in ("t", "measured", "before", "after")}
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.2), layout="constrained")
for when, colour in (("before", "C3"), ("after", "C0")):
    distance = 1e3 * np.sqrt(np.nanmean(((m["measured"] - m[when]) ** 2).sum(-1), axis=1))
    left.plot(m["t"], distance, color=colour, label=f"{when}: {1e3 * block['error'][when]['held_out']:.2f} mm")
left.axhline(1e3 * block["error"]["noise_floor"], color="0.3", ls=":", label="noise")
left.set(xlabel="t [s]", ylabel="RMS distance [mm]", title="the throw that was held out", ylim=(0, None))
left.legend(frameon=False)
ranking(out / "block-diagnosis", right)
figure.savefig(out / "block.png", dpi=120)

# %% [markdown]
# The loop closes: with the model that came out, a second pass finds nothing more.

# %%
diagnose(
    str(measured),
    out=str(out / "block-again"),
    model=str(out / "block-diagnosis" / "model_after.yaml"),
    effects="drag_linear,drag_quadratic,viscosity_shear" if small else None,
    draws=39,
    device="cpu",
    progress=False,
)
assert read(out / "block-again")["answer"] == "none"

# %% [markdown]
# ## Vulcanised rubber
#
# Treloar's uniaxial tension of 1944, as digitised. The declared law is neo-Hookean; it is fitted to stretches up to 6.7, and has
# to foretell the stress up to 7.5.

# %%
root = os.environ.get("NEUIDO_DATA")
rubber = Path(root) / "measured" / "treloar-rubber" if root else None
if rubber is None or not (rubber / "test.yaml").is_file():
    print("The measured data are not here: set NEUIDO_DATA to their folder to see this part.")
else:
    diagnose(str(rubber), out=str(out / "rubber"), draws=39 if small else 199, device="cpu", progress=False)
    content = read(out / "rubber")
    for effect in content["effects"]:
        print(" or ".join(effect["class"]), {name: float(f"{p['value']:.3g}") for name, p in effect["parameters"].items()})
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.2), layout="constrained")
    from neuido.data.measured.material_test import read_material_tests

    for test in read_material_tests(rubber).tests:
        with np.load(out / "rubber" / "predicted" / f"{test.name}.npz") as archive:
            stretch = np.asarray(test.path).reshape(len(archive["measured"]), -1)[:, 0]
            left.plot(
                stretch,
                1e-6 * archive["measured"],
                "o" if test.role == "fit" else "s",
                color="0.2",
                ms=4,
                label=f"{test.name} ({test.role})",
            )
            for when, colour in (("before", "C3"), ("after", "C0")):
                left.plot(stretch, 1e-6 * archive[when], color=colour)
    error = {when: 1e-6 * content["error"][when]["held_out"] for when in ("before", "after")}
    left.set(
        xlabel="stretch", ylabel="nominal stress [MPa]", title=f"held out: {error['before']:.2f} before, {error['after']:.2f} MPa after"
    )
    left.legend(frameon=False, fontsize=8)
    ranking(out / "rubber", right)
    figure.savefig(out / "rubber.png", dpi=120)

# %% [markdown]
# Each diagnosis has a page of its own, `report.html`, with the motion to play, the map of the residual over the body, the reasons for
# which the other effects were rejected, and the next experiment that would tell the most.
