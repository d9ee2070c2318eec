"""
A mesh body on a height field
=============================

A mesh is filled with particles, falls on hilly ground, and its surface follows them.
Run it with ``python examples/18_mesh_body.py`` (needs ``pip install 'neuido[mesh,viewer]'``).
"""

import subprocess
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch

from neuido import Scene, Simulator, colliders, laws, shapes

# %%
# A star with six rays, as an .obj file; yours comes from a scanner or a CAD program.
corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
ends = np.array([[4, 0, 0], [0, 4, 0], [0, 0, 4], [-4, 0, 0], [0, -4, 0], [0, 0, -4]])
faces = []
for end in range(6):
    side = [i for i in range(8) if corners[i] @ ends[end] > 0]
    middle = corners[side].mean(axis=0)
    across = corners[side[0]] - middle
    turn = np.cross(ends[end], across)
    side.sort(key=lambda i: np.arctan2((corners[i] - middle) @ turn / np.linalg.norm(turn), (corners[i] - middle) @ across))
    faces += [(9 + end, side[k] + 1, side[(k + 1) % 4] + 1) for k in range(4)]
points = np.concatenate([corners, ends])
with open("star.obj", "w") as file:
    file.writelines(f"v {x} {y} {z}\n" for x, y, z in points)
    file.writelines(f"f {a} {b} {c}\n" for a, b, c in faces)

# %%
# The ground is given by heights on a lattice. It is a solid collider, as a table or a gripper is.
side = np.linspace(0, 1, 33)
heights = 0.12 + 0.05 * np.sin(4 * np.pi * side)[:, None] * np.cos(3 * np.pi * side) - 0.15 * side[:, None]
ground = colliders.HeightField(heights, (1.0, 1.0), position=(0.5, 0.1, 0.5), friction=0.4, name="ground")

# %%
# The volumes of the particles sum to that of the mesh. The mesh becomes the skin of the body.
body = shapes.mesh(file="star.obj", particles=2500, size=0.36, centre=(0.3, 0.5, 0.5), rotation=(20, 0, 35), velocity=(0.5, -1, 0))
scene = Scene(cells=28, dt=5e-4, colliders=(ground,))
with torch.no_grad():
    frames = Simulator(scene, body, device="cpu").rollout(720, laws.NeoHookean(4e4, 0.35), every=60)
surface = frames.skins[0].vertices_at(frames)
push = frames.forces[1:, 0].norm(dim=1)
print(f"{len(body.x)} particles of {float(body.volume.sum()) * 1e6:.0f} cm^3; the ground feels up to {float(push.max()):.0f} N")

# %%
# ``neuido view star.npz`` plays the motion in the browser, ``neuido render star.npz --out star.mp4`` makes a video of it; here, pictures.
frames.save("star.npz")
drawing = ["render", "star.npz", "--out", "star/frame.png", "--every", "4", "--eye", "[1.2, 0.8, 1.5]", "--look_at", "[0.45, 0.32, 0.5]"]
subprocess.run([sys.executable, "-m", "neuido", *drawing], check=True)
figure, panels = plt.subplots(2, 2, figsize=(10, 7.6))
for panel, path in zip(panels.flat, sorted(Path("star").glob("*.png")), strict=True):
    panel.imshow(plt.imread(path))
    panel.axis("off")
figure.tight_layout(pad=0.2)
figure.savefig("mesh_body.png", dpi=100)
