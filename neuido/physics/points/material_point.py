"""The material point: the stress of a law with effects along a measured path, in a uniformly deformed specimen.

The machine prescribes some principal stretches, or an amount of shear, along the axes of the specimen, or the stress along its loading
axis. The other stretches follow from zero lateral stress; in an incompressible specimen the pressure makes the lateral stress zero. Shear
stresses, which an oblique fibre causes, are carried by the grips, so that F stays diagonal. Many parameter sets run as one batch.
"""

import numpy as np
import torch
from torch import Tensor

from neuido.errors import UserError
from neuido.physics.points.plane_engine import PlaneEngine
from neuido.physics.points.rig import Rig, TensorEngine, approach, turn
from neuido.physics.points.specimen import Specimen
from neuido.types import Vector

__all__ = ["MODES", "RATES", "Specimen", "complex_modulus", "strain_along", "stress_along", "turn"]

MODES = ("uniaxial", "equibiaxial", "pure_shear", "biaxial", "simple_shear")
"""Kinds of material test; `stress_along` describes each."""
RATES = ("viscosity_shear", "viscosity_bulk", "maxwell_ratio", "hysteresis", "rate_yield", "stiffness_change", "swelling")
"""Fields of effects that depend on the rate or on time, and therefore need the times of the path."""
POINT_RATES = ("relaxation_spectrum", "fractional", "creep", "rate_power")
"""Such effects of `point_library`."""


def stress_along(
    specimen: Specimen,
    mode: str,
    path: Tensor,
    *,
    direction: Vector = (1.0, 0.0, 0.0),
    time: Tensor | None = None,
    true_stress: bool = False,
    step: float = 0.1,
    periodic: bool = False,
) -> Tensor:
    """Compute the stress that a testing machine measures along a path of stretches or shear.

    Before the first row the specimen is undeformed and at rest; it reaches the first row in a time equal to the first interval. Without
    plasticity and effects with a history, the rows are independent of each other and are computed together.

    Args:
        specimen: The laws and effects, for P parameter sets.
        mode: `uniaxial` (1 column, the stretch along axis 1), `equibiaxial` (1 column, the stretch along axes 1 and 2), `pure_shear`
            (1 column, the stretch along axis 1, with axis 2 held), `biaxial` (2 columns, the stretches along axes 1 and 2),
            `simple_shear` (1 column, gamma of F = I + gamma e1 e2^T).
        path: Stretches or shear [-], (n, 1) or (n, 2), float64.
        direction: Direction of axis 1 in the axes of the material. The smallest rotation that takes the first axis of the material
            there gives the other axes.
        time: Increasing times of the rows [s], (n,); None: quasi-static.
        true_stress: Whether to return the Cauchy stress instead of the nominal one; in simple shear they are equal.
        step: Largest increment of a logarithmic stretch in one step [-]; used if there is a history.
        periodic: Whether the rows are one period, without its end, of a path that has been repeated until the stress repeats too.

    Returns:
        Stress [Pa], (P, n, 1), or (P, n, 2) for `biaxial`. A parameter set without lateral equilibrium or finite stress is all NaN.

    Raises:
        UserError: An unknown mode, a path of a wrong shape or with a stretch that is not positive, a rate effect without times, or
            swelling of an incompressible specimen or from less than nothing.
    """
    width = 2 if mode == "biaxial" else 1
    _check(specimen, mode, path, width, time, step)
    if mode != "simple_shear" and not bool((path > 0).all()):
        raise UserError(f"path has a stretch of {path.min().item():g}; stretches must be positive")
    rig = Rig(specimen, mode, path.double().numpy(), _axis(direction), true_stress=true_stress)
    e, t = _solved(rig, time, step, periodic)
    return _finite(rig.measured(t, e))


def strain_along(
    specimen: Specimen,
    mode: str,
    stress: Tensor,
    *,
    direction: Vector = (1.0, 0.0, 0.0),
    time: Tensor | None = None,
    true_stress: bool = False,
    step: float = 0.1,
) -> Tensor:
    """Compute the stretch or shear of a specimen whose stress a machine prescribes, as in a creep test.

    The arguments are those of `stress_along`, but `stress` [Pa], (n, 1), stands in the place of the path, and `biaxial` is not possible.
    `step` is in proportion to the P-wave modulus.

    Returns:
        Stretch or shear [-], (P, n, 1). A parameter set that bears no such stress is all NaN.

    Raises:
        UserError: As `stress_along`.
    """
    if mode == "biaxial":
        raise UserError("a prescribed stress takes a mode with one loading axis, not biaxial")
    _check(specimen, mode, stress, 1, time, step)
    rig = Rig(specimen, mode, stress.double().numpy(), _axis(direction), true_stress=true_stress, by_stress=True)
    e, t = _solved(rig, time, step, False)
    wrong = ~np.isfinite(t).all(-1, keepdims=True)
    return _finite(np.where(wrong, np.nan, e[..., 3:] if rig.shear else np.exp(e[..., :1])))


def complex_modulus(specimen: Specimen, omega: Tensor) -> Tensor:
    """Compute the storage and the loss modulus of small oscillations in shear.

    The law is linear there: the base law's shear modulus, in series with the dashpot of `creep` if its exponent is one, beside all Maxwell
    branches and the shear viscosity. Yield and damage have no part in it.

    Args:
        specimen: The laws and effects, for P parameter sets.
        omega: Angular frequencies [rad/s], (n,), positive.

    Returns:
        Storage and loss modulus [Pa], (P, n, 2).

    Raises:
        UserError: A frequency that is not positive.
    """
    if omega.ndim != 1 or not bool((omega > 0).all()):
        raise UserError("frequencies must be positive, one for each row")
    with torch.no_grad():
        law = specimen.law()
        mu, w = law.shear()[:, None].double(), omega.double()
        rate, exponent, stress = (law.value("creep", part)[:, None] for part in ("rate", "exponent", "stress"))
        flows = (rate > 0) & ((exponent - 1).abs() < 1e-9)
        slow = torch.where(flows, stress / (2 * torch.where(flows, rate, 1.0) * mu), torch.inf)  # relaxation time of the base law
        G = mu * torch.where(flows, 1 / (1 - 1j / (w * torch.where(flows, slow, 1.0))), torch.ones((), dtype=torch.complex128))
        if law.tables.branches is not None:
            own, T = law.tables.branches[..., 0:1], law.tables.branches[..., 1:2]
            x = 1j * w * T
            G = G + (0.5 * own * x / (1 + x)).sum(1)
        viscosity = specimen.effects.viscosity(specimen.points, law.like)
        if viscosity is not None:
            G = G + 1j * w * viscosity[:, :1]
        return torch.stack([G.real, G.imag], dim=-1)


def _check(specimen: Specimen, mode: str, path: Tensor, width: int, time: Tensor | None, step: float) -> None:
    if mode not in MODES:
        raise UserError(f"mode = {mode!r} is not known; one of {', '.join(MODES)}")
    if path.ndim != 2 or path.shape[1] != width or len(path) < 1:
        raise UserError(f"path has shape {tuple(path.shape)}; {mode} takes (n, {width})")
    if time is not None and (len(time) != len(path) or bool((time.diff() <= 0).any())):
        raise UserError(f"time must increase and have {len(path)} values, one per row of path; got {len(time)}")
    named = {name.partition(".")[0] for name in specimen.effects.point or {}}
    timed = [name for name in RATES if getattr(specimen.effects, name) is not None] + [name for name in POINT_RATES if name in named]
    if timed and time is None:
        raise UserError(f"{timed[0]} depends on the rate: give the times of the path")
    if specimen.incompressible and specimen.effects.swelling is not None:
        raise UserError("swelling changes the volume: leave it out, or declare the specimen as compressible")
    if time is not None:
        specimen.effects.stress_free_size((time[-1:] - time[0]).double().expand(specimen.points), 1)  # refuses one that vanishes
        before = approach(time.double().numpy())
        rates = specimen.effects.rows("swelling", specimen.points, time.double())
        if bool((rates * before >= 1).any()):
            fast = (
                f"swelling is {rates.max().item():g} 1/s; {before:g} s before the first row, where the path begins, nothing of the specimen"
            )
            raise UserError(f"{fast} would be there: give a smaller rate, or rows that are closer in time")
    if not step > 0:
        raise UserError(f"step = {step} must be positive")


def _solved(rig: Rig, time: Tensor | None, step: float, periodic: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return strains and Kirchhoff stress of all rows, (P, n, 4) each, by the engine that serves."""
    specimen = rig.specimen
    with torch.no_grad(), np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        probe = specimen.law()
        timed = any(getattr(specimen.effects, name) is not None for name in RATES)
        if not timed and not probe.remembers and probe.plasticity is None:
            return rig.rows_alone(TensorEngine(rig))
        engine = PlaneEngine(rig) if PlaneEngine.serves(specimen) else TensorEngine(rig)
        return rig.along(engine, None if time is None else time.double().numpy(), step, periodic=periodic)


def _finite(out: np.ndarray) -> Tensor:
    """Return values (P, n, m) with NaN throughout a parameter set that has one."""
    out = np.array(out)
    out[~np.isfinite(out).all((-1, -2))] = np.nan
    return torch.from_numpy(out)


def _axis(direction: Vector) -> np.ndarray:
    return np.asarray(direction, dtype=np.float64)
