"""
Effects
=======

An effect is what a plain model leaves out: drag, wind, viscosity, yield. Each is a parameter that is zero when the effect is absent.
Run it with ``python examples/04_effects.py``.
"""

import matplotlib.pyplot as plt
import torch

from neuido import Scene, Simulator, effects, laws, shapes

body = shapes.cube(length=0.2, centre=(0.25, 0.3, 0.5), particles_per_side=5, velocity=(1.5, 1.5, 0.0))
simulator = Simulator(Scene(cells=16, dt=1e-3, walls=None, lower=(0.0, -1.0, 0.0), upper=(2.0, 1.0, 1.0)), body, device="cpu")
law = laws.FixedCorotated(5e4, 0.3)

# %%
# The same throw three times: with no effect, with drag, with wind.
throws = {
    "nothing": {},
    "linear drag, 2 /s": {"drag_linear": 2.0},
    "wind, 3 m/s² against it": {"uniform_acceleration": (-3.0, 0.0, 0.0)},
}
plt.figure(figsize=(5.5, 3.2))
for name, given in throws.items():
    with torch.no_grad():
        centre = simulator.rollout(400, law, every=20, effects=effects.Effects(**given)).x.mean(1)
    plt.plot(centre[:, 0], centre[:, 1], marker=".", label=name)
plt.xlabel("x [m]")
plt.ylabel("height [m]")
plt.legend(frameon=False)
plt.tight_layout()
plt.savefig("effects.png")

# %%
# Effects have gradients too. This one says how far a small drag would move the landing point, although the drag is zero here.
drag = torch.zeros(1, requires_grad=True)
landing = simulator.rollout(400, law, every=400, effects=effects.Effects(drag_linear=drag)).x[-1, :, 0].mean()
landing.backward()
print(f"lands at {landing.item():.2f} m; {drag.grad.item():.2f} m for each 1/s of drag")
print("effects of the library:", ", ".join(entry.name for entry in effects.LIBRARY))
