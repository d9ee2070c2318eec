"""
Finite elements beside MPM
==========================

Two methods simulate the same scene, body and law. Where they disagree, the difference is an error of at least one of them.
Run it with ``python examples/06_two_solvers.py``.
"""

import matplotlib.pyplot as plt
import torch

from neuido import FiniteElements, Scene, Simulator, laws, shapes

body = shapes.box(
    lower=(0.2, 0.45, 0.45), upper=(0.8, 0.55, 0.55), spacing=0.025, velocity=(0.0, 0.0, 0.0), angular_velocity=(0.0, 0.0, 6.0)
)
scene = Scene(cells=32, dt=5e-4, gravity=(0.0, 0.0, 0.0), walls=None)
law = laws.NeoHookean(2e5, 0.3)
with torch.no_grad():
    mpm = Simulator(scene, body, device="cpu").rollout(300, law, every=20)
    fem = FiniteElements(scene, body, device="cpu").rollout(300, law, every=20)

# %%
# A body that spins freely loses no energy. A loss in the simulation is an error of the method.
times = 20 * scene.dt * torch.arange(len(mpm.x))
figure, (left, right) = plt.subplots(1, 2, figsize=(8.5, 3))
for name, frames in (("material points", mpm), ("finite elements", fem)):
    spin = 0.5 * frames.v.square().sum(-1).mean(1)
    left.plot(times, spin / spin[0], label=name)
    right.scatter(frames.x[-1, :, 0], frames.x[-1, :, 1], s=2, label=name)
left.set(xlabel="time [s]", ylabel="kinetic energy / at the start")
left.legend(frameon=False)
right.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", title="last frame")
figure.tight_layout()
figure.savefig("solvers.png")
distance = (mpm.x[-1] - fem.x[-1]).square().sum(-1).mean().sqrt()
print(f"the methods end {1e3 * distance.item():.1f} mm apart")
