"""How motions of a body are launched: their substeps and frames, and which of them share a launch on a GPU.

Those share one that need the same kernels, and the same inner steps of finite elements, because a launch computes for each of its motions
all that one of them needs. Histories of relaxation and flow take three times the work of a body without an effect, and a viscosity takes
ten times the inner steps.
"""

import bisect
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from neuido.data.measured.experiment import Recording as Measured
from neuido.discrepancy.problems.problem import Candidate
from neuido.physics.runtime.frames import Frames
from neuido.types import ParticleState

SEGMENT = 200
"""Number of substeps that a GPU captures as one piece, which a rollout replays. A longer piece takes longer to capture than to run."""
FORCES = frozenset({
    "added_mass", "drag_linear", "drag_quadratic", "friction", "gravity", "magnus", "position_force", "restitution", "stick", "time_force",
    "uniform_acceleration",
})  # fmt: skip
"""Effects that act on the grid or the nodes alone."""
STRESSES = frozenset({
    "fibre", "second_invariant", "stiffness_change", "stiffness_gradient", "strain_stiffening", "tension_compression", "viscosity_bulk",
    "viscosity_shear",
})  # fmt: skip
"""Effects that add to the stress and have no history."""
PATH_SCALE = "path_scale"
"""Name of a nuisance: relative error of the measured path of the clamps of a recording."""
INNER_STEPS = sorted({factor << k for factor in (1, 3) for k in range(11)})
"""Numbers of inner steps that finite elements take: few enough that motions of about the same need share launches and captured loops."""


def stage(effects: Mapping[str, float]) -> int:
    """Return the kernels that a complete parameter set needs: 0 those of the law alone, 1 forces too, 2 stresses too, 3 all."""
    return max((_stage(name) for name, value in effects.items() if "." in name and value), default=0)


def _stage(name: str) -> int:
    effect = name.partition(".")[0]
    return 1 if effect in FORCES else 2 if effect in STRESSES else 3


def names(candidates: Sequence[Candidate], upto: int) -> list[str]:
    """Return the parameters of all candidates whose kernels a stage has, so that one captured launch serves every set of them."""
    return [p.name for c in candidates for p in c.parameters if _stage(p.name) <= upto]


def inner_steps(need: float) -> int:
    """Return the least of `INNER_STEPS` that is no less than what a motion needs."""
    return INNER_STEPS[min(bisect.bisect_left(INNER_STEPS, need - 1e-9), len(INNER_STEPS) - 1)]


def frames_until(r: Measured, share: float) -> int:
    """Return the number of frames of a recording up to a share of the time from its first to its last motion, at least two."""
    t = r.t.double().numpy()
    return len(t) if share == 1.0 else max(int(np.sum(t <= t[1] + share * (t[-1] - t[1]) + 1e-9 * t[-1])), 2)


def substeps(r: Measured, dt: float, share: float = 1.0) -> tuple[int, int, bool]:
    """Return the substeps between stored frames, those of the rollout, and whether stored frames are the recorded ones.

    If not, stored frames are close to each other, to be interpolated. `dt` is the substep [s]; a rollout may end after a share of the time.
    """
    t = r.t.double().numpy()
    count = frames_until(r, share)
    every = round(r.frame_interval / dt)
    if every >= 1 and np.allclose(t, np.arange(len(t)) * every * dt, rtol=0.0, atol=1e-3 * r.frame_interval):
        return every, every * (count - 1), True
    every = max(1, round(float(np.diff(t).min()) / dt / 6))
    return every, every * int(np.ceil(t[count - 1] / (every * dt) + 1e-9)), False


def segment_of(steps: int, every: int) -> int:
    """Return the number of substeps per piece of a rollout: a divisor of `steps` and multiple of `every`, if possible <= `SEGMENT`."""
    frames = steps // every
    return every * max(n for n in range(1, frames + 1) if frames % n == 0 and (n == 1 or n * every <= SEGMENT))


def standing_still(frames: ParticleState, count: int) -> ParticleState:
    """Return frames (K, ...) with the last one repeated until there are `count`."""
    return ParticleState(*(torch.cat([t, t[-1:].expand(count - len(t), *t.shape[1:])]) if len(t) < count else t for t in frames))


def at_times(frames: ParticleState, step: float, t: Tensor) -> ParticleState:
    """Interpolate frames (K, S, P, ...) that are `step` [s] apart to the times t [s]: x by cubic Hermite polynomials, others linearly."""
    x, v, C, F = frames
    k = (t / step).floor().long().clamp(max=len(x) - 2)
    u = (t / step - k)[:, None, None, None]
    x0, x1, v0, v1 = x[k], x[k + 1], v[k] * step, v[k + 1] * step
    place = (1 + 2 * u) * (1 - u) ** 2 * x0 + u * (1 - u) ** 2 * v0 + u**2 * (3 - 2 * u) * x1 + u**2 * (u - 1) * v1
    w = u[..., None]
    return ParticleState(place, ((1 - u) * v0 + u * v1) / step, (1 - w) * C[k] + w * C[k + 1], (1 - w) * F[k] + w * F[k + 1])


class Pushes(NamedTuple):
    """What the clamps of simulations give to the body."""

    t: np.ndarray
    """Times [s], (K,)."""
    impulse: np.ndarray
    """Momentum given from the start on [N s], (S, K, C, 3)."""


def pushes_of(frames: Frames, scenes: Sequence[int], clamps: int) -> Pushes:
    """Return the impulses of the clamps, which are the last colliders of a scene, on the bodies of some scenes."""
    step = float(frames.dt[scenes[0] if len(frames.dt) > 1 else 0])
    out = []
    for s in scenes:
        own = [each.force for each in frames.colliders if each.scene == s and each.force is not None][-clamps:]
        out.append(-step * torch.stack(own, dim=1).cumsum(dim=0).cpu().numpy())
    return Pushes(step * np.arange(len(frames.x)), np.stack(out))


def scaled_paths(simulator: Any, steps: int, points: Sequence[tuple[Mapping[str, float], str]]) -> dict[str, Any]:
    """Return the argument `solids` of a rollout in which the clamps move by their path times its nuisance; empty where none has one.

    Args:
        simulator: The simulator.
        steps: Substeps of the rollout.
        points: Parameter set, and name of the recording, of each scene.
    """
    scale = [point.get(f"{PATH_SCALE}:{name}", 0.0) for point, name in points]
    if not any(scale):
        return {}
    own = simulator.solid_inputs(steps)
    return {"solids": own._replace(twist=own.twist * (1.0 + own.twist.new_tensor(scale))[:, None, None])}
