"""Rollouts as CUDA graphs: captured once for each shape, replayed after, no allocation and no Python in the loop.

A captured rollout owns its inputs, its tape and its gradients; a replay overwrites them. Whoever wants the gradient of an
earlier replay says so by its serial number, and the forward graph is replayed first.
"""

import gc
from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, TypeVar

import torch
from torch import Tensor

if TYPE_CHECKING:
    from neuido.physics.rollout import Plan

T = TypeVar("T")

CAPACITY = 4
"""Graphs that a simulator keeps; each holds the tape of its rollout."""


class CapturedRollout:
    """The forward graph of a plan, and a backward graph for each set of wanted gradients."""

    def __init__(self, plan: "Plan", inputs: Sequence[Tensor], keep_all: bool) -> None:
        self.plan = plan
        self.inputs = [t.clone() for t in inputs]
        self.tape = plan.tape(keep_all)
        self.serial = 0
        self._backward: dict[tuple, tuple[torch.cuda.CUDAGraph, list, list]] = {}
        plan.forward(self.inputs, self.tape, steps=1)  # compiles and loads the kernels
        self.graph, _ = _capture(lambda: plan.forward(self.inputs, self.tape))

    def forward(self, inputs: Sequence[Tensor]) -> int:
        """Run with new inputs; returns the serial number of this run."""
        for own, given in zip(self.inputs, inputs, strict=True):
            own.copy_(given)
        self.graph.replay()
        self.serial += 1
        return self.serial

    def backward(
        self, inputs: Sequence[Tensor], serial: int, gradients: Sequence[Tensor | None], wanted: Sequence[bool]
    ) -> list[Tensor | None]:
        """The adjoint of the run `serial` with these inputs."""
        if serial != self.serial:
            self.forward(inputs)
        key = (tuple(g is not None for g in gradients), tuple(wanted))
        if key not in self._backward:
            own = [None if g is None else g.clone() for g in gradients]
            self.plan.backward(self.inputs, self.tape, own, wanted, steps=1)
            graph, out = _capture(lambda: self.plan.backward(self.inputs, self.tape, own, wanted))
            self._backward[key] = (graph, own, out)
        graph, own_gradients, out = self._backward[key]
        for own, given in zip(own_gradients, gradients):
            if given is not None:
                own.copy_(given)
        graph.replay()
        return [None if t is None or not want else t.clone() for t, want in zip(out, wanted, strict=True)]


def _capture(launches: Callable[[], T]) -> tuple[torch.cuda.CUDAGraph, T]:
    """A graph of the launches, and what they returned. No garbage collection meanwhile: freeing another graph would break it."""
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    collecting = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        with torch.cuda.graph(graph):
            out = launches()
    finally:
        if collecting:
            gc.enable()
    return graph, out


class GraphCache:
    """The captured rollouts of a simulator, the least recently used dropped first."""

    def __init__(self) -> None:
        self._kept: OrderedDict[tuple, CapturedRollout] = OrderedDict()

    def find(self, plan: "Plan", inputs: Sequence[Tensor], keep_all: bool) -> CapturedRollout | None:
        """The captured rollout of a plan with inputs of these shapes; None where its laws may not be captured."""
        own = plan.key(inputs)
        if own is None:
            return None
        key = (*own, keep_all, *(tuple(t.shape) for t in inputs))
        if key not in self._kept:
            while len(self._kept) >= CAPACITY:
                self._kept.popitem(last=False)
            self._kept[key] = CapturedRollout(plan, inputs, keep_all)
        self._kept.move_to_end(key)
        return self._kept[key]
