"""
A law of your own
=================

A law of your own is a torch function of the deformation gradient. It runs in the same rollout as the others and has gradients.
Run it with ``python examples/03_own_law.py``.
"""

import matplotlib.pyplot as plt
import torch

from neuido import Scene, Simulator, laws, shapes


def stress(F, stiffness):
    """Return the Kirchhoff stress [Pa] of a Saint Venant-Kirchhoff solid without volumetric term, F (n, 3, 3)."""
    strain = 0.5 * (F.mT @ F - torch.eye(3, dtype=F.dtype, device=F.device))
    return F @ (2 * stiffness * strain) @ F.mT


body = shapes.box(lower=(0.35, 0.02, 0.4), upper=(0.65, 0.3, 0.6), spacing=0.05, velocity=(0.0, -1.0, 0.0))
simulator = Simulator(Scene(cells=20, dt=1e-3), body, device="cpu")

# %%
# ``modulus`` is the P-wave modulus of the undeformed body. It sets the longest stable time step.
stiffness = torch.tensor([4e4], requires_grad=True)
own = laws.AutogradElastic(stress, [stiffness], modulus=2 * 4e4)
frames = simulator.rollout(100, own, every=5)
frames.x[-1, :, 1].mean().backward()
print(f"d height / d stiffness {stiffness.grad.item():.3g} m/Pa")

# %%
with torch.no_grad():
    known = simulator.rollout(100, laws.FixedCorotated(8e4, 0.0), every=5)
times = 5e-3 * torch.arange(21)
plt.figure(figsize=(5, 3))
plt.plot(times, frames.x.detach()[..., 1].mean(1), label="own law")
plt.plot(times, known.x[..., 1].mean(1), label="fixed corotated, E = 80 kPa, Poisson's ratio 0")
plt.xlabel("time [s]")
plt.ylabel("mean height [m]")
plt.legend(frameon=False)
plt.tight_layout()
plt.savefig("own_law.png")
