"""
A conveyor belt
===============

A soft block is put on a moving belt. Friction carries it along until it has the speed of the belt.
Run it with ``python examples/15_conveyor.py``.
"""

import matplotlib.pyplot as plt
import torch

from neuido import Scene, Simulator, colliders, laws, shapes

speed, friction, gravity, density = 0.6, 0.25, 9.8, 1000.0  # m/s, -, m/s^2, kg/m^3
block = shapes.box(lower=(0.1, 0.125, 0.15), upper=(0.25, 0.25, 0.3), spacing=0.025)

# %%
# The belt is a long solid that moves at a constant velocity; most of it lies outside the domain.
belt = colliders.Cuboid((4.0, 0.125, 0.4), position=(0.0, 0.0625, 0.225), velocity=(speed, 0.0, 0.0), friction=friction, name="belt")
scene = Scene(upper=(1.0, 0.45, 0.45), cells=24, dt=5e-4, walls=None, colliders=(belt,))
with torch.no_grad():
    frames = Simulator(scene, block, density=density, device="cpu").rollout(1200, laws.FixedCorotated(1e5, 0.3), every=20)
place, velocity = frames.x[..., 0].mean(1), frames.v[..., 0].mean(1)

# %%
# A rigid block slides for speed / (friction gravity) and falls behind the belt by speed^2 / (2 friction gravity).
slip = speed * float(frames.times[-1]) - float(place[-1] - place[0])
drag = float(frames.forces[4:10, 0, 0].mean())  # on the belt, while the block slides
weight = density * gravity * float(block.volume.sum())
print(f"the block slips {100 * slip:.2f} cm, a rigid one {50 * speed**2 / friction / gravity:.2f} cm")
print(f"the block holds the belt back with {-drag:.2f} N, friction times weight is {friction * weight:.2f} N")

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(8.5, 3))
for k, colour in ((0, "0.8"), (28, "0.55"), (60, "tab:orange")):
    left.scatter(frames.x[k, :, 0], frames.x[k, :, 1], s=5, color=colour, label=f"{float(frames.times[k]):.2f} s")
left.axhspan(0.06, 0.125, color="0.3")
left.set(xlim=(0, 0.7), ylim=(0.06, 0.4), aspect="equal", xlabel="x [m]", ylabel="height [m]")
left.legend(frameon=False, ncols=3, loc="upper center")
right.plot(frames.times, velocity, label="soft block")
right.plot(frames.times, (friction * gravity * frames.times).clamp(max=speed), "k:", label="rigid block")
right.set(xlabel="time [s]", ylabel="speed [m/s]")
right.legend(frameon=False)
figure.tight_layout()
figure.savefig("conveyor.png", dpi=110)
