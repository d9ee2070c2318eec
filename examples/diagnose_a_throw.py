"""Throw a ball in air, model it without air, and find the drag that the model lacks."""

import numpy as np

import neuido
from neuido.data import Track, Tracks

rng, throws = np.random.default_rng(0), []
for name, role, velocity in (("low", "fit", (9.0, 6.0)), ("high", "fit", (3.0, 8.0)), ("fast", "held_out", (12.0, 2.0))):
    t, x, v = np.arange(61) * 0.02, [np.array([0.0, 2.0])], np.array(velocity)
    for _ in range(1200):  # the truth: a quadratic drag of 0.12 1/m
        v = v + 1e-3 * (np.array([0.0, -9.81]) - 0.12 * np.linalg.norm(v) * v)
        x.append(x[-1] + 1e-3 * v)
    throws.append(Track(name, "ball", role, t, np.stack(x)[::20] + 0.004 * rng.standard_normal((61, 2)), (0, 1), noise=0.004))
data = Tracks("throws", ".", gravity=(0.0, -9.81, 0.0), bodies={"ball": {"mass": 0.003, "diameter": 0.04}}, recordings=tuple(throws))
found = neuido.diagnose(data, effects=["drag_linear", "drag_quadratic", "gravity"], draws=39)
print(found.summary())
found.plot().savefig("throw.png")
