"""A specimen in a testing machine: what is prescribed, what is free, and the path that follows, row by row.

The machine prescribes stretches or shear, or the stress along the loading axis (creep). The other stretches follow from zero lateral
stress by Newton's method. Two engines compute the stress: `plane_engine`, a kernel, where the law is isotropic, and `PointLaw` otherwise.
"""

from typing import Any, Protocol

import numpy as np
import torch

from neuido.physics.points.point_law import PointHistory, PointLaw
from neuido.physics.points.specimen import Specimen, is_classical

PROBE = 1e-6
"""Step of a logarithmic stretch in the finite differences of the lateral stress [-]."""
TOLERANCE = 1e-9
"""Stress that counts as zero, relative to the larger of P-wave modulus and axial stress [-]."""
ITERATIONS = 60
"""Largest number of Newton iterations."""
LARGEST_MOVE = 0.2
"""Largest change of a logarithmic stretch in one iteration [-]."""
CYCLES = 12
"""Largest number of periods before a path counts as periodic."""
SETTLED = 1e-3
"""Change of the stress from one period to the next that counts as none, relative to the largest stress [-]."""

State = list[np.ndarray]


class Engine(Protocol):
    """The strains and the stress of P parameter sets along a path, with their state, which begins at rest."""

    def follow(self, gaps: np.ndarray, timed: bool, now: float, step: float) -> tuple[np.ndarray, np.ndarray]:
        """Go through all rows of the path, and keep the state at its end.

        Args:
            gaps: Time before each row [s], (n,).
            timed: Whether the rate counts.
            now: Time at the start [s].
            step: Largest increment of a logarithmic stretch in one step [-].

        Returns:
            Strains (logarithms of the three stretches, amount of shear) and Kirchhoff stress t1, t2, t3, t12 [Pa] in the axes of the
            specimen, (P, n, 4) each. The stress is NaN where it does not converge.
        """


class Rig:
    """A specimen in a machine.

    Args:
        specimen: The laws and effects.
        mode: One of `MODES`.
        path: What the machine prescribes: stretches or shear, (n, w), or the stress [Pa], (n, 1), where `by_stress`.
        direction: Direction of axis 1 in the axes of the material, (3,).
        true_stress: Whether the measured stress is the Cauchy stress.
        by_stress: Whether the machine prescribes the stress.

    The unknowns u (..., k) are the logarithms of the free stretches; where the stress is prescribed, the first one is that of the loading
    axis, or the shear. Axes 2 and 3 share one unknown if symmetry makes them equal.
    """

    def __init__(
        self, specimen: Specimen, mode: str, path: np.ndarray, direction: np.ndarray, *, true_stress: bool, by_stress: bool = False
    ) -> None:
        self.specimen, self.mode, self.true_stress = specimen, mode, true_stress
        self.shear, self.lead = mode == "simple_shear", int(by_stress)
        self.path = path if self.shear or by_stress else np.log(path)
        self.direction = direction
        classical = is_classical(specimen.elasticity)
        self.symmetric = mode == "uniaxial" and classical and specimen.effects.fibre is None
        free = 0 if self.shear else 2 if mode == "uniaxial" and not self.symmetric else 1
        if specimen.incompressible:
            free = 1 if mode == "uniaxial" and not self.symmetric else 0
        self.free = free
        self.unknowns = free + self.lead
        self.scale = specimen.elasticity.modulus().double().detach().expand(specimen.points).numpy()

    def strains(self, given: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Return the logarithms of the three stretches and the shear, (..., 4), from what is prescribed (..., w) and unknown (..., k)."""
        first = u[..., 0] if self.lead else given[..., 0]
        u, zero = u[..., self.lead :], np.zeros_like(first)
        if self.shear:
            return np.stack([zero, zero, zero, first], -1)
        if self.mode == "uniaxial":
            if self.specimen.incompressible:
                split = zero if self.symmetric else u[..., 0]
                return np.stack([first, split - first / 2, -split - first / 2, zero], -1)
            return np.stack([first, u[..., 0], u[..., -1], zero], -1)
        second = {"equibiaxial": first, "pure_shear": zero, "biaxial": given[..., -1]}[self.mode]
        return np.stack([first, second, -first - second if self.specimen.incompressible else u[..., 0], zero], -1)

    def measured(self, t: np.ndarray, e: np.ndarray) -> np.ndarray:
        """Return the stress that the machine measures [Pa], (..., m), from the Kirchhoff stress t (..., 4) and the strains e (..., 4)."""
        if self.shear:
            return t[..., 3:]  # J = 1, and F^-T leaves the component as it is
        s = t[..., :3] - t[..., 2:3] if self.specimen.incompressible else t[..., :3]
        e = e[..., :3]
        s = s * np.exp(-e.sum(-1, keepdims=True) if self.true_stress else -e)
        if self.mode == "equibiaxial":
            return s[..., :2].mean(-1, keepdims=True)
        return s[..., :2] if self.mode == "biaxial" else s[..., :1]

    def residual(self, t: np.ndarray, e: np.ndarray, given: np.ndarray) -> np.ndarray:
        """Return the stress that must vanish [Pa], (..., k)."""
        if self.free == 0:
            lateral = t[..., :0]
        elif self.mode == "uniaxial" and not self.symmetric:
            lateral = t[..., 1:2] - t[..., 2:3] if self.specimen.incompressible else t[..., 1:3]
        else:
            lateral = t[..., 2:3]
        return np.concatenate([self.measured(t, e) - given, lateral], axis=-1) if self.lead else lateral

    def guess(self, given: np.ndarray) -> np.ndarray:
        """Return initial values of the unknowns, (..., k): those of a stretch at constant volume."""
        out = np.zeros((*given.shape[:-1], self.unknowns))
        if self.lead:
            out[..., 0] = given[..., 0] / self.scale[:, None] if given.ndim == 3 else given[..., 0] / self.scale
        elif self.mode == "uniaxial" and not self.specimen.incompressible:
            out += -given[..., :1] / 2
        elif self.free and not self.specimen.incompressible:
            out += -{"equibiaxial": 2.0}.get(self.mode, 1.0) * given.sum(-1, keepdims=True)
        return out

    def solve(self, u: np.ndarray, given: np.ndarray, evaluate: Any, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, Any]:
        """Solve for the unknowns by Newton's method, with the derivatives by finite differences in one evaluation.

        Args:
            u: Initial values, (..., k).
            given: What is prescribed, (..., w).
            evaluate: Maps strains (..., 1 + k, 4) to Kirchhoff stresses (..., 1 + k, 4) and further results.
            scale: P-wave modulus [Pa], (...).

        Returns:
            The unknowns, the strains (..., 4), the stress (..., 4) with NaN where the iteration did not converge, the further results.
        """
        k = self.unknowns
        probes = np.concatenate([np.zeros((1, k)), PROBE * np.eye(k)])
        each = given[..., None, :]
        off = np.zeros(u.shape[:-1], bool)
        for _ in range(ITERATIONS if k else 1):
            e = self.strains(np.broadcast_to(each, (*u.shape[:-1], 1 + k, given.shape[-1])), u[..., None, :] + probes)
            t, more = evaluate(e)
            if not k:
                break
            r = self.residual(t, e, each)
            here = r[..., 0, :]
            largest = np.abs(t[..., 0, :]).max(-1)
            off = ~(np.abs(here).max(-1) <= TOLERANCE * np.maximum(scale, largest))
            if not off.any():
                break
            J = np.swapaxes((r[..., 1:, :] - r[..., :1, :]) / PROBE, -1, -2)
            size = scale[..., None, None]
            wrong = ~np.isfinite(J).all((-1, -2))
            J = np.where(wrong[..., None, None], size * np.eye(k), J)
            singular = np.abs(np.linalg.det(J / size)) < 1e-12
            J = np.where(singular[..., None, None], size * np.eye(k), J)
            move = np.linalg.solve(J, here[..., None])[..., 0]
            able = off & np.isfinite(move).all(-1)
            u = np.where(able[..., None], u - np.clip(move, -LARGEST_MOVE, LARGEST_MOVE), u)
        return u, e[..., 0, :], np.where(off[..., None], np.nan, t[..., 0, :]), more

    def rows_alone(self, engine: "TensorEngine") -> tuple[np.ndarray, np.ndarray]:
        """Return strains and Kirchhoff stress of every row, (P, n, 4) each, each row on its own."""
        P, n = self.specimen.points, len(self.path)
        given = np.broadcast_to(self.path, (P, n, self.path.shape[1]))
        law = engine.law(n * (1 + self.unknowns))
        _, e, t, _ = self.solve(self.guess(given), given, lambda e: (engine.static(law, e), None), np.repeat(self.scale[:, None], n, 1))
        return e, t

    def along(self, engine: Engine, time: np.ndarray | None, step: float, *, periodic: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Return strains and Kirchhoff stress of every row, (P, n, 4) each, one row after the other, with the history."""
        n = len(self.path)
        times = np.arange(n + 1.0) if time is None else np.concatenate([[time[0] - approach(time)], time]) - time[0]
        gaps, before = np.diff(times), None
        for cycle in range(CYCLES if periodic else 1):
            if cycle:
                gaps = np.concatenate([gaps[-1:], gaps[1:]])  # the first row follows the last one
            es, ts = engine.follow(gaps, time is not None, float(times[0]) if not cycle else 0.0, step)
            if before is not None and np.nanmax(np.abs(ts - before), initial=0.0) < SETTLED * np.nanmax(np.abs(ts), initial=0.0):
                break
            before = ts
        return es, ts

    def pieces(self, path: np.ndarray, step: float) -> np.ndarray:
        """Return the number of steps between neighbouring rows of a path (n, w), (n - 1,)."""
        size = np.abs(np.diff(path, axis=0)).max(1) / (self.scale.min() if self.lead else 1.0)
        return np.maximum(np.ceil(size / step - 1e-9), 1).astype(np.int32)


class TensorEngine:
    """The stress by `PointLaw`, for any law, effect and mode; one law for `copies` states per parameter set."""

    def __init__(self, rig: Rig) -> None:
        self.rig, self.specimen, self.shear, self.copies = rig, rig.specimen, rig.shear, 1 + rig.unknowns
        self.R = turn(torch.from_numpy(rig.direction))
        self.material = self.law(self.copies)
        P = self.specimen.points
        # the state, the unknowns, their change per change of the path, and the last row
        self.state: list = [self.start(), np.zeros((P, rig.unknowns)), np.zeros((P, rig.unknowns)), np.zeros(rig.path.shape[1])]

    def follow(self, gaps: np.ndarray, timed: bool, now: float, step: float) -> tuple[np.ndarray, np.ndarray]:
        """Go through all rows of the path; see `Engine`."""
        path = self.rig.path
        es, ts = [], []
        for given, dt, pieces in zip(path, gaps, self.rig.pieces(np.concatenate([self.state[3][None], path]), step), strict=True):
            e, t = self._to(given, float(dt) if timed else None, now, int(pieces))
            now += float(dt)
            es.append(e)
            ts.append(t)
        return np.stack(es, 1), np.stack(ts, 1)

    def _to(self, given: np.ndarray, dt: float | None, now: float, pieces: int) -> tuple[np.ndarray, np.ndarray]:
        """Go on to a row in some number of steps."""
        rig, (begun, u, ratio, last) = self.rig, self.state
        jump = (given - last) / pieces
        part = 1.0 if dt is None else dt / pieces
        for piece in range(pieces):
            at = np.broadcast_to(last + jump * (piece + 1), (self.specimen.points, len(given)))
            when = 0.0 if dt is None else now + part * piece
            first = u
            u, e, t, after = rig.solve(
                u + ratio * jump[0], at, lambda e, begun=begun, when=when: self.advance(begun, e, part, when), rig.scale
            )
            if abs(jump[0]) > 0 and not rig.lead:
                slope = (u - first) / jump[0]
                ratio = np.where(np.isfinite(slope), np.clip(slope, -2, 2), ratio)
            begun = [own[:: 1 + rig.unknowns] for own in after]
        self.state[:] = begun, u, ratio, given
        return e, t

    def law(self, each: int) -> PointLaw:
        """Return the law for `each` particles per parameter set; those of one set are consecutive."""
        return self.specimen.law(each)

    def gradient(self, e: np.ndarray) -> torch.Tensor:
        """Return F in the axes of the specimen, (..., 3, 3), from strains (..., 4)."""
        e = torch.from_numpy(np.ascontiguousarray(e))
        F = torch.diag_embed(e[..., :3].exp())
        F[..., 0, 1] = e[..., 3]
        return F

    def seen(self, tau: torch.Tensor, shape: tuple[int, ...]) -> np.ndarray:
        """Return t1, t2, t3, t12 in the axes of the specimen, (*shape, 4), from tau (..., 3, 3) in those of the material."""
        tau = self.R.mT @ tau @ self.R
        return torch.cat([tau.diagonal(dim1=-2, dim2=-1), tau[..., 0, 1:2]], -1).reshape(*shape, 4).numpy()

    def static(self, law: PointLaw, e: np.ndarray) -> np.ndarray:
        """Return the stress without a history, (..., 4), at strains (..., 4)."""
        F = (self.R @ self.gradient(e) @ self.R.mT).reshape(-1, 3, 3)
        return self.seen(law.stress(F, torch.zeros_like(F), law.start()), e.shape[:-1])

    def start(self) -> State:
        """Return the state at rest; every array has P rows."""
        P = self.specimen.points
        eye = np.broadcast_to(np.eye(3), (P, 3, 3))
        own = [part.reshape(P, self.copies, *part.shape[1:])[:, 0].numpy() for part in self.material.start()]
        return [eye, eye, *own]  # F in all, the elastic F, and the history

    def advance(self, begun: State, total: np.ndarray, dt: float, now: float) -> tuple[np.ndarray, State]:
        """Return the Kirchhoff stress after a step, (P, c, 4) [Pa], and the states, (P * c, ...).

        `total` (P, c, 4) holds the strains that are reached in a time `dt` [s].
        """
        whole, F, *own = (torch.from_numpy(np.repeat(part, self.copies, 0)) for part in begun)
        new = self.gradient(total).reshape(-1, 3, 3)
        increment = new @ torch.linalg.inv(whole)
        if self.shear:
            log = increment - torch.eye(3, dtype=increment.dtype)
        else:
            log = torch.diag_embed(increment.diagonal(dim1=-2, dim2=-1).log())
        C = self.R @ (log / dt) @ self.R.mT
        trial = self.R @ increment @ self.R.mT @ F
        F, after = self.material.advance(trial, C, PointHistory(*own), dt, now)
        t = self.seen(self.material.stress(F, C, after, now + dt), total.shape[:-1])
        return t, [new.numpy(), F.numpy(), *(part.numpy() for part in after)]


def approach(time: np.ndarray) -> float:
    """Return the time in which the undeformed specimen reaches the first row [s]: the first interval, or 1 s for a single row."""
    return float(time[1] - time[0]) if len(time) > 1 else 1.0


def turn(direction: torch.Tensor) -> torch.Tensor:
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
