"""
A learned law in a new scene
============================

The operator that comes with neuido turns a latent vector into a law. Here a jelly and a plasticine that it learned fall on a slope,
which was in no training scene.
Run it with ``python examples/12_learned_law.py``.
"""

import matplotlib.pyplot as plt
import torch

from neuido import Operator, Plane, Scene, Simulator, shapes

operator = Operator.from_pretrained()
slope = Plane(point=(0.5, 0.2, 0.5), normal=(0.5, 1.0, 0.0), contact="separate", friction=0.3)
body = shapes.ball(centre=(0.45, 0.42, 0.5), radius=0.13, spacing=0.035, velocity=(0.0, -2.0, 0.0))
simulator = Simulator(Scene(cells=24, dt=5e-4, colliders=(slope,)), body, device="cpu")
figure, panels = plt.subplots(2, 4, figsize=(9, 4.6), sharex=True, sharey=True)
for row, name in zip(panels, ("jelly", "plasticine"), strict=True):
    with torch.no_grad():
        frames = simulator.rollout(240, *operator.laws(operator.latent(name)), every=80)
    for panel, x, k in zip(row, frames.x, range(4), strict=True):
        panel.scatter(x[:, 0], x[:, 1], s=3, c=body.x[:, 1], cmap="plasma")
        panel.axline((0.5, 0.2), slope=-0.5, color="0.5", linewidth=1)
        panel.set(xlim=(0.2, 0.9), ylim=(0.0, 0.65), aspect="equal", title=f"{name}, {40 * k} ms")
figure.supxlabel("x [m]")
figure.supylabel("height [m]")
figure.tight_layout()
figure.savefig("learned_law.png")
