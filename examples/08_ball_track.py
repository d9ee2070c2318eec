"""
The track of a ball
===================

A tracker gives the position of a ball over time. Does gravity alone explain its flight? The two throws here are simulated with a
quadratic drag and 2 mm of noise, so the right answer is known. Run it with ``python examples/08_ball_track.py``.
"""

from pathlib import Path

import numpy as np

from neuido import diagnose


def throw(velocity, drag=0.15, dt=1e-3, steps=700):
    """Return time [s], x and y [m] of a ball with quadratic drag [1/m], every 20 ms."""
    x, v, path = np.zeros(2), np.array(velocity, float), []
    for k in range(steps):
        if k % 20 == 0:
            path.append((k * dt, *x))
        v = v + dt * (np.array([0.0, -9.81]) - drag * np.linalg.norm(v) * v)
        x = x + dt * v
    return np.array(path)


folder, random = Path("ball"), np.random.default_rng(0)
folder.mkdir(exist_ok=True)
for name, velocity in (("first", (6.0, 4.0)), ("second", (3.0, 6.0))):
    path = throw(velocity)
    path[:, 1:] += 2e-3 * random.standard_normal(path[:, 1:].shape)
    np.savetxt(folder / f"{name}.csv", path, delimiter=",", header="t_s,x_m,y_m", comments="")
(folder / "track.yaml").write_text("""\
format: neuido-track/1
name: ball
model: {gravity: [0, -9.81, 0], effects: {}, free: []}
bodies: {ball: {mass: 0.0027, diameter: 0.04}}
recordings:
  - {name: first, body: ball, file: first.csv, columns: {t: t_s, x: x_m, y: y_m}, noise: 0.002, role: fit}
  - {name: second, body: ball, file: second.csv, columns: {t: t_s, x: x_m, y: y_m}, noise: 0.002, role: held_out}
""")
diagnosis = diagnose(folder, out="ball-diagnosis", draws=39, device="cpu")
print(diagnosis.summary())

# %%
figure = diagnosis.plot()
figure.savefig("ball.png", dpi=110)
