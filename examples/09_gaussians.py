"""
Gaussians that move with the body
=================================

Each particle carries a Gaussian. One call renders all frames and views; its gradients reach the motion.
Run it with ``python examples/09_gaussians.py``.
"""

import matplotlib.pyplot as plt

from neuido import Scene, Simulator, laws, render, shapes
from neuido.data import cameras
from neuido.models import attach_gaussians, deform

body = shapes.ball(centre=(0.5, 0.2, 0.5), radius=0.15, spacing=0.025, velocity=(0.0, -2.0, 0.0))
simulator = Simulator(Scene(cells=24, dt=1e-3), body, device="cpu")
velocity = simulator.state.v.clone().requires_grad_()
frames = simulator.rollout(100, laws.FixedCorotated(4e4, 0.3), every=20, state=simulator.state._replace(v=velocity))

# %%
# The colour of a Gaussian shows its place in the body at rest.
rest = body.x.float()
colours = (rest - rest.min(0).values) / (rest.max(0).values - rest.min(0).values)
gaussians = attach_gaussians(rest, body.volume.float(), colours)
images, alphas = render(deform(gaussians, frames.F, frames.x), cameras.orbit(2, width=160, height=160, target=(0.5, 0.15, 0.5), angle=18.0))
print(images.shape, "frames, views, height, width, RGB")

# %%
# The gradient of a loss on the images reaches the initial velocity.
images.mean().backward()
print(f"d brightness / d velocity: {velocity.grad.sum(0).tolist()}")
seen = images.detach() + 1 - alphas.detach()[..., None]
figure, panels = plt.subplots(2, 6, figsize=(9, 3.1))
for view in range(2):
    for k in range(6):
        panels[view, k].imshow(seen[k, view].clamp(0, 1))
        panels[view, k].axis("off")
for k in range(6):
    panels[0, k].set_title(f"{1e3 * float(frames.times[k]):.0f} ms", fontsize=9)
figure.tight_layout()
figure.savefig("gaussians.png", dpi=120)
