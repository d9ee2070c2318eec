"""The shear stress of a fluid in steady shear, or along a course of shear rates in time."""

from collections.abc import Mapping

import numpy as np

from neuido.errors import UserError
from neuido.physics.effects.point_library import FLUID


def flow_stress(viscosity: np.ndarray, effects: Mapping[str, np.ndarray], rate: np.ndarray, time: np.ndarray | None = None) -> np.ndarray:
    """Compute the shear stress of a Newtonian fluid with effects.

    Args:
        viscosity: [Pa s], (P,).
        effects: Parameters of `point_library.FLUID` by name, (P,) each; an effect is absent where its first parameter is.
        rate: Shear rates [1/s], (n,), positive.
        time: Times of the rows [s], (n,), increasing; None: each row is steady. The rate of a row holds from the row before it, and the
            fluid comes from rest.

    Returns:
        Shear stress [Pa], (P, n).

    Raises:
        UserError: A rate that is not positive, or an effect of solids.
    """
    if not (rate > 0).all():
        raise UserError(f"shear rates must be positive, got {rate.min():g} 1/s")
    wrong = [name for name in effects if name.partition(".")[0] not in FLUID]
    if wrong:
        raise UserError(f"{wrong[0]} is no effect of a fluid: choose from {', '.join(FLUID)}")
    zero = np.zeros(len(viscosity))

    def value(name: str, rest: float = 0.0) -> np.ndarray:
        return np.broadcast_to(effects.get(name, zero + rest), zero.shape)[:, None]

    eta = viscosity[:, None] * np.ones(len(rate))
    for name in ("power_law", "herschel_bulkley"):
        if f"{name}.n" in effects:
            eta = eta * (rate / value(f"{name}.reference", 1.0)) ** value(f"{name}.n")
    if "carreau.n" in effects:
        eta = eta * (1 + (value("carreau.time", 1.0) * rate) ** 2) ** (0.5 * value("carreau.n"))
    if "thixotropy.c" in effects:
        eta = eta * (1 + value("thixotropy.c") * structure(value("thixotropy.breakdown", 1.0), value("thixotropy.build", 1.0), rate, time))
    return eta * rate + value("bingham.yield") + value("herschel_bulkley.yield")


def structure(breakdown: np.ndarray, build: np.ndarray, rate: np.ndarray, time: np.ndarray | None) -> np.ndarray:
    """Return the structure z of `thixotropy`, (P, n): z' = build (1 - z - breakdown rate z), from z = 1 at rest.

    Args:
        breakdown: [s], (P, 1).
        build: [1/s], (P, 1).
        rate: [1/s], (n,).
        time: [s], (n,), or None: the steady values.
    """
    steady = 1 / (1 + breakdown * rate)
    if time is None:
        return steady
    gaps = np.diff(time, prepend=time[0] - (time[1] - time[0] if len(time) > 1 else 1.0))
    stays = np.exp(-build * gaps / steady)
    z, out = np.ones(len(breakdown)), np.empty_like(steady)
    for i in range(len(rate)):
        z = steady[:, i] + (z - steady[:, i]) * stays[:, i]
        out[:, i] = z
    return out
