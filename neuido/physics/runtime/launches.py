"""Launches on the CPU that are repeated in the same memory: what a CUDA graph is on a GPU.

To look a launch up by its tensors takes as long as the work of some hundred particles. A stretch of launches is recorded while it runs and
repeated from then on as it was, in as little as Python needs to call it.
"""

import ctypes
import threading
from collections.abc import Callable, Hashable
from typing import Any, NamedTuple

from neuido.physics.runtime import internals

_active = threading.local()

STEP = "step"
"""The argument of a kernel that a repetition may change."""


class Launch(NamedTuple):
    """A kernel's entry with its arguments packed."""

    enter: Callable[[Any, Any], None]
    bounds: Any
    arguments: ctypes.Structure
    by_step: bool
    """Whether one of the arguments is the step."""
    owner: object
    """What keeps the code and the packed objects."""


def note(enter: Callable[[Any, Any], None], bounds: Any, arguments: ctypes.Structure, owner: object) -> None:
    """Tell the recording of this thread, if there is one, of a launch."""
    recording = getattr(_active, "recording", None)
    if recording is not None:
        own = type(arguments).from_buffer_copy(arguments)
        by_step = any(name == STEP for name, *_ in arguments._fields_)
        recording.launches.append(Launch(enter, ctypes.byref(bounds), own, by_step, (owner, bounds)))


def forbid_repetition() -> None:
    """Mark the recording of this thread, if there is one, as one that lacks a launch."""
    recording = getattr(_active, "recording", None)
    if recording is not None:
        recording.whole = False


class Recording(internals.DispatchMode):
    """The launches of this thread while it is open; `repeat` runs them again, on the tensors that lay there.

    It keeps no tensor: theirs must outlive it.

    Attributes:
        whole: Whether launches were all that ran: an operation of torch that computes, or takes memory, is not repeated.
    """

    def __init__(self) -> None:
        super().__init__()
        self.launches: list[Launch] = []
        self.whole = True

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.whole = self.whole and func.is_view
        return func(*args, **(kwargs or {}))

    def __enter__(self) -> "Recording":
        self.outer, _active.recording = getattr(_active, "recording", None), self
        return super().__enter__()

    def __exit__(self, *error: Any) -> None:
        _active.recording = self.outer
        self.whole = self.whole and error[0] is None
        super().__exit__(*error)

    def repeat(self, step: int = 0) -> None:
        """Run the launches again; `step` takes the place of theirs."""
        for launch in self.launches:
            if launch.by_step:
                setattr(launch.arguments, STEP, step)
            launch.enter(launch.bounds, ctypes.byref(launch.arguments))


class Stretches:
    """The recorded stretches of one rollout, by what decides the memory that they work in."""

    def __init__(self) -> None:
        self.kept: dict[Hashable, Recording | None] = {}

    def run(self, key: Hashable, stretch: Callable[[], None], step: int = 0) -> None:
        """Run a stretch; where it ran with this key it is repeated, if launches are all that it is."""
        if not internals.TORCH_TRIED:  # an operation of torch between the launches would go unseen
            stretch()
            return
        if key not in self.kept:
            with Recording() as recording:
                stretch()
            self.kept[key] = recording if recording.whole else None
            return
        kept = self.kept[key]
        if kept is None:
            stretch()
        else:
            kept.repeat(step)
