"""
A mesh as a body
================

A mesh is filled with particles, falls on a floor, and its surface follows them.
Run it with ``python examples/16_mesh_body.py`` (needs ``pip install 'neuido[mesh]'``).
"""

import matplotlib.pyplot as plt
import numpy as np

from neuido import Scene, Simulator, laws, shapes

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
# The volumes of the particles sum to that of the mesh. The mesh becomes the skin of the body.
body = shapes.mesh(file="star.obj", particles=3000, size=0.36, centre=(0.5, 0.35, 0.5), rotation=(20, 0, 35), velocity=(0, -2, 0))
simulator = Simulator(Scene(cells=32, dt=4e-4), body, device="cpu")
frames = simulator.rollout(600, laws.NeoHookean(6e4, 0.35), every=40)
surface = frames.skins[0].vertices_at(frames)
low = surface[:, :, 1].amin(dim=1)
print(f"{len(body.x)} particles of {float(body.volume.sum()) * 1e6:.0f} cm^3; the skin comes down to {float(low.min()) * 1e3:.0f} mm")

# %%
figure = plt.figure(figsize=(9, 3.2))
for n, k in enumerate((0, 6, 9, 14)):
    panel = figure.add_subplot(1, 4, n + 1, projection="3d")
    x, z, y = surface[k].T.numpy()  # up is y here and z in the picture
    panel.plot_trisurf(x, y, z, triangles=frames.skins[0].faces.numpy(), color="tab:orange", edgecolor="k", linewidth=0.3)
    panel.set(title=f"{16 * k} ms", xlim=(0.32, 0.68), ylim=(0.32, 0.68), zlim=(0, 0.54), box_aspect=(2, 2, 3))
    panel.set_axis_off()
figure.tight_layout()
figure.savefig("mesh_body.png")
