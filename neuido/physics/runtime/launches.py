"""Recording and repetition of kernel launches on the CPU, as a CUDA graph does on a GPU.

The preparation of a launch takes as long as the computation for some hundred particles. A sequence of launches is therefore recorded when
it first runs, and later repeated on the same memory at the cost of one Python call per launch.
"""

import ctypes
import threading
from collections.abc import Callable, Hashable
from typing import Any, NamedTuple, Self

from neuido.physics.runtime import internals

_active = threading.local()

STEP = "step"
"""Name of the one kernel argument that may change when a recording is repeated."""


class Launch(NamedTuple):
    """One recorded launch: the entry point of a compiled kernel and its packed arguments."""

    enter: Callable[[Any, Any], None]
    """Entry point, called with bounds and arguments."""
    bounds: Any
    """Number of threads, as a C structure of Warp."""
    arguments: ctypes.Structure
    """Packed arguments of the kernel."""
    by_step: bool
    """Whether the kernel takes the step as an argument."""
    owner: object
    """Reference that keeps the code and the packed objects alive."""


def record_launch(enter: Callable[[Any, Any], None], bounds: Any, arguments: ctypes.Structure, owner: object) -> None:
    """Append a launch to the active recording of this thread, if any."""
    recording = getattr(_active, "recording", None)
    if recording is not None:
        own = type(arguments).from_buffer_copy(arguments)
        by_step = any(name == STEP for name, *_ in arguments._fields_)
        recording.launches.append(Launch(enter, ctypes.byref(bounds), own, by_step, (owner, bounds)))


def forbid_repetition() -> None:
    """Mark the active recording of this thread, if any, as incomplete, so that it is not repeated."""
    recording = getattr(_active, "recording", None)
    if recording is not None:
        recording.whole = False


class Recording(internals.DispatchMode):
    """Record the launches of this thread as a context manager; `repeat` runs them again on the same memory.

    A recording does not hold its tensors: they must outlive it.

    Attributes:
        whole: Whether only launches ran. A torch operation that computes or allocates cannot be repeated.
    """

    def __init__(self) -> None:
        super().__init__()
        self.launches: list[Launch] = []
        self.whole = True

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.whole = self.whole and func.is_view
        return func(*args, **(kwargs or {}))

    def __enter__(self) -> Self:
        self.outer, _active.recording = getattr(_active, "recording", None), self
        super().__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        _active.recording = self.outer
        self.whole = self.whole and error[0] is None
        super().__exit__(*error)

    def repeat(self, step: int = 0) -> None:
        """Run the launches again, with `step` as their step."""
        for launch in self.launches:
            if launch.by_step:
                setattr(launch.arguments, STEP, step)
            launch.enter(launch.bounds, ctypes.byref(launch.arguments))


class LaunchRecordings:
    """The recordings of one rollout; a key identifies the memory that each uses."""

    def __init__(self) -> None:
        self.recordings: dict[Hashable, Recording | None] = {}

    def run(self, key: Hashable, function: Callable[[], None], step: int = 0) -> None:
        """Run a function that launches kernels, or repeat its recording.

        Args:
            key: Identifies the function and the memory that its launches use.
            function: Called the first time, and each time if it runs anything but launches.
            step: Number of the step, passed to the kernels that take one.
        """
        if not internals.TORCH_TESTED:  # torch operations between the launches would go unnoticed
            function()
            return
        if key not in self.recordings:
            with Recording() as recording:
                function()
            self.recordings[key] = recording if recording.whole else None
            return
        recording = self.recordings[key]
        if recording is None:
            function()
        else:
            recording.repeat(step)
