"""
Between two learned laws
========================

The operator turns a latent vector into a law, so a mixture of two latents is a law too. Here one body falls with five mixtures of a
jelly and a plasticine. Run it with ``python examples/21_between_two_laws.py``; then see it live, with a slider for the mixture (needs
``pip install 'neuido[viewer]'``): ``neuido view mixtures.yaml --latents "[jelly, plasticine]"``.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import torch

from neuido import Operator, Simulator, load_scene

Path("mixtures.yaml").write_text("""\
format: neuido-scene/1
name: mixtures
scene:
  domain: [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]
  gravity: [0.0, -9.8, 0.0]
  walls: {contact: separate, friction: 0.3, inset: 2.0}
model:
  density: 1000.0
  elasticity: {law: fixed_corotated, young: 1.0e+5, poisson: 0.3}
  plasticity: {law: identity}
body: {shape: ball, centre: [0.5, 0.26, 0.5], radius: 0.13, spacing: 0.032, velocity: [0.0, -3.0, 0.0]}
discretisation: {grid: 24, dt: 5.0e-4}
steps: 300
""")

# %%
# The laws of several latents run at once, each in a scene of its own.
operator, setup = Operator.from_pretrained(), load_scene("mixtures.yaml")
shares = torch.linspace(0, 1, 5)
jelly, plasticine = operator.latent("jelly"), operator.latent("plasticine")
mixtures = torch.lerp(jelly, plasticine, shares[:, None])
simulator = Simulator([setup.scene] * 5, [setup.body] * 5, density=setup.info["density"], device="cpu")
with torch.no_grad():
    frames = simulator.rollout(setup.info["steps"], *operator.laws(mixtures), every=50)
x = frames.x.unflatten(1, (5, -1))  # frames, mixtures, particles, 3
for share, height in zip(shares, x[-1, :, :, 1].mean(1), strict=True):
    print(f"{100 * share:.0f} % plasticine: mean height {100 * height:.1f} cm after 0.15 s")

# %%
figure, panels = plt.subplots(3, 5, figsize=(9, 5), sharex=True, sharey=True)
for row, k in zip(panels, (0, 3, 6), strict=True):
    for panel, own, share in zip(row, x[k].unbind(), shares, strict=True):
        panel.scatter(own[:, 0], own[:, 1], s=4, c=setup.body.x[:, 1], cmap="plasma")
        panel.axhline(2 / 24, color="0.5", linewidth=1)
        panel.set(xlim=(0.2, 0.8), ylim=(0.05, 0.55), aspect="equal", xticks=(), yticks=())
        if k == 0:
            panel.set_title(f"{100 * share:.0f} % plasticine", fontsize=9)
    row[0].set_ylabel(f"{25 * k} ms")
figure.tight_layout()
figure.savefig("between_two_laws.png", dpi=110)
