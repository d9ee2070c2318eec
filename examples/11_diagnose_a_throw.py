"""
What does the model of a thrown block lack?
===========================================

Two throws of a soft block are measured at 60 points. The model of the block lacks the air drag, and its modulus is a third too high. Run
it with ``python examples/11_diagnose_a_throw.py``.
"""

from pathlib import Path

import numpy as np
import torch

from neuido import Scene, Simulator, diagnose, effects, laws, shapes

folder, random = Path("throws"), np.random.default_rng(1)
throws = {"throw": ((0.35, 0.5, 0.5), (1.2, 1.0, 0.3), (0, 0, 5.0)), "toss": ((0.68, 0.42, 0.5), (-2.4, 2.0, -0.8), (0, 0, -4.0))}
for name, (centre, velocity, spin) in throws.items():  # write what a motion capture system records
    body = shapes.cube(length=0.3, centre=centre, particles_per_side=5, velocity=velocity, angular_velocity=spin)
    with torch.no_grad():
        x = (
            Simulator(Scene(cells=14, dt=1e-3), body, device="cpu")
            .rollout(150, laws.FixedCorotated(6e4, 0.3), every=10, effects=effects.Effects(drag_linear=3.0))
            .x.numpy()
        )
    track = random.permutation(125)[:60].astype("int32")
    seen = (x[:, track] + 4e-4 * random.standard_normal((16, 60, 3))).astype("float32")
    (folder / name).mkdir(parents=True, exist_ok=True)
    start = {"x0": body.x.numpy(), "v0": body.v.numpy(), "volume": body.volume.numpy()}
    np.savez(folder / name / "particles.npz", x=seen, t=0.01 * np.arange(16), track=track, **start)
(folder / "experiment.yaml").write_text("""\
format: neuido-experiment/1
name: throws
scene: {domain: [[0, 0, 0], [1, 1, 1]], gravity: [0, -9.8, 0]}
model: {density: 1000.0, elasticity: {law: fixed_corotated, young: 8.0e+4, poisson: 0.3}, free: [young]}
discretisation: {grid: 14, dt: 1.0e-3}
recordings:
  - {name: throw, role: fit, frame_interval: 0.01, noise: 0.0004}
  - {name: toss, role: held_out, frame_interval: 0.01, noise: 0.0004}
""")

# %%
# This example tries three effects. Without ``effects`` a diagnosis tries all that can act on such a body.
suspects = "drag_linear,viscosity_shear,uniform_acceleration"
diagnosis = diagnose(folder, out="throws-diagnosis", effects=suspects, solver="material_points", draws=39, device="cpu")
print(diagnosis.summary())

# %%
figure = diagnosis.plot()
figure.savefig("throws.png", dpi=110)
