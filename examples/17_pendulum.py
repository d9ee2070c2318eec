"""
A pendulum
==========

A soft rod hangs on a pivot, and a steel ball hangs on the rod. Attachments hold both.
Run it with ``python examples/17_pendulum.py``.
"""

import math

import matplotlib.pyplot as plt
import torch

from neuido import Attachment, Body, Scene, Simulator, colliders, laws, shapes

length, side, radius, mass, density, gravity, tilt = 0.35, 0.05, 0.06, 2.0, 1000.0, 9.8, 0.25  # m, kg, kg/m^3, m/s^2, rad
pivot = torch.tensor([0.5, 0.8, 0.2])
turn = torch.tensor([[math.cos(tilt), -math.sin(tilt), 0.0], [math.sin(tilt), math.cos(tilt), 0.0], [0.0, 0.0, 1.0]])
upright = shapes.box(lower=(-side / 2, -length, -side / 2), upper=(side / 2, 0.0, side / 2), spacing=0.025)
rod = Body(pivot + upright.x.float() @ turn.T, upright.v.float(), upright.volume.float())

# %%
# The ends of the rod are the particles that lie highest and lowest: one end is drawn to the pivot, the other fixed to the ball.
along = upright.x[:, 1]
top, end = (torch.nonzero(chosen)[:, 0].tolist() for chosen in (along > -side, along < -length + 0.025))
place = pivot + turn @ torch.tensor([0.0, -length - radius, 0.0])
ball = colliders.Sphere(radius, position=tuple(place.tolist()), mass=mass, contact="sticky", name="ball")
held = (Attachment(top, point=tuple(pivot.tolist()), stiffness=2e4, damping=20.0), Attachment(end, to="ball"))
scene = Scene(upper=(1.0, 1.0, 0.4), cells=20, dt=5e-4, gravity=(0.0, -gravity, 0.0), walls=None, colliders=(ball,), attachments=held)
with torch.no_grad():
    frames = Simulator(scene, rod, density=density, device="cpu").rollout(2000, laws.FixedCorotated(5e5, 0.3), every=20)
centre = frames.colliders[0].poses[:, :3, 3]
angle = torch.atan2(centre[:, 0] - pivot[0], pivot[1] - centre[:, 1])

# %%
# The period of a rigid pendulum that swings by the same angle, to the first order.
rod_mass, reach = density * length * side**2, length + radius
inertia = mass * (reach**2 + 0.4 * radius**2) + rod_mass * length**2 / 3
rigid = 2 * math.pi * math.sqrt(inertia / gravity / (mass * reach + rod_mass * length / 2)) * (1 + tilt**2 / 16)
signs = torch.nonzero(angle[1:] * angle[:-1] < 0)[:2, 0]
crossings = frames.times[signs] + angle[signs] / (angle[signs] - angle[signs + 1]) * (frames.times[1] - frames.times[0])
print(f"the period is {2 * float(crossings[1] - crossings[0]):.3f} s, that of a rigid pendulum {rigid:.3f} s")

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(8, 3.4))
for k in (0, 16, 32, 48, 64):
    left.scatter(frames.x[k, :, 0], frames.x[k, :, 1], s=3, color=plt.cm.viridis(k / 80))
    left.add_patch(plt.Circle(centre[k, :2].tolist(), radius, color=plt.cm.viridis(k / 80), alpha=0.6))
left.plot(*pivot[:2], "k^")
left.set(aspect="equal", xlim=(0.28, 0.72), ylim=(0.3, 0.85), xlabel="x [m]", ylabel="height [m]")
right.plot(frames.times, angle, label="soft rod and ball")
right.plot(frames.times, tilt * torch.cos(2 * math.pi / rigid * frames.times), "k:", label="rigid")
right.set(xlabel="time [s]", ylabel="angle [rad]")
right.legend(frameon=False)
figure.tight_layout()
figure.savefig("pendulum.png", dpi=110)
