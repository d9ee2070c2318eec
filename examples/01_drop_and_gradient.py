"""
A drop, and its gradient
========================

A soft cube falls on a floor. One backward pass gives the derivative of its mean height with respect to Young's modulus.
Run it with ``python examples/01_drop_and_gradient.py``.
"""

import matplotlib.pyplot as plt
import torch

from neuido import Scene, Simulator, laws, shapes

body = shapes.cube(length=0.2, centre=(0.5, 0.13, 0.5), particles_per_side=8, velocity=(0.0, -1.0, 0.0))
simulator = Simulator(Scene(cells=32, dt=5e-4), body, device="cpu")
young = torch.tensor([1e5], requires_grad=True)  # Pa
frames = simulator.rollout(200, laws.FixedCorotated(young, 0.3), every=10)

# %%
# ``frames.x`` has the positions of 512 particles in 21 frames. Their mean height after 0.1 s is a number that torch differentiates.
height = frames.x[-1, :, 1].mean()
height.backward()
print(f"mean height {height.item():.4f} m, d height / d modulus {young.grad.item():.3g} m/Pa")

# %%
x = frames.x.detach()
figure, panels = plt.subplots(1, 4, figsize=(9, 2.6), sharey=True)
for panel, k in zip(panels, (0, 5, 10, 20), strict=True):
    panel.scatter(x[k, :, 0], x[k, :, 1], s=4, c=x[0, :, 1], cmap="viridis")
    panel.set(title=f"{5 * k} ms", aspect="equal", xlim=(0.3, 0.7), ylim=(0.0, 0.35), xlabel="x [m]", xticks=(0.4, 0.5, 0.6))
panels[0].set_ylabel("height [m]")
figure.tight_layout()
figure.savefig("drop.png")
