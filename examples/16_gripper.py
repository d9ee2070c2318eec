"""
A gripper that measures
=======================

Two plates close on a jelly and lift it. The force on each plate is read out, with its gradient with respect to the stiffness of the jelly.
Run it with ``python examples/16_gripper.py``.
"""

import matplotlib.pyplot as plt
import torch

from neuido import Keyframes, Scene, Simulator, colliders, laws, shapes

jelly = shapes.box(lower=(0.4, 0.12, 0.42), upper=(0.6, 0.3, 0.58), spacing=0.025)

# %%
# The plates follow a path: they close in 0.08 s, then rise. The table below them is a collider too.
times = (0.0, 0.08, 0.1, 0.2)


def plate(name, side):
    near, far = 0.5 + side * 0.125, 0.5 + side * 0.17
    places = ((far, 0.25, 0.5), (near, 0.25, 0.5), (near, 0.25, 0.5), (near, 0.33, 0.5))
    return colliders.Cuboid((0.1, 0.24, 0.2), name=name, friction=1.0, path=Keyframes(times, places))


table = colliders.HalfSpace(position=(0.0, 0.1, 0.0), friction=0.5, name="table")
scene = Scene(cells=24, dt=1e-3, walls=None, colliders=(plate("left", -1), plate("right", 1), table))
simulator = Simulator(scene, jelly, device="cpu", dtype=torch.float64)

# %%
# ``frames.forces`` has the force on every solid collider, (frames, colliders, 3), the mean since the frame before.
stiffness = torch.tensor(2e4, dtype=torch.float64, requires_grad=True)
frames = simulator.rollout(200, laws.FixedCorotated(stiffness, 0.3), every=5)
squeeze = frames.forces[-21, 1, 0]  # when the plates stop closing
(slope,) = torch.autograd.grad(squeeze, stiffness)
print(f"the right plate feels {squeeze.item():.2f} N; d force / d modulus {slope.item():.2e} N/Pa")
height = frames.x.detach()[..., 1].mean(1)
print(f"the plates rise by 8 cm, and the jelly with them by {100 * float(height[-1] - height[20]):.1f} cm")

# %%
plt.figure(figsize=(7.6, 3))
for c, name in enumerate(("left", "right")):
    plt.plot(frames.times, frames.forces[:, c, 0].detach(), label=f"{name} plate, sideways")
plt.plot(frames.times, -frames.forces[:, 2, 1].detach(), label="table, downwards")
plt.xlabel("time [s]")
plt.ylabel("force [N]")
plt.legend(frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
plt.tight_layout()
plt.savefig("gripper.png")
