"""Events of a rollout: matter that turned inside out or collapsed, and laws asked beyond the strains of their training.

Kernels note, for each particle or element, the smallest det F below `COLLAPSED` and the step in which it was first below. That is one
determinant a substep, written only where there is an event; nothing is synchronised before somebody asks for the events.
"""

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from neuido.errors import UserError

COLLAPSED = 1e-3
"""det F below which matter counts as collapsed."""
FLAT = 1e-6
"""Size of det F up to which its sign may be rounding: matter is crushed flat, and beyond it turned inside out."""
INVERTED, CRUSHED, OUTSIDE = "inverted", "collapsed", "outside training"
OnInversion = Literal["report", "error"]
CHUNK = 1 << 20
"""Deformation gradients that are looked at in one go."""


class Event(NamedTuple):
    """Something that happened in one scene of a rollout and makes its result doubtful."""

    kind: str
    """`inverted`: det F below zero. `collapsed`: det F below 0.001. `outside training`: a law was asked beyond the strains it knows."""
    scene: int
    """Index of the scene."""
    count: int
    """How many particles (or elements) it happened to."""
    total: int
    """How many the scene has."""
    first: int
    """Index of the first of them within the whole rollout."""
    step: int
    """Step at whose end it was first seen; 0: at the start."""
    time: float
    """That time [s]."""
    frame: int
    """First frame at or after that time."""
    extreme: float
    """Smallest det F, or largest absolute logarithmic stretch, that was seen."""
    what: str = "particles"
    """`particles` or `elements`."""

    def __str__(self) -> str:
        plain = {
            INVERTED: "turned inside out",
            CRUSHED: f"collapsed (det F below {COLLAPSED:g})",
            OUTSIDE: "strained beyond the law's training",
        }
        least = f"largest logarithmic stretch {self.extreme:.3g}" if self.kind == OUTSIDE else f"smallest det F {self.extreme:.3g}"
        return (f"scene {self.scene}: {self.count} of {self.total} {self.what} {plain[self.kind]}, "
                f"the first ({self.what[:-1]} {self.first}) at {self.time:.4g} s; {least}")  # fmt: skip


class Marks(NamedTuple):
    """What the kernels noted of each particle or element."""

    lowest: Tensor
    """Smallest det F below `COLLAPSED`, (N,); infinite where there was none."""
    since: Tensor
    """Step, counted from 0, in which it was first below, (N,) int32; -1 where it never was."""
    scene: Tensor
    """Scene of each, (N,)."""
    dt: tuple[float, ...]
    """Step of each scene [s]."""
    every: tuple[int, ...]
    """Steps between two frames of each scene."""
    what: str = "particles"

    def events(self) -> list[Event]:
        """Return the events of each scene, inversions first."""
        found = self.since >= 0
        if not bool(found.any()):
            return []
        out = []
        for kind, seen in ((INVERTED, found & (self.lowest < -FLAT)), (CRUSHED, found & (self.lowest >= -FLAT))):
            for s in torch.unique(self.scene[seen]).tolist():
                own = ((self.scene == s) & seen).nonzero()[:, 0]
                steps = self.since[own]
                at = int(steps.argmin())
                step = int(steps[at]) + 1
                out.append(Event(kind, s, len(own), int((self.scene == s).sum()), int(own[at]), step, step * self.dt[s],
                                 math.ceil(step / self.every[s]), float(self.lowest[own].min()), self.what))  # fmt: skip
        return out


def checked_option(value: str) -> str:
    """Return the value of `on_inversion`.

    Raises:
        UserError: Neither `report` nor `error`.
    """
    if value not in ("report", "error"):
        raise UserError(f"on_inversion is {value!r}; choose report or error")
    return value


def raise_inversions(marks: Marks) -> None:
    """Raise UserError for the first event, if there is one."""
    found = sorted(marks.events(), key=lambda event: event.time)
    if found:
        more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
        raise UserError(f"{found[0]}{more}; lower dt, the speed of the impact or the load, or take neo_hookean or sigma, which do not "
                        "collapse; on_inversion = report goes on")  # fmt: skip


class Notes:
    """The marks of a rollout that runs in parts: one after the other, or scene by scene."""

    def __init__(self, count: int, like: Tensor) -> None:
        self.lowest = torch.full((count,), math.inf, dtype=like.dtype, device=like.device)
        self.since = torch.full((count,), -1, dtype=torch.int32, device=like.device)

    def add(self, lowest: Tensor, since: Tensor, begin: int = 0, start: int = 0) -> None:
        """Add the marks of a part, on the device, without synchronisation.

        Args:
            lowest: As in `Marks`, of the particles from `begin` on.
            since: Likewise, counted from the first step of the part.
            begin: First particle of the part.
            start: First step of the part.
        """
        own = slice(begin, begin + len(since))
        fresh = (self.since[own] < 0) & (since >= 0)
        self.since[own] = torch.where(fresh, since + start, self.since[own])
        self.lowest[own] = torch.minimum(self.lowest[own], lowest)


def marks_of_frames(F: Tensor, scene: Tensor, dt: Sequence[float]) -> Marks:
    """Return the marks of recorded frames F (K, P, 3, 3), where no kernel noted any; a step is the time between two frames."""
    lowest = F.new_full((F.shape[1],), math.inf)
    since = torch.full((F.shape[1],), -1, dtype=torch.int32, device=F.device)
    for k, frame in enumerate(F.detach()):
        J = determinant(frame)
        low = J < COLLAPSED
        since = torch.where(low & (since < 0), k - 1, since)
        lowest = torch.where(low, torch.minimum(lowest, J), lowest)
    # frame 0 is step -1 here, which would read as never
    since = torch.where(torch.isfinite(lowest) & (since < 0), 0, since)
    return Marks(lowest, since, scene, tuple(dt), (1,) * len(dt))


def determinant(F: Tensor) -> Tensor:
    """Return det F of (..., 3, 3) by cofactors, which is faster than a factorisation of each."""
    a, b, c = F.unbind(-1)
    return (a * torch.linalg.cross(b, c)).sum(-1)


def outside(F: Tensor, limit: float, scene: Tensor, dt: Sequence[float]) -> list[Event]:
    """Return where the logarithmic stretches of frames F (K, P, 3, 3) are beyond `limit`, an event for each scene."""
    K, P = F.shape[:2]
    F = F.detach()
    largest, since = F.new_zeros(P), torch.full((P,), -1, dtype=torch.long, device=F.device)
    near = 1 - math.exp(-2 * limit)
    eye = torch.eye(3, dtype=F.dtype, device=F.device)
    for k in range(K):
        b = F[k] @ F[k].mT
        far = ((b - eye).square().sum((-2, -1)) > near**2) & torch.isfinite(b).all(-1).all(-1)  # |b_i - 1| is no larger than this norm
        index = far.nonzero()[:, 0]
        for part in index.split(CHUNK):
            stretch = 0.5 * torch.linalg.eigvalsh(b[part].double()).clamp(min=1e-30).log().abs().amax(-1)
            stretch = torch.where(determinant(F[k, part]) > 0, stretch, math.inf).to(F.dtype)
            beyond = part[stretch > limit]
            since[beyond] = torch.where(since[beyond] < 0, k, since[beyond])
            largest[part] = torch.maximum(largest[part], stretch)
    out = []
    for s in torch.unique(scene[since >= 0]).tolist():
        own = ((scene == s) & (since >= 0)).nonzero()[:, 0]
        at = int(since[own].argmin())
        k = int(since[own][at])
        out.append(Event(OUTSIDE, s, len(own), int((scene == s).sum()), int(own[at]), k, k * dt[s], k, float(largest[own].max())))
    return out
