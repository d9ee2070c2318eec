"""A cache of rollouts by shape: on a GPU as CUDA graphs, captured once and replayed, on the CPU as a tape that is reused.

A cached rollout owns its tape, and a captured one its inputs and gradients too; the next run of the same shape overwrites them. A serial
number identifies a run. If a later run overwrote the tape, the backward pass repeats the forward pass first. The tape is reused on the CPU
because the page faults of a new one cost more than the substeps.
"""

import gc
import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import TypeVar

import torch
from torch import Tensor

from neuido.physics.mpm.plan import Plan
from neuido.physics.mpm.rollout import new_tape
from neuido.physics.mpm.substeps import run_backward, run_forward

T = TypeVar("T")

CAPACITY = 4
"""Number of rollouts in the cache of a simulator; each holds its tape."""


class CachedRollout:
    """A rollout that runs eagerly and reuses its tape for inputs of the same shapes.

    On the CPU it also copies the inputs into the same memory in each run: launches on the memory of an earlier one are packed already.

    Args:
        plan: The rollout.
        keep_all: Whether the tape stores every substep, as a backward pass needs it, or the frames alone.
    """

    def __init__(self, plan: Plan, keep_all: bool) -> None:
        self.tape = new_tape(plan, keep_all)
        self.room = plan.setup.room  # a captured graph uses its memory
        self.serial = 0
        self.inputs: list[Tensor] = []

    def forward(self, plan: Plan, inputs: Sequence[Tensor]) -> int:
        """Run with new inputs and return the serial number of the run."""
        self._forward(plan, inputs)
        self.serial += 1
        return self.serial

    def backward(
        self, plan: Plan, inputs: Sequence[Tensor], serial: int, gradients: Sequence[Tensor | None], wanted: Sequence[bool]
    ) -> list[Tensor | None]:
        """Return the gradients of the inputs for the run `serial`, which had these inputs."""
        if serial != self.serial:
            self.forward(plan, inputs)
        return self._backward(plan, inputs, gradients, wanted)

    def _forward(self, plan: Plan, inputs: Sequence[Tensor]) -> None:
        run_forward(plan, self._own(inputs), self.tape)

    def _backward(
        self, plan: Plan, inputs: Sequence[Tensor], gradients: Sequence[Tensor | None], wanted: Sequence[bool]
    ) -> list[Tensor | None]:
        return run_backward(plan, self.inputs or inputs, self.tape, gradients, wanted)

    def _own(self, inputs: Sequence[Tensor]) -> Sequence[Tensor]:
        """Copy the inputs of a run into the memory of this rollout, and return it; on a GPU return the inputs."""
        if self.room.device.type != "cpu":
            return inputs
        if not self.inputs:
            self.inputs = [torch.empty_like(t, memory_format=torch.contiguous_format) for t in inputs]
        for own, given in zip(self.inputs, inputs, strict=True):
            own.copy_(given)
        return self.inputs


class CapturedRollout(CachedRollout):
    """A rollout that is captured as CUDA graphs: one forward graph, and one backward graph per set of requested gradients.

    Args:
        plan: The rollout.
        inputs: Inputs of the first run; later runs copy theirs into the same memory.
        keep_all: As for `CachedRollout`.
    """

    def __init__(self, plan: Plan, inputs: Sequence[Tensor], keep_all: bool) -> None:
        super().__init__(plan, keep_all)
        self.plan = plan
        self.inputs = [t.clone() for t in inputs]
        self._adjoints: dict[tuple, tuple[torch.cuda.CUDAGraph, list, list]] = {}
        run_forward(plan, self.inputs, self.tape, steps=1)  # compiles and loads the kernels
        self.graph, _ = capture(lambda: run_forward(plan, self.inputs, self.tape))

    def _forward(self, plan: Plan, inputs: Sequence[Tensor]) -> None:
        for own, given in zip(self.inputs, inputs, strict=True):
            own.copy_(given)
        self.graph.replay()

    def _backward(
        self, plan: Plan, inputs: Sequence[Tensor], gradients: Sequence[Tensor | None], wanted: Sequence[bool]
    ) -> list[Tensor | None]:
        key = (tuple(g is not None for g in gradients), tuple(wanted))
        if key not in self._adjoints:
            own = [None if g is None else g.clone() for g in gradients]
            run_backward(self.plan, self.inputs, self.tape, own, wanted, steps=1)
            graph, out = capture(lambda: run_backward(self.plan, self.inputs, self.tape, own, wanted))
            self._adjoints[key] = (graph, own, out)
        graph, own_gradients, out = self._adjoints[key]
        for own, given in zip(own_gradients, gradients):
            if given is not None:
                own.copy_(given)
        graph.replay()
        return [None if t is None or not want else t.clone() for t, want in zip(out, wanted, strict=True)]


def capture(launches: Callable[[], T]) -> tuple[torch.cuda.CUDAGraph, T]:
    """Capture kernel launches as a CUDA graph.

    Garbage collection is disabled during the capture, since freeing another graph would break it. Unlike `torch.cuda.graph`, it does not
    collect beforehand either: that takes longer than capturing a hundred substeps.

    Args:
        launches: Function that launches the kernels.

    Returns:
        The graph, and the result of the function, which replays of the graph overwrite.
    """
    graph, stream = torch.cuda.CUDAGraph(), torch.cuda.Stream()
    torch.cuda.synchronize()
    collecting = gc.isenabled()
    gc.disable()
    try:
        with torch.cuda.stream(stream):
            graph.capture_begin()
            try:
                out = launches()
            finally:
                graph.capture_end()
    finally:
        if collecting:
            gc.enable()
    torch.cuda.current_stream().wait_stream(stream)
    return graph, out


class RolloutCache:
    """The cached rollouts of a simulator; the least recently used is dropped first.

    Args:
        graphs: Whether to capture rollouts as CUDA graphs.
    """

    def __init__(self, graphs: bool) -> None:
        self.graphs = graphs
        self.lock = threading.RLock()
        """Held during a forward or backward pass: threads that share a simulator share its tape, grid and graphs."""
        self._rollouts: OrderedDict[tuple, CachedRollout] = OrderedDict()
        self._single: dict[int, RolloutCache] = {}

    def single_scene(self, s: int) -> "RolloutCache":
        """Return the cache for the rollouts of scene s alone."""
        return self._single.setdefault(s, RolloutCache(self.graphs))

    def held_bytes(self) -> int:
        """Return the memory of the tapes [bytes], which later rollouts use again."""
        with self.lock:
            tapes = [rollout.tape for rollout in self._rollouts.values()]
            own = sum(t.numel() * t.element_size() for tape in tapes for t in (*tape, *tape.memory.values()) if isinstance(t, Tensor))
            return own + sum(cache.held_bytes() for cache in self._single.values())

    def clear(self) -> None:
        """Release the tapes and graphs, which the next rollout makes anew."""
        with self.lock:
            self._rollouts.clear()
            self._single.clear()

    def find(self, plan: Plan, inputs: Sequence[Tensor], keep_all: bool) -> CachedRollout:
        """Return the cached rollout for a plan and inputs of these shapes, or make one; captured if graphs are on and the laws allow it."""
        own = plan.key(inputs) if self.graphs else None
        shapes = plan.setup.room.shape, *(tuple(t.shape) for t in inputs)
        key = (own, plan.steps, plan.every, plan.plasticity is None, plan.compensated, keep_all, *shapes)
        if key not in self._rollouts:
            while len(self._rollouts) >= CAPACITY:
                self._rollouts.popitem(last=False)
            self._rollouts[key] = CachedRollout(plan, keep_all) if own is None else CapturedRollout(plan, inputs, keep_all)
        self._rollouts.move_to_end(key)
        return self._rollouts[key]
