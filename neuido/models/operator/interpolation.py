"""Interpolation between two latents of Stage I: drop tests along the line, and the monotonicity of their results (paper, analysis)."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from neuido.data.bodies.shapes import ball
from neuido.errors import UserError
from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
from neuido.models.operator.law_properties import p_wave_modulus
from neuido.physics.mpm.simulator import Simulator
from neuido.physics.runtime.device import choose_device
from neuido.types import Scene, Walls

CELLS, DT, EVERY, FRAMES = 16, 5e-4, 4, 151
"""Grid, time step [s], substeps per frame and number of frames of the drop test: 0.3 s with a frame every 2 ms."""


class Interpolation(NamedTuple):
    """Drop tests with the laws between two latents."""

    names: tuple[str, str]
    """Names of the two latents."""
    shares: Tensor
    """Weight of the second latent in each law, (N,)."""
    rows: list[dict[str, float]]
    """share, modulus [Pa], compression [-] and contact [s] of each law."""
    motion: Tensor
    """Particle positions [m], (K, N, P, 3)."""

    def __repr__(self) -> str:
        return f"Interpolation({self.names[0]!r} to {self.names[1]!r}, {len(self.rows)} laws, {len(self.motion)} frames)"


def interpolate(
    operator: IntrinsicDynamicsOperator, ends: tuple[str, str], *, count: int = 9, height: float = 0.3, device: str = "auto"
) -> Interpolation:
    """Simulate a drop test for each of several latents on the line between two, all in one launch.

    A ball of diameter 0.24 m hits a frictionless floor with an initial velocity of 2 m/s. `compression` is the largest decrease of its
    height relative to the initial height. `contact` is the time during which the floor carries more than half of its weight.

    Args:
        operator: The operator.
        ends: Names of two latents.
        count: Number of latents, including the ends.
        height: Initial height of the centre of the ball [m].
        device: `auto` (CUDA where available), `cpu` or `cuda`.

    Raises:
        UserError: A name is unknown, there are fewer than three latents, or a simulation fails.
    """
    if count < 3:
        raise UserError(f"count = {count}: at least 3 latents are needed, including the ends")
    chosen = choose_device(device)
    operator = operator.to(chosen)
    a, b = (operator.latent(name) for name in ends)
    shares = torch.linspace(0, 1, count, device=a.device)
    z = torch.lerp(a, b, shares[:, None])
    body = ball(centre=(0.5, height, 0.5), radius=0.12, spacing=0.03, velocity=(0.0, -2.0, 0.0))
    scene = Scene(cells=CELLS, dt=DT, walls=Walls(inset=2.0))
    simulator = Simulator([scene] * count, [body] * count, device=chosen)
    with torch.no_grad():
        moduli = p_wave_modulus(operator, z).tolist()
        motion = simulator.rollout((FRAMES - 1) * EVERY, *operator.laws(z), every=EVERY)
    x, v = (t.view(FRAMES, count, -1, 3).cpu() for t in (motion.x, motion.v))
    tall = x[..., 1].amax(2) - x[..., 1].amin(2)
    compression = (1 - tall.amin(0) / tall[0]).tolist()
    pushes = v[..., 1].mean(2).diff(dim=0) / (EVERY * DT) > 0.5 * scene.gravity[1]
    contact = (pushes.sum(0) * EVERY * DT).tolist()
    rows = [dict(zip(("share", "modulus", "compression", "contact"), row)) for row in zip(shares.tolist(), moduli, compression, contact)]
    return Interpolation(ends, shares.cpu(), rows, x)


def softest_and_stiffest(operator: IntrinsicDynamicsOperator, family: str = "elastic") -> tuple[str, str]:
    """Return the names of a family's latents with the smallest and the largest small-strain modulus.

    Raises:
        UserError: The family has fewer than two latents.
    """
    own = [i for i, each in enumerate(operator.latent_families) if each == family]
    if len(own) < 2:
        known = ", ".join(dict.fromkeys(operator.latent_families)) or "none"
        raise UserError(f"family = {family!r} has {len(own)} latents, two are needed; there are {known}")
    with torch.no_grad():
        moduli = p_wave_modulus(operator, operator.latents[own].to(operator.elastic_trunk.fc1.weight))
    return operator.latent_names[own[int(moduli.argmin())]], operator.latent_names[own[int(moduli.argmax())]]


def monotonicity(values: Sequence[float]) -> dict[str, float]:
    """Measure how monotonically a sequence of values changes from the first to the last one.

    Returns:
        `steps`: fraction of steps in the overall direction. `spearman`: rank correlation with the index, times the sign of the overall
        change (one for a monotone sequence). `back`: largest step against the overall direction, relative to the overall change.
    """
    from scipy.stats import spearmanr

    v = np.asarray(values, float)
    way = v[-1] - v[0]
    steps = np.diff(v) * np.sign(way)
    with np.errstate(invalid="ignore"):
        rank = float(spearmanr(np.arange(len(v)), v).statistic) * float(np.sign(way)) if way else 0.0
    return {"steps": float((steps > 0).mean()), "spearman": rank, "back": float(max(0.0, -steps.min()) / abs(way)) if way else 1.0}


@torch.no_grad()
def pairwise_monotonicity(operator: IntrinsicDynamicsOperator, family: str, *, count: int = 9) -> dict[str, float]:
    """Measure the monotonicity of the small-strain modulus between all pairs of latents of a family.

    Pairs whose moduli differ by less than about 10 % are left out, because their direction is not significant.

    Returns:
        `pairs`: number of pairs. `monotone`: fraction of pairs that are monotone in every step. `steps`, `spearman`: means over the pairs.
    """
    z = operator.latents[[i for i, each in enumerate(operator.latent_families) if each == family]].to(operator.elastic_trunk.fc1.weight)
    first, second = torch.triu_indices(len(z), len(z), 1)
    line = torch.lerp(z[first, None], z[second, None], torch.linspace(0, 1, count, device=z.device)[:, None])
    moduli = p_wave_modulus(operator, line.flatten(0, 1)).view(len(first), count)
    apart = (moduli[:, -1] / moduli[:, 0]).log().abs() > 0.1
    found = [monotonicity(row) for row in moduli[apart].tolist()]
    mean = {key: float(np.mean([each[key] for each in found])) for key in ("steps", "spearman")} if found else {}
    return {"pairs": float(len(found)), "monotone": float(np.mean([each["steps"] == 1 for each in found])) if found else 0.0, **mean}
