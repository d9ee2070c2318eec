"""
A modulus from a force curve
============================

A press squeezes a foam cube and records its force. Gradients through the simulated force find Young's modulus of the foam.
Run it with ``python examples/20_modulus_from_force.py``.
"""

import matplotlib.pyplot as plt
import torch

from neuido import Keyframes, Scene, Simulator, colliders, laws, shapes

side, travel = 0.2, 0.03  # m
cube = shapes.box(lower=(0.2, 0.1, 0.2), upper=(0.4, 0.3, 0.4), spacing=0.025)
plates = (
    colliders.HalfSpace(position=(0.0, 0.1, 0.0), contact="slip"),
    colliders.Cuboid((0.5, 0.1, 0.5), path=Keyframes((0.0, 0.24), ((0.3, 0.35, 0.3), (0.3, 0.35 - travel, 0.3))), contact="slip"),
)
scene = Scene(upper=(0.6, 0.5, 0.6), cells=12, gravity=(0.0, 0.0, 0.0), walls=None, colliders=plates)
simulator = Simulator(scene, cube, density=200.0, device="cpu")


def force(young):
    """Return the force on the press in each frame [N]."""
    return simulator.rollout(240, laws.FixedCorotated(young, 0.1), every=20).forces[1:, 1, 1]  # frames, colliders, axes


# %%
# The record is simulated here, for a foam of 40 kPa, with noise. By the closed form of small strains the force is modulus times side
# times travel. Four cells along a side give a quarter less, eight cells a sixth: against a real press, take a grid that is finer.
with torch.no_grad():
    record = force(torch.tensor(4e4)) + 0.5 * torch.randn(12, generator=torch.Generator().manual_seed(0))
way = travel * torch.arange(1, 13) / 12
print(f"the press feels {float(record[-1]):.1f} N, the closed form is {4e4 * side * travel:.1f} N")

# %%
# The fit is for the logarithm of the modulus, from a guess that is four times too high.
log_young = torch.tensor(1.6e5).log().requires_grad_()
optimiser, moduli = torch.optim.LBFGS([log_young], max_iter=6, line_search_fn="strong_wolfe"), []


def misfit():
    """Return the mean squared misfit, relative to the last force of the record, with its gradient."""
    optimiser.zero_grad()
    moduli.append(float(log_young.detach().exp()))
    error = ((force(log_young.exp()) - record) / record[-1]).square().mean()
    error.backward()
    return error


optimiser.step(misfit)
print(f"found {moduli[-1]:.3g} Pa, true 4e+04 Pa, in {len(moduli)} rollouts")

# %%
figure, axis = plt.subplots(figsize=(5, 3.2), layout="constrained")
axis.plot(1e3 * way, record, "o", label="record")
for young, style in ((moduli[0], ":"), (moduli[-1], "-")):
    axis.plot(1e3 * way, force(torch.tensor(young)), style, label=f"simulated, {young / 1e3:.0f} kPa")
axis.set(xlabel="travel of the press [mm]", ylabel="force [N]")
axis.legend(frameon=False)
figure.savefig("modulus_from_force.png", dpi=110)
