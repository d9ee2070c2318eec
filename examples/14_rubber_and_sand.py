"""
Rubber and sand
===============

A rubber ball falls on a heap of sand and bounces off a block of wood: three bodies with three laws in one scene.
Run it with ``python examples/14_rubber_and_sand.py``.
"""

import matplotlib.pyplot as plt
import torch

from neuido import Body, Scene, Simulator, laws, shapes

sand = Body(
    shape=shapes.box(lower=(0.1, 0.0, 0.15), upper=(0.55, 0.15, 0.45), spacing=0.025),
    name="sand",
    law=laws.Sigma(2e5, 0.3),
    plasticity=laws.DruckerPrager(30.0, 2e5, 0.3),
    density=1600.0,
)
wood = Body(
    shape=shapes.box(lower=(0.65, 0.0, 0.2), upper=(0.85, 0.2, 0.4), spacing=0.025),
    name="wood",
    law=laws.FixedCorotated(4e5, 0.2),
    density=600.0,
)
rubber = Body(
    shape=shapes.ball(centre=(0.5, 0.36, 0.3), radius=0.09, spacing=0.025),
    name="rubber",
    law=laws.NeoHookean(1e5, 0.4),
    density=1100.0,
    velocity=(0.8, -1.5, 0.0),
)
friction = [("rubber", "sand", 0.5), ("rubber", "wood", 0.3), ("sand", "wood", 0.4)]
scene = Scene(cells=20, dt=6e-4, upper=(1.0, 0.6, 0.6), bodies=[sand, wood, rubber], body_friction=friction)
with torch.no_grad():
    frames = Simulator(scene, device="cpu").rollout(600, every=50)
ball = frames.x[:, frames.body == 2].mean(1)
print(f"the ball sinks to {float(ball[:, 1].min()):.2f} m and ends at x = {float(ball[-1, 0]):.2f} m")

# %%
figure, axes = plt.subplots(2, 2, figsize=(7, 4.4), sharex=True, sharey=True)
for axis, k in zip(axes.flat, (0, 2, 5, 12), strict=True):
    for body, colour in enumerate(("#c9a35b", "#8a5a33", "#303a52")):
        x = frames.x[k, frames.body == body]
        axis.scatter(x[:, 0], x[:, 1], s=2, color=colour)
    axis.set_title(f"{1e3 * float(frames.times[k]):.0f} ms", fontsize=9)
    axis.set_aspect("equal")
figure.supxlabel("x [m]")
figure.supylabel("height [m]")
plt.tight_layout()
plt.savefig("rubber_and_sand.png", dpi=120)
