"""
A throw that hits its target
============================

A rubber ball shall bounce once on the floor and hit a target. The simulator gives the derivatives of the hit with respect to the throw.
Run it with ``python examples/19_throw_at_target.py``.
"""

import matplotlib.pyplot as plt
import torch

from neuido import Scene, Simulator, laws, shapes

ball = shapes.ball(centre=(0.2, 0.35, 0.2), radius=0.07, spacing=0.03)
scene = Scene(upper=(1.0, 0.6, 0.4), cells=24, dt=1e-3)
simulator = Simulator(scene, ball, device="cpu")
target, law, steps = torch.tensor([0.8, 0.25]), laws.NeoHookean(8e4, 0.4), 450


def throw(velocity):
    """Return the path of the centre of a ball thrown with a velocity (x, y)."""
    v = torch.cat([velocity, torch.zeros(1)]).expand(simulator.state.v.shape)
    return simulator.rollout(steps, law, state=simulator.state._replace(v=v), every=5).x.mean(1)


# %%
# Newton's method: two backward passes give the derivatives of both coordinates of the hit, a linear system the next throw.
velocity, paths, misses = torch.tensor([1.0, -0.5]), [], []
for _ in range(3):
    velocity.requires_grad_()
    path = throw(velocity)
    miss = path[-1, :2] - target
    paths.append(path.detach())
    misses.append(100 * float(miss.detach().norm()))
    print(f"throw ({velocity[0]:.2f}, {velocity[1]:.2f}) m/s misses by {misses[-1]:.2f} cm")
    rows = [torch.autograd.grad(part, velocity, retain_graph=True)[0] for part in miss]
    velocity = (velocity - torch.linalg.solve(torch.stack(rows), miss)).detach()
assert misses[-1] < 0.5, "the target was not hit"

# %%
plt.figure(figsize=(6.5, 3.4))
for k, path in enumerate(paths):
    plt.plot(path[:, 0], path[:, 1], color=("0.7", "tab:blue", "k")[k], label=f"throw {k + 1}")
plt.plot(*target, "x", color="tab:red", markersize=12, markeredgewidth=3)
plt.axhline(0, color="0.4", linewidth=3)
plt.axis("equal")
plt.gca().set(xlabel="x [m]", ylabel="height [m]")
plt.legend(frameon=False, fontsize=8)
plt.tight_layout()
plt.savefig("throw_at_target.png", dpi=110)
