"""The material point: the stress of a law with effects along a measured path, in a uniformly deformed specimen.

The machine prescribes some principal stretches, or an amount of shear, along the axes of the specimen. The other stretches follow from
zero lateral stress by Newton's method; in an incompressible specimen the pressure makes the lateral stress zero. Shear stresses, which an
oblique fibre causes, are carried by the grips, so that F stays diagonal. Many parameter sets run as one batch.
"""

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from neuido.errors import UserError
from neuido.physics.effects.constitutive import Constitutive, History
from neuido.physics.effects.parameters import Effects
from neuido.physics.laws.base import ElasticLaw, PlasticLaw
from neuido.physics.laws.classical import FixedCorotated, NeoHookean, Sigma, StackedElastic
from neuido.types import Particles, Vector, brief_fields

MODES = ("uniaxial", "equibiaxial", "pure_shear", "biaxial", "simple_shear")
"""Kinds of material test; `stress_along` describes each."""
PROBE = 1e-6
"""Step of a logarithmic stretch in the finite differences of the lateral stress [-]."""
TOLERANCE = 1e-9
"""Lateral stress that counts as zero, relative to the larger of P-wave modulus and axial stress [-]."""
ITERATIONS = 60
"""Largest number of Newton iterations."""
RATES = ("viscosity_shear", "viscosity_bulk", "maxwell_ratio", "hysteresis", "rate_yield", "stiffness_change", "swelling")
"""Effects that depend on the rate or on time, and therefore need the times of the path."""


class Specimen(NamedTuple):
    """A law with effects for P parameter sets."""

    elasticity: ElasticLaw
    """Elastic law."""
    plasticity: PlasticLaw | None
    """Plastic law; None: purely elastic."""
    effects: Effects
    """Effects beyond the laws; those that are forces are ignored."""
    points: int
    """Number of parameter sets P; each parameter of the laws and effects has one row for all, or P rows."""
    incompressible: bool = False
    """Whether the volume is constant, and the pressure such that the lateral stress is zero."""

    def __repr__(self) -> str:
        return brief_fields(self)


def stress_along(
    specimen: Specimen,
    mode: str,
    path: Tensor,
    *,
    direction: Vector = (1.0, 0.0, 0.0),
    time: Tensor | None = None,
    true_stress: bool = False,
    step: float = 0.1,
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

    Returns:
        Stress [Pa], (P, n, 1), or (P, n, 2) for `biaxial`. A parameter set without lateral equilibrium or finite stress is all NaN.

    Raises:
        UserError: An unknown mode, a path of a wrong shape or with a stretch that is not positive, a rate effect without times, or
            swelling of an incompressible specimen or from less than nothing.
    """
    if mode not in MODES:
        raise UserError(f"mode = {mode!r} is not known; one of {', '.join(MODES)}")
    width = 2 if mode == "biaxial" else 1
    if path.ndim != 2 or path.shape[1] != width or len(path) < 1:
        raise UserError(f"path has shape {tuple(path.shape)}; {mode} takes (n, {width})")
    if mode != "simple_shear" and not bool((path > 0).all()):
        raise UserError(f"path has a stretch of {path.min().item():g}; stretches must be positive")
    if time is not None and (len(time) != len(path) or bool((time.diff() <= 0).any())):
        raise UserError(f"time must increase and have {len(path)} values, one per row of path; got {len(time)}")
    timed = [name for name in RATES if getattr(specimen.effects, name) is not None]
    if timed and time is None:
        raise UserError(f"{timed[0]} depends on the rate: give the times of the path")
    if specimen.incompressible and specimen.effects.swelling is not None:
        raise UserError("swelling changes the volume: leave it out, or declare the specimen as compressible")
    if time is not None:
        specimen.effects.stress_free_size((time[-1:] - time[0]).double().expand(specimen.points), 1)  # refuses one that vanishes
        before = float(_approach(time))
        rates = specimen.effects.rows("swelling", specimen.points, time.double())
        if bool((rates * before >= 1).any()):
            fast = (
                f"swelling is {rates.max().item():g} 1/s; {before:g} s before the first row, where the path begins, nothing of the specimen"
            )
            raise UserError(f"{fast} would be there: give a smaller rate, or rows that are closer in time")
    if not step > 0:
        raise UserError(f"step = {step} must be positive")
    with torch.no_grad():
        rig = _Rig(specimen, mode, path.double(), torch.tensor(direction, dtype=torch.float64))
        tau, lateral = rig.solve_rows() if rig.history_free else rig.solve_path(None if time is None else time.double(), step)
        out = rig.measured(tau, lateral, true_stress)
        bad = ~torch.isfinite(out).all(dim=2).all(dim=1)
        out[bad] = torch.nan
    return out


class _Rig:
    """A specimen in a machine: the prescribed stretches or shear, and the equations for the free stretches.

    The unknowns u (..., k) are the logarithms of the k free stretches. Axes 2 and 3 share one unknown if symmetry makes them equal.
    """

    def __init__(self, specimen: Specimen, mode: str, path: Tensor, direction: Tensor) -> None:
        self.specimen, self.mode = specimen, mode
        self.path = path if mode == "simple_shear" else path.log()
        self.R = turn(direction)
        classical = isinstance(specimen.elasticity, (FixedCorotated, Sigma, NeoHookean, StackedElastic))
        self.symmetric = mode == "uniaxial" and classical and specimen.effects.fibre is None
        free = 0 if mode == "simple_shear" else 2 if mode == "uniaxial" and not self.symmetric else 1
        if specimen.incompressible:
            free = 1 if mode == "uniaxial" and not self.symmetric else 0
        self.free = free
        self.scale = specimen.elasticity.modulus().double().detach().expand(specimen.points)
        probe = Constitutive(specimen.elasticity, specimen.plasticity, specimen.effects, count=specimen.points)
        self.history_free = (
            probe.plasticity is None
            and probe.tables.flow is None
            and probe.tables.layout.width == 0
            and not any(getattr(specimen.effects, name) is not None for name in RATES)
        )

    def material(self, each: int) -> Constitutive:
        """Return the law for `each` particles per parameter set; those of one set are consecutive."""
        P = self.specimen.points
        particles = Particles(torch.arange(P, dtype=torch.int32).repeat_interleave(each), tuple(range(0, P * each + 1, each)))
        s = self.specimen
        return Constitutive(s.elasticity, s.plasticity, s.effects, count=P * each, particles=particles)

    def log_stretches(self, given: Tensor, u: Tensor) -> Tensor:
        """Return the logarithms of the three stretches, (..., 3), from the prescribed ones (..., w) and the unknowns (..., k)."""
        first = given[..., 0]
        if self.mode == "uniaxial":
            if self.specimen.incompressible:
                split = torch.zeros_like(first) if self.symmetric else u[..., 0]
                return torch.stack([first, split - first / 2, -split - first / 2], -1)
            return torch.stack([first, u[..., 0], u[..., -1]], -1)
        second = {"equibiaxial": first, "pure_shear": torch.zeros_like(first), "biaxial": given[..., -1]}[self.mode]
        return torch.stack([first, second, -first - second if self.specimen.incompressible else u[..., 0]], -1)

    def gradient(self, given: Tensor, u: Tensor) -> Tensor:
        """Return F in the axes of the specimen, (..., 3, 3)."""
        if self.mode == "simple_shear":
            F = torch.eye(3, dtype=given.dtype).repeat(*given.shape[:-1], 1, 1)
            F[..., 0, 1] = given[..., 0]
            return F
        return torch.diag_embed(self.log_stretches(given, u).exp())

    def residual(self, tau: Tensor) -> Tensor:
        """Return the lateral stress that must vanish [Pa], (..., k), from tau (..., 3, 3) in the axes of the specimen."""
        t = tau.diagonal(dim1=-2, dim2=-1)
        if self.mode == "uniaxial" and not self.symmetric:
            return t[..., 1:2] - t[..., 2:] if self.specimen.incompressible else t[..., 1:]
        return t[..., 2:][..., : self.free]

    def to_material_axes(self, A: Tensor) -> Tensor:
        """Convert a tensor from the axes of the specimen to those of the material."""
        return self.R @ A @ self.R.mT

    def to_specimen_axes(self, A: Tensor) -> Tensor:
        """Convert a tensor from the axes of the material to those of the specimen."""
        return self.R.mT @ A @ self.R

    def guess(self, given: Tensor) -> Tensor:
        """Return initial values of the unknowns, (..., k): those of a stretch at constant volume."""
        if self.mode == "uniaxial" and not self.specimen.incompressible:
            return (-given[..., :1] / 2).expand(*given.shape[:-1], self.free).clone()
        volume = {"pure_shear": 1.0, "equibiaxial": 2.0}.get(self.mode, 1.0) * given.sum(-1, keepdim=True)
        zero = self.specimen.incompressible or self.mode == "simple_shear"
        return torch.zeros(*given.shape[:-1], self.free, dtype=given.dtype) if zero else -volume[..., : self.free]

    def solve(self, u: Tensor, evaluate, scale: Tensor) -> tuple[Tensor, Tensor, Any]:
        """Solve for the unknowns by Newton's method, with the derivatives by finite differences in one evaluation.

        Args:
            u: Initial values, (..., k).
            evaluate: Maps unknowns (..., 1 + k, k) to tau (..., 1 + k, 3, 3) and further results.
            scale: P-wave modulus [Pa], (...).

        Returns:
            The unknowns, tau (..., 3, 3) with NaN where the iteration did not converge, and the further results of `evaluate`.
        """
        k = self.free
        probes = torch.cat([torch.zeros(1, k, dtype=u.dtype), PROBE * torch.eye(k, dtype=u.dtype)])
        for _ in range(ITERATIONS if k else 1):
            tau, more = evaluate(u.unsqueeze(-2) + probes)
            r = self.residual(tau)
            here = r[..., 0, :]
            largest = tau[..., 0, :, :].diagonal(dim1=-2, dim2=-1).abs().amax(-1)
            off = here.abs().amax(-1) > TOLERANCE * torch.maximum(scale, largest) if k else torch.zeros(u.shape[:-1], dtype=torch.bool)
            if not bool(off.any()):
                break
            J = ((r[..., 1:, :] - r[..., :1, :]) / PROBE).mT
            singular = ~torch.isfinite(J).all(-1).all(-1) | (torch.linalg.det(J).abs() < 1e-12 * scale**k)
            J = torch.where(singular[..., None, None], scale[..., None, None] * torch.eye(k, dtype=u.dtype), J)
            move = torch.linalg.solve(J, here)
            u = torch.where((off & torch.isfinite(move).all(-1)).unsqueeze(-1), u - move.clamp(-0.2, 0.2), u)
        tau = torch.where(off[..., None, None], torch.nan, tau[..., 0, :, :])
        return u, tau, more

    def solve_rows(self) -> tuple[Tensor, Tensor]:
        """Compute tau (P, n, 3, 3) and the unknowns (P, n, k), each row on its own."""
        P, n, copies = self.specimen.points, len(self.path), 1 + self.free
        material = self.material(n * copies)
        history = material.start()
        still = torch.zeros(P * n * copies, 3, 3, dtype=torch.float64)
        given = self.path.expand(P, n, -1)

        def evaluate(u: Tensor) -> tuple[Tensor, None]:
            F = self.to_material_axes(self.gradient(given.unsqueeze(-2).expand(P, n, copies, -1), u))
            tau = material.stress(F.reshape(-1, 3, 3), still, history)
            return self.to_specimen_axes(tau.reshape(P, n, copies, 3, 3)), None

        u, tau, _ = self.solve(self.guess(given), evaluate, self.scale[:, None].expand(P, n))
        return tau, u

    def solve_path(self, time: Tensor | None, step: float) -> tuple[Tensor, Tensor]:
        """Compute the same as `solve_rows`, one row after the other, with the history."""
        P, n, copies = self.specimen.points, len(self.path), 1 + self.free
        material = self.material(copies)
        start = torch.zeros(1, self.path.shape[1], dtype=torch.float64)
        path = torch.cat([start, self.path])
        if time is not None:
            time = torch.cat([(time[0] - _approach(time))[None], time]) - time[0]
        u = torch.zeros(P, self.free, dtype=torch.float64)
        ratio = torch.zeros(P, self.free, dtype=torch.float64)
        whole = torch.eye(3, dtype=torch.float64).expand(P, 3, 3)  # total F in the axes of the specimen
        F = torch.eye(3, dtype=torch.float64).repeat(P, 1, 1)  # elastic F in the axes of the material
        history = History(*(part.reshape(P, copies, *part.shape[1:])[:, 0] for part in material.start()))
        taus, us = [], []
        for i in range(n):
            jump = path[i + 1] - path[i]
            pieces = max(math.ceil(float(jump.abs().max()) / step - 1e-9), 1)
            dt = 1.0 if time is None else float(time[i + 1] - time[i]) / pieces
            for piece in range(pieces):
                given = path[i] + jump * ((piece + 1) / pieces)
                now = 0.0 if time is None else float(time[i]) + dt * piece
                inverse = torch.linalg.inv(whole)
                begun = History(*(part.repeat_interleave(copies, 0) for part in history))

                def evaluate(unknown: Tensor, given=given, inverse=inverse, begun=begun, now=now, dt=dt, F=F):
                    total = self.gradient(given.expand(P, copies, -1), unknown)
                    increment = total @ inverse[:, None]
                    C = self.to_material_axes(_log(increment, self.mode) / dt).reshape(-1, 3, 3)
                    trial = (self.to_material_axes(increment) @ F[:, None]).reshape(-1, 3, 3)
                    corrected, after = material.advance(trial, C, begun, dt, now)
                    tau = self.to_specimen_axes(material.stress(corrected, C, after, now + dt).reshape(P, copies, 3, 3))
                    return tau, (total, corrected, after)

                ahead = u + ratio * (jump[0] / pieces)
                before = u
                u, tau, (total, corrected, after) = self.solve(ahead, evaluate, self.scale)
                if float(jump[0].abs()) > 0:
                    slope = (u - before) / (jump[0] / pieces)
                    ratio = torch.where(torch.isfinite(slope), slope.clamp(-2, 2), ratio)
                whole = total[:, 0]
                F = corrected.reshape(P, copies, 3, 3)[:, 0]
                history = History(*(part.reshape(P, copies, *part.shape[1:])[:, 0] for part in after))
            taus.append(tau)
            us.append(u)
        return torch.stack(taus, 1), torch.stack(us, 1)

    def measured(self, tau: Tensor, u: Tensor, true_stress: bool) -> Tensor:
        """Return the stress that the machine measures [Pa], (P, n, m), from tau (P, n, 3, 3) and the unknowns (P, n, k)."""
        if self.mode == "simple_shear":
            return tau[..., 0, 1:2]  # J = 1, and F^-T leaves the component as it is
        e = self.log_stretches(self.path.expand(*tau.shape[:2], -1), u)
        t = tau.diagonal(dim1=-2, dim2=-1)
        if self.specimen.incompressible:
            t = t - t[..., 2:]
        t = t * torch.exp(-e.sum(-1, keepdim=True) if true_stress else -e)
        if self.mode == "equibiaxial":
            return t[..., :2].mean(-1, keepdim=True)
        return t[..., :2] if self.mode == "biaxial" else t[..., :1]


def _approach(time: Tensor) -> Tensor:
    """Return the time in which the undeformed specimen reaches the first row [s]: the first interval, or 1 s for a single row."""
    return time[1] - time[0] if len(time) > 1 else torch.ones((), dtype=torch.float64)


def _log(increment: Tensor, mode: str) -> Tensor:
    """Return the logarithm of an increment of F that is diagonal or, in simple shear, I + gamma e1 e2^T, (..., 3, 3)."""
    if mode == "simple_shear":
        return increment - torch.eye(3, dtype=increment.dtype)
    return torch.diag_embed(increment.diagonal(dim1=-2, dim2=-1).log())


def turn(direction: Tensor) -> Tensor:
    """Return the smallest rotation that takes the first axis to `direction` (3,).

    For the opposite direction it is half a turn about the third axis.
    """
    d = direction / direction.norm()
    if d[0] < -1 + 1e-12:
        return torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=d.dtype))
    w = torch.stack([torch.zeros_like(d[0]), -d[2], d[1]])  # e1 x d
    W = torch.zeros(3, 3, dtype=d.dtype)
    W[0, 1], W[0, 2], W[1, 2] = -w[2], w[1], -w[0]
    W = W - W.mT
    return torch.eye(3, dtype=d.dtype) + W + W @ W / (1 + d[0])
