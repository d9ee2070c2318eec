"""Events that make the result of a rollout doubtful: inverted or collapsed matter, and strains beyond the training of a law.

The kernels record, for each particle or element, the smallest det F below `COLLAPSED` and the first step below it. This costs one
determinant per substep, and a write only where there is an event. The device is not synchronised before the events are read.
"""

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from neuido.errors import UserError

COLLAPSED = 1e-3
"""det F below which matter counts as collapsed [-]."""
SIGN_TOLERANCE = 1e-6
"""Absolute value of a negative det F above which matter counts as inverted; up to it the sign may be a rounding error."""
INVERTED, CRUSHED, OUTSIDE, LEFT, CLAMPED = "inverted", "collapsed", "outside training", "left", "clamped"
OnInversion = Literal["report", "error"]
CHUNK = 1 << 20
"""Number of deformation gradients that are processed at a time."""


class Event(NamedTuple):
    """An event in one scene of a rollout."""

    kind: str
    """`inverted`: det F below zero. `collapsed`: det F below 0.001. `outside training`: a strain beyond `Law.strain_limit`. `left`: out of
    the domain, and deleted. `clamped`: at a face of the domain in a frame."""
    scene: int
    """Index of the scene."""
    count: int
    """Number of particles or elements that are affected."""
    total: int
    """Number of particles or elements in the scene."""
    first: int
    """Index, within the whole rollout, of the particle or element that was affected first."""
    step: int
    """Step at whose end the event was first detected; 0: at the start."""
    time: float
    """Time of that step [s]."""
    frame: int
    """First frame at or after that time."""
    extreme: float
    """Smallest det F, or largest absolute logarithmic stretch, of all steps [-]; of `left` and `clamped`, the share of the particles."""
    what: str = "particles"
    """What `count`, `total` and `first` refer to: `particles` or `elements`."""

    @property
    def words(self) -> str:
        """What happened, without the scene."""
        plain = {
            INVERTED: "turned inside out",
            CRUSHED: f"collapsed (det F below {COLLAPSED:g})",
            OUTSIDE: "strained beyond the law's training",
            LEFT: "left the domain and were deleted",
            CLAMPED: "came to the faces of the domain and were clamped",
        }
        start = (
            f"{self.count} of {self.total} {self.what} {plain[self.kind]}, the first ({self.what[:-1]} {self.first}) at {self.time:.4g} s"
        )
        if self.kind in (LEFT, CLAMPED):
            return start
        least = f"largest logarithmic stretch {self.extreme:.3g}" if self.kind == OUTSIDE else f"smallest det F {self.extreme:.3g}"
        return f"{start}; {least}"

    def __str__(self) -> str:
        return f"scene {self.scene}: {self.words}"


class Marks(NamedTuple):
    """The record of det F of N particles or elements that the kernels write."""

    lowest: Tensor
    """Smallest det F below `COLLAPSED` [-], (N,); infinite if det F was never below."""
    since: Tensor
    """First step with det F below `COLLAPSED`, counted from 0, (N,) int32; -1 if there was none."""
    scene: Tensor
    """The scene of each particle or element, (N,)."""
    dt: tuple[float, ...]
    """Step of each scene [s]."""
    every: tuple[int, ...]
    """Steps between two frames of each scene."""
    what: str = "particles"
    left: Tensor | None = None
    """First frame in which each particle had left the domain or was at a face, (P,) int32; -1 if none; None: not asked."""
    clamped: bool = False
    """Whether such particles are clamped, in place of deleted."""

    def events(self) -> list[Event]:
        """Return the events of each scene: particles that left, inversions, collapses."""
        found = self.since >= 0
        out = [] if self.left is None else self._departures(self.left)
        if not bool(found.any()):
            return out
        for kind, seen in ((INVERTED, found & (self.lowest < -SIGN_TOLERANCE)), (CRUSHED, found & (self.lowest >= -SIGN_TOLERANCE))):
            out += _scene_events(kind, seen, self.since + 1, self.lowest, self.scene, self.dt, self.every, self.what)
        return out

    def _departures(self, left: Tensor) -> list[Event]:
        """Return the events of particles that left the domain or were clamped at its faces, at the resolution of the frames."""
        every = torch.tensor(self.every, device=left.device)[self.scene.long()]
        share = torch.zeros_like(self.lowest)
        found = _scene_events(CLAMPED if self.clamped else LEFT, left >= 0, left * every, share, self.scene, self.dt, self.every, self.what)
        return [event._replace(extreme=event.count / event.total) for event in found]


def _scene_events(
    kind: str,
    seen: Tensor,
    step: Tensor,
    extreme: Tensor,
    scene: Tensor,
    dt: Sequence[float],
    every: Sequence[int],
    what: str = "particles",
) -> list[Event]:
    """Return an event of one kind for each scene with an affected particle or element.

    Args:
        kind: `Event.kind`.
        seen: Which particles or elements are affected, (N,) bool.
        step: `Event.step` of each, (N,).
        extreme: Smallest det F or largest logarithmic stretch of each [-], (N,).
        scene: The scene of each, (N,).
        dt: Step of each scene [s].
        every: Steps between two frames of each scene.
        what: `Event.what`.
    """
    out = []
    for s in torch.unique(scene[seen]).tolist():
        inside = scene == s
        own = (inside & seen).nonzero()[:, 0]
        at = int(step[own].argmin())
        first = int(step[own[at]])
        worst = extreme[own].max() if kind == OUTSIDE else extreme[own].min()
        out.append(Event(kind, s, len(own), int(inside.sum()), int(own[at]), first, first * dt[s],
                         math.ceil(first / every[s]), float(worst), what))  # fmt: skip
    return out


def checked_option(value: str) -> str:
    """Validate the option `on_inversion`, and return it.

    Raises:
        UserError: Neither `report` nor `error`.
    """
    if value not in ("report", "error"):
        raise UserError(f"on_inversion is {value!r}; choose report or error")
    return value


def raise_inversions(marks: Marks) -> None:
    """Raise for the first inversion or collapse.

    Raises:
        UserError: There is such an event.
    """
    found = sorted((event for event in marks.events() if event.kind in (INVERTED, CRUSHED)), key=lambda event: event.time)
    if found:
        more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
        raise UserError(f"{found[0]}{more}; lower dt, the speed of the impact or the load, or take neo_hookean or sigma, which do not "
                        "collapse; on_inversion = report goes on")  # fmt: skip


class MarkRecorder:
    """Collect the marks of a rollout that runs in parts, one after the other or scene by scene.

    Args:
        count: Number of particles or elements N.
        like: A tensor of the dtype and device of the marks.
    """

    def __init__(self, count: int, like: Tensor) -> None:
        self.lowest = torch.full((count,), math.inf, dtype=like.dtype, device=like.device)
        self.since = torch.full((count,), -1, dtype=torch.int32, device=like.device)

    def add(self, lowest: Tensor, since: Tensor, begin: int = 0, start: int = 0) -> None:
        """Add the marks of one part, without synchronisation of the device.

        Args:
            lowest: `Marks.lowest` of the particles of the part.
            since: `Marks.since` of these particles, counted from the first step of the part.
            begin: Index of the first particle of the part.
            start: First step of the part.
        """
        own = slice(begin, begin + len(since))
        fresh = (self.since[own] < 0) & (since >= 0)
        self.since[own] = torch.where(fresh, since + start, self.since[own])
        self.lowest[own] = torch.minimum(self.lowest[own], lowest)


def marks_of_frames(F: Tensor, scene: Tensor, dt: Sequence[float]) -> Marks:
    """Compute the marks of frames, for a rollout whose kernels recorded none.

    Args:
        F: Deformation gradients [-], (K, P, 3, 3).
        scene: The scene of each particle, (P,).
        dt: Time between two frames of each scene [s]; it takes the place of the step.
    """
    lowest = F.new_full((F.shape[1],), math.inf)
    since = torch.full((F.shape[1],), -1, dtype=torch.int32, device=F.device)
    for k, frame in enumerate(F.detach()):
        J = determinant(frame)
        low = J < COLLAPSED
        since = torch.where(low & (since < 0), k - 1, since)
        lowest = torch.where(low, torch.minimum(lowest, J), lowest)
    # frame 0 has step -1 here, which would mean never
    since = torch.where(torch.isfinite(lowest) & (since < 0), 0, since)
    return Marks(lowest, since, scene, tuple(dt), (1,) * len(dt))


def determinant(F: Tensor) -> Tensor:
    """Compute the determinants of matrices (..., 3, 3) by cofactors, which is faster than by a factorisation."""
    a, b, c = F.unbind(-1)
    return (a * torch.linalg.cross(b, c)).sum(-1)


def strain_events(F: Tensor, limit: float, scene: Tensor, dt: Sequence[float]) -> list[Event]:
    """Find frames with logarithmic stretches beyond a limit.

    Args:
        F: Deformation gradients of the frames [-], (K, P, 3, 3).
        limit: Largest absolute logarithmic stretch [-].
        scene: The scene of each particle, (P,).
        dt: Time between two frames of each scene [s].

    Returns:
        One event for each scene with such a stretch.
    """
    K, P = F.shape[:2]
    F = F.detach()
    largest, since = F.new_zeros(P), torch.full((P,), -1, dtype=torch.long, device=F.device)
    near = 1 - math.exp(-2 * limit)
    eye = torch.eye(3, dtype=F.dtype, device=F.device)
    for k in range(K):
        b = F[k] @ F[k].mT
        far = ((b - eye).square().sum((-2, -1)) > near**2) & torch.isfinite(b).all(-1).all(-1)  # an upper bound of |b_i - 1|
        index = far.nonzero()[:, 0]
        for part in index.split(CHUNK):
            stretch = 0.5 * torch.linalg.eigvalsh(b[part].double()).clamp(min=1e-30).log().abs().amax(-1)
            stretch = torch.where(determinant(F[k, part]) > 0, stretch, math.inf).to(F.dtype)
            beyond = part[stretch > limit]
            since[beyond] = torch.where(since[beyond] < 0, k, since[beyond])
            largest[part] = torch.maximum(largest[part], stretch)
    return _scene_events(OUTSIDE, since >= 0, since, largest, scene, dt, (1,) * len(dt))
