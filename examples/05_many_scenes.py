"""
Several scenes in one launch
============================

A sweep over a parameter is one rollout: all scenes run in the same kernel launches.
Run it with ``python examples/05_many_scenes.py``.
"""

import matplotlib.pyplot as plt
import torch

from neuido import Scene, Simulator, laws, shapes

body = shapes.ball(centre=(0.5, 0.3, 0.5), radius=0.14, spacing=0.05, velocity=(0.0, -1.5, 0.0))
moduli = torch.tensor([2e4, 5e4, 1e5, 2e5], requires_grad=True)  # one for each scene
scenes = [Scene(cells=20, dt=1e-3)] * len(moduli)
simulator = Simulator(scenes, [body] * len(moduli), device="cpu")
frames = simulator.rollout(400, laws.FixedCorotated(moduli, 0.3), every=10)

# %%
# One array holds the particles of all scenes, scene after scene.
heights = frames.x[..., 1].unflatten(1, (len(moduli), -1)).mean(2)  # frames, scenes
heights[-1].sum().backward()
print("d height / d modulus [m/Pa]:", moduli.grad.tolist())

# %%
plt.figure(figsize=(5, 3))
for young, height in zip(moduli.tolist(), heights.detach().T, strict=True):
    plt.plot(0.01 * torch.arange(len(height)), height, label=f"{young / 1e3:.0f} kPa")
plt.xlabel("time [s]")
plt.ylabel("mean height [m]")
plt.legend(frameon=False, title="Young's modulus")
plt.tight_layout()
plt.savefig("scenes.png")
