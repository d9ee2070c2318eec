"""
A modulus from a trajectory
===========================

The motion of a bouncing ball is known, its modulus is not. Gradient descent through the simulator finds the modulus.
Run it with ``python examples/02_find_modulus.py``.
"""

import matplotlib.pyplot as plt
import torch

from neuido import Scene, Simulator, laws, shapes

body = shapes.ball(centre=(0.5, 0.17, 0.5), radius=0.12, spacing=0.04, velocity=(0.0, -1.5, 0.0))
simulator = Simulator(Scene(cells=20, dt=1e-3), body, device="cpu")
with torch.no_grad():
    recorded = simulator.rollout(120, laws.FixedCorotated(6e4, 0.3), every=10).x

# %%
# The fit is for the logarithm of the modulus: the modulus stays positive, and a step changes it by a factor.
log_young = torch.tensor([2e5]).log().requires_grad_()
optimiser = torch.optim.Adam([log_young], lr=0.1, betas=(0.5, 0.9))
moduli, errors = [], []
for _ in range(25):
    optimiser.zero_grad()
    predicted = simulator.rollout(120, laws.FixedCorotated(log_young.exp(), 0.3), every=10).x
    error = (predicted - recorded).square().sum(-1).mean()
    error.backward()
    moduli.append(log_young.exp().item())
    errors.append(1e3 * error.sqrt().item())
    optimiser.step()
print(f"found {moduli[-1]:.3g} Pa, true 6e+04 Pa; {errors[0]:.1f} mm became {errors[-1]:.2f} mm")
assert abs(moduli[-1] / 6e4 - 1) < 0.02, "the modulus was not found"

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(8, 3))
left.semilogy(moduli)
left.axhline(6e4, color="0.5", linestyle=":")
left.set(xlabel="step", ylabel="Young's modulus [Pa]")
right.semilogy(errors)
right.set(xlabel="step", ylabel="RMS distance [mm]")
figure.tight_layout()
figure.savefig("modulus.png")
