"""
Two bodies in contact
=====================

A scene brings its bodies, each with a material of its own. They push each other, slide with friction and part again.
Run it with ``python examples/13_two_materials.py``.
"""

import matplotlib.pyplot as plt
import torch

from neuido import Body, Scene, Simulator, laws, shapes

soft, hard = laws.NeoHookean(2e4, 0.3), laws.FixedCorotated(8e4, 0.3)
table = shapes.box(lower=(0.1, 0.0, 0.2), upper=(0.9, 0.2, 0.6), spacing=0.04)
block = shapes.box(lower=(0.15, 0.2, 0.3), upper=(0.3, 0.35, 0.5), spacing=0.04)
bodies = [Body(shape=table, name="table", law=hard, density=2000.0), Body(shape=block, name="block", law=soft, velocity=(1.5, 0.0, 0.0))]
scene = Scene(cells=20, dt=1e-3, upper=(1.0, 0.6, 0.8), bodies=bodies)
simulator = Simulator(scene, device="cpu")

# %%
# The friction between the bodies is a differentiable input of the rollout.
friction = torch.tensor(0.3, requires_grad=True)
frames = simulator.rollout(200, body_friction=friction, every=10)
path = frames.x[:, frames.body == frames.body_names.index("block"), 0].mean(1)
path[-1].backward()
print(f"d path / d friction {friction.grad.item():.3f} m; of rigid bodies, -g t^2 / 2 is {-9.8 * 0.2**2 / 2:.3f} m")

# %%
plt.figure(figsize=(5, 3))
for value in (0.0, 0.15, 0.3, 0.6):
    with torch.no_grad():
        moved = simulator.rollout(200, body_friction=value, every=10)
    plt.plot(moved.times, moved.x[:, moved.body == 1, 0].mean(1), label=f"{value:g}")
plt.xlabel("time [s]")
plt.ylabel("place of the block [m]")
plt.legend(frameon=False, title="friction")
plt.tight_layout()
plt.savefig("two_materials.png")
