"""Rollouts that keep their memory: on a GPU as CUDA graphs, captured once for each shape and replayed after; on the CPU as a tape.

A kept rollout owns its tape, a captured one its inputs and gradients too; the next run of the same shape overwrites them.
Whoever wants the gradient of an earlier run says so by its serial number, and its forward pass is run again first. (On the
CPU the page faults of a fresh tape cost more than the substeps.)
"""

import gc
import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import TypeVar

import torch
from torch import Tensor

from neuido.physics.mpm.adjoint import run_backward
from neuido.physics.mpm.plan import Plan
from neuido.physics.mpm.rollout import new_tape, run_forward

T = TypeVar("T")

CAPACITY = 4
"""Rollouts that a simulator keeps; each holds its tape."""


class KeptRollout:
    """A tape for rollouts of one shape, eagerly run."""

    def __init__(self, plan: Plan, keep_all: bool) -> None:
        self.tape = new_tape(plan, keep_all)
        self.serial = 0

    def forward(self, plan: Plan, inputs: Sequence[Tensor]) -> int:
        """Run with new inputs; returns the serial number of this run."""
        self._forward(plan, inputs)
        self.serial += 1
        return self.serial

    def backward(
        self, plan: Plan, inputs: Sequence[Tensor], serial: int, gradients: Sequence[Tensor | None], wanted: Sequence[bool]
    ) -> list[Tensor | None]:
        """Return the adjoint of the run `serial` with these inputs."""
        if serial != self.serial:
            self.forward(plan, inputs)
        return self._backward(plan, inputs, gradients, wanted)

    def _forward(self, plan: Plan, inputs: Sequence[Tensor]) -> None:
        run_forward(plan, inputs, self.tape)

    def _backward(
        self, plan: Plan, inputs: Sequence[Tensor], gradients: Sequence[Tensor | None], wanted: Sequence[bool]
    ) -> list[Tensor | None]:
        return run_backward(plan, inputs, self.tape, gradients, wanted)


class CapturedRollout(KeptRollout):
    """The forward graph of a plan, and a backward graph for each set of wanted gradients."""

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
    """Capture a CUDA graph of the launches, and return it with what they returned.

    No garbage collection meanwhile, for freeing another graph would break it; and none before, as `torch.cuda.graph` has it: that takes
    longer than to capture a hundred substeps.
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
    """The kept rollouts of a simulator, the least recently used dropped first."""

    def __init__(self, graphs: bool) -> None:
        self.graphs = graphs
        self.lock = threading.RLock()
        """Held by a rollout or an adjoint: tape, grid and graphs are one set, which threads that share a simulator take in turn."""
        self._kept: OrderedDict[tuple, KeptRollout] = OrderedDict()
        self._single: dict[int, RolloutCache] = {}

    def single_scene(self, s: int) -> "RolloutCache":
        """Return the cache for the rollouts of scene s alone."""
        return self._single.setdefault(s, RolloutCache(self.graphs))

    def find(self, plan: Plan, inputs: Sequence[Tensor], keep_all: bool) -> KeptRollout:
        """Return the kept rollout for a plan with inputs of these shapes; captured where graphs are on and its laws may be captured."""
        own = plan.key(inputs) if self.graphs else None
        key = (own, plan.steps, plan.every, plan.plasticity is None, keep_all, *(tuple(t.shape) for t in inputs))
        if key not in self._kept:
            while len(self._kept) >= CAPACITY:
                self._kept.popitem(last=False)
            self._kept[key] = KeptRollout(plan, keep_all) if own is None else CapturedRollout(plan, inputs, keep_all)
        self._kept.move_to_end(key)
        return self._kept[key]
