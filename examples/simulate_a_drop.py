"""Drop a jelly cube, and differentiate its final height with respect to its stiffness."""

import torch

import neuido

floor = neuido.Plane(point=(0.0, 0.1, 0.0), normal=(0.0, 1.0, 0.0))
cube = neuido.shapes.cube(length=0.3, particles_per_side=8)
simulator = neuido.Simulator(neuido.Scene(cells=24, dt=5e-4, colliders=(floor,)), cube, density=1000.0)

young = torch.tensor(3e4, requires_grad=True)  # [Pa]
frames = simulator.rollout(800, neuido.laws.FixedCorotated(young, torch.tensor(0.3)), neuido.laws.Identity(), every=20)
height = frames.x[-1, :, 1].mean()
height.backward()
print(f"height {height.item():.3f} m, d height / d young {young.grad.item():.2e} m/Pa")
neuido.export(frames, "drop.npz")
