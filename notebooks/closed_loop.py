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
# A diagnosis starts from measured motion and a declared model. It fits the model, finds the effect that explains what is left, and adds
# this effect. It then compares the error on held-out recordings before and after. The first example is a simulated block, whose truth is
# known. The second is the rubber that Treloar stretched in 1944.
#
# Open this file with jupytext (`pip install 'neuido[notebook]'`), or run it: `python notebooks/closed_loop.py`. `NEUIDO_NOTEBOOK_OUT` is
# the output folder, `NEUIDO_NOTEBOOK_SMALL=1` shortens the run, and `NEUIDO_DATA` is the folder of the measured data.

# %%
import json
import os
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch

from neuido import Scene, Simulator, diagnose, effects, laws, shapes
from neuido.data import Experiment, Recording, read_experiment, read_material_tests, write_experiment

out = Path(os.environ.get("NEUIDO_NOTEBOOK_OUT", "runs/notebooks/closed_loop"))
small = os.environ.get("NEUIDO_NOTEBOOK_SMALL") == "1"
out.mkdir(parents=True, exist_ok=True)


def plot_ranking(diagnosis, axes) -> None:
    """Plot how much each effect reduces the error when it alone is added; the effects of the answer are in blue."""
    words = {entry.name: entry.title for entry in effects.LIBRARY}
    first, *_ = json.loads((diagnosis.folder / "trace.json").read_text())["rounds"]
    trials = sorted(first["trials"], key=lambda t: t["gain"])[-10:]
    answer = {name for effect in diagnosis.effects for name in (effect.name, *effect.alternatives)}
    labels = [f"{words[t['name']]}\n({t['key']})" for t in trials]
    axes.barh(labels, [np.exp(t["gain"]) for t in trials], color=["C0" if t["name"] in answer else "0.8" for t in trials])
    axes.tick_params(axis="y", labelsize=6)
    axes.set(xscale="log", xlabel="error before over error after")


# %% [markdown]
# ## A simulated block
#
# A block of jelly is thrown twice. Its model lacks the air drag, and the declared modulus is a third too high. One throw is fitted, the
# other is held out. The folder holds what a motion-capture experiment provides: tracked points, the declared scene and the declared law.

# %%
measured = out / "block"
scene, every, frames, noise = Scene(cells=14, dt=1e-3), 10, 16, 4e-4
random = np.random.default_rng(1)
launches = {  # role, centre [m], velocity [m/s], spin about z [rad/s], stretch rate along x [1/s]
    "throw": ("fit", (0.35, 0.5, 0.5), (1.2, 1.0, 0.3), 5.0, 3.0),
    "toss": ("held_out", (0.68, 0.42, 0.5), (-2.4, 2.0, -0.8), -4.0, -3.0),
}


def simulate(name: str) -> Recording:
    """Throw the block with the true law and drag, and track 60 of its particles with noise."""
    role, centre, velocity, spin, stretch = launches[name]
    body = shapes.cube(length=0.3, centre=centre, particles_per_side=5, velocity=velocity, angular_velocity=(0.0, 0.0, spin))
    body.v.add_((body.x - torch.tensor(centre)) * torch.tensor([stretch, -stretch, 0.0]))  # makes the block vibrate
    with torch.no_grad():
        motion = Simulator(scene, body, device="cpu").rollout(
            every * (frames - 1), laws.FixedCorotated(6e4, 0.3), every=every, effects=effects.Effects(drag_linear=3.0)
        )
    track = torch.from_numpy(random.permutation(len(body.x))[:60])
    x = motion.x[:, track] + noise * torch.from_numpy(random.standard_normal((frames, 60, 3))).float()
    return Recording(name, role, scene, every * scene.dt, noise, x=x, t=motion.times, body=body, track=track)


if not (measured / "experiment.yaml").is_file():
    declared = {"density": 1000.0, "elasticity": {"law": "fixed_corotated", "young": 8e4, "poisson": 0.3}}
    declared["plasticity"] = {"law": "identity"}
    write_experiment(Experiment("block", measured, scene, declared, ("young",), tuple(map(simulate, launches))), measured)
for r in read_experiment(measured).recordings:
    print(f"{r.name} ({r.role}): {r.x.shape[1]} points, {len(r.t)} frames, noise {1e3 * r.noise:.1f} mm")

# %% [markdown]
# On the command line this is `neuido diagnose runs/.../block --out DIR`. Without `effects`, it tries every effect that could act on such a
# body: more than twenty.

# %%
suspects = ["drag_linear", "drag_quadratic", "viscosity_shear"] if small else None
block = diagnose(measured, out=out / "block-diagnosis", effects=suspects, draws=39 if small else 199, device="cpu")
print(block.line)
for effect in block.effects:
    for name, quantity in effect.parameters.items():
        low, high = quantity.interval
        print(f"{effect.name}.{name} = {quantity.value:.3g} {quantity.unit} (90 %: {low:.3g} to {high:.3g}; truth: 3)")

# %% [markdown]
# The held-out error falls to the noise. Before, the residual grows in a way that no error of the clock, the scale or the launch explains.

# %%
with np.load(out / "block-diagnosis" / "predicted" / "toss.npz") as archive:
    m = {name: archive[name] for name in ("t", "measured", "before", "after")}
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.2), layout="constrained")
for when, colour in (("before", "C3"), ("after", "C0")):
    distance = 1e3 * np.sqrt(np.nanmean(((m["measured"] - m[when]) ** 2).sum(-1), axis=1))
    left.plot(m["t"], distance, color=colour, label=f"{when}: {1e3 * getattr(block.error, when):.2f} mm")
left.axhline(1e3 * block.error.floor, color="0.3", ls=":", label="noise and discretisation")
left.set(xlabel="t [s]", ylabel="RMS distance [mm]", title="the held-out throw", ylim=(0, None))
left.legend(frameon=False)
plot_ranking(block, right)
figure.savefig(out / "block.png", dpi=120)

# %% [markdown]
# The loop closes: a second diagnosis, of the model with the drag added, finds nothing more.

# %%
again = diagnose(measured, out=out / "block-again", model=block.model_after, effects=suspects, draws=39, device="cpu")
print(again.line)
assert again.answer == "none"

# %% [markdown]
# ## Vulcanised rubber
#
# The data are Treloar's tensile test of 1944, digitised. The declared law is neo-Hookean. It is fitted at stretches up to 6.7 and must
# predict the stress up to 7.5.

# %%
root = os.environ.get("NEUIDO_DATA")
rubber = Path(root) / "measured" / "treloar-rubber" if root else None
if rubber is None or not (rubber / "test.yaml").is_file():
    print("The measured data were not found: set NEUIDO_DATA to their folder to run this part.")
else:
    diagnosis = diagnose(rubber, out=out / "rubber", draws=39 if small else 199, device="cpu")
    print(diagnosis.summary())
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.2), layout="constrained")
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
    before, after = 1e-6 * diagnosis.error.before, 1e-6 * diagnosis.error.after
    left.set(xlabel="stretch", ylabel="nominal stress [MPa]", title=f"held out: {before:.2f} MPa before, {after:.2f} MPa after")
    left.legend(frameon=False, fontsize=8)
    plot_ranking(diagnosis, right)
    figure.savefig(out / "rubber.png", dpi=120)

# %% [markdown]
# Each diagnosis writes `report.html`. It shows the motion, where on the body the model is wrong, why the other effects were rejected, and
# which experiment would tell most next.
