"""Several scenes on the CPU: a thread a scene, since Warp runs a kernel on one core there and lets go of Python meanwhile."""

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, TypeVar

import torch
from torch import Tensor

from neuido.physics.mpm.rollout import FIXED, KINDS, Plan

T = TypeVar("T")

FRICTION = 8
"""Which input the friction is; each scene has its own number of colliders."""

_counting = threading.Lock()
_inside: list[int] = []
"""torch's number of threads before the first of the rollouts that run now, once for each."""


@contextmanager
def one_thread_each() -> Iterator[None]:
    """torch's own threads would crowd those of the scenes, and cost more than they bring where matrices are small."""
    with _counting:
        if not _inside:
            _inside.append(torch.get_num_threads())
        else:
            _inside.append(_inside[0])  # the number is the process's own: what another rollout lowered is not what it was before
        torch.set_num_threads(1)
    try:
        yield
    finally:
        with _counting:
            before = _inside.pop()
            torch.set_num_threads(1 if _inside else before)


class Scenes:
    """The plans of single scenes that together do what one plan does; their inputs are its inputs' parts."""

    def __init__(self, plan: Plan) -> None:
        self.whole = plan
        sim = plan.simulator
        self.plans = [plan.alone(s) for s in range(sim.scene_count)]
        self.ranges = list(zip(sim.particles.offsets[:-1], sim.particles.offsets[1:]))

    def part(self, inputs: Sequence[Tensor], s: int) -> tuple[Tensor, ...]:
        """The inputs of scene s: its particles, its row of the scenes' tables, its row of a law (or the one that all share)."""
        i, j = self.ranges[s]
        parts = []
        for n, t in enumerate(inputs):
            kind = KINDS[n] if n < FIXED else "law"
            if kind == "particle" and len(t):
                t = t[i:j]
            elif kind == "time" and t.numel():
                t = t[:, s : s + 1]
            elif (kind == "scene" or len(t) > 1) and t.numel():
                t = t[s : s + 1]
            parts.append(t)
        parts[FRICTION] = parts[FRICTION][:, : self.plans[s].simulator.colliders.friction.shape[1]]
        return tuple(t.contiguous() for t in parts)

    def whole_gradient(self, inputs: Sequence[Tensor], parts: Sequence[Sequence[Tensor | None]]) -> list[Tensor | None]:
        """The gradients of the whole's inputs from those of the scenes."""
        out: list[Tensor | None] = []
        for n, t in enumerate(inputs):
            if parts[0][n] is None:
                out.append(None)
                continue
            kind = KINDS[n] if n < FIXED else "law"
            total = torch.zeros_like(t)
            for s, (i, j) in enumerate(self.ranges):
                part = parts[s][n]
                if not t.numel():
                    continue
                if kind == "particle":
                    total[i:j] = part
                elif kind == "time":
                    total[:, s : s + 1] += part
                else:
                    row = total[0:1] if len(t) == 1 else total[s : s + 1]
                    row[:, : part.shape[1]] += part
            out.append(total)
        return out

    def each(self, function: Callable[[int], T]) -> list[T]:
        """The function of every scene's number, as many at a time as there are cores; the first error is raised."""
        pool = self.whole.simulator.pool
        with one_thread_each():
            return list(pool.map(function, range(len(self.plans))))


def pool() -> ThreadPoolExecutor:
    """One worker for each core that this process may use."""
    return ThreadPoolExecutor(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(), "scene")


class ThreadedRollout(torch.autograd.Function):
    """`autograd._Rollout` of several scenes on the CPU."""

    @staticmethod
    def forward(ctx: Any, scenes: Scenes, keep_all: bool, *inputs: Tensor) -> tuple[Tensor, ...]:
        ctx.set_materialize_grads(False)
        inputs = tuple(t.detach() for t in inputs)
        ctx.scenes = scenes

        def one(s: int):
            plan, part = scenes.plans[s], scenes.part(inputs, s)
            kept = plan.simulator.cache.find(plan, part, keep_all)
            serial = kept.forward(plan, part)
            plan.check(kept.tape)
            return kept, serial

        ctx.kept = scenes.each(one)
        ctx.save_for_backward(*(t.clone() for t in inputs))
        stride = scenes.whole.every if keep_all else 1
        return tuple(torch.cat([kept.tape.states[n][::stride] for kept, _ in ctx.kept], dim=1) for n in range(4))

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        scenes, wanted, inputs = ctx.scenes, ctx.needs_input_grad[2:], ctx.saved_tensors

        def one(s: int):
            i, j = scenes.ranges[s]
            own = [None if g is None else g[:, i:j] for g in gradients]
            kept, serial = ctx.kept[s]
            return kept.backward(scenes.plans[s], scenes.part(inputs, s), serial, own, wanted)

        with scenes.whole.simulator.lock:
            out = scenes.whole_gradient(inputs, scenes.each(one))
        return (None, None, *(g if want else None for g, want in zip(out, wanted, strict=True)))
