"""Several scenes on the CPU: a thread a scene, since Warp runs a kernel on one core there and lets go of Python meanwhile."""

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TypeVar

import torch
from torch import Tensor

if TYPE_CHECKING:
    from neuido.physics.rollout import Plan

T = TypeVar("T")


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """torch's own threads would crowd those of the scenes."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


class Scenes:
    """The plans of single scenes that together do what one plan does; their inputs are its inputs' parts."""

    def __init__(self, plan: "Plan") -> None:
        self.whole = plan
        sim = plan.simulator
        self.plans = [plan.alone(s) for s in range(sim.scene_count)]
        self.ranges = list(zip(sim.particles.offsets[:-1], sim.particles.offsets[1:]))

    def part(self, inputs: Sequence[Tensor], s: int) -> tuple[Tensor, ...]:
        """The inputs of scene s: its particles, its row of the scenes' tables, its row of a law (or the one that all share)."""
        i, j = self.ranges[s]
        *particles, pull, force, friction, viscosity = inputs[:9]
        width = self.plans[s].simulator.colliders.friction.shape[1]
        rows = [pull[s : s + 1], force[s : s + 1], friction[s : s + 1, :width], viscosity[s : s + 1] if viscosity.numel() else viscosity]
        laws = [t if len(t) == 1 else t[s : s + 1] for t in inputs[9:]]
        return tuple(t.contiguous() for t in (*(t[i:j] for t in particles), *rows, *laws))

    def whole_gradient(self, inputs: Sequence[Tensor], parts: Sequence[Sequence[Tensor | None]]) -> list[Tensor | None]:
        """The gradients of the whole's inputs from those of the scenes."""
        out: list[Tensor | None] = []
        for n, t in enumerate(inputs):
            if parts[0][n] is None:
                out.append(None)
                continue
            total = torch.zeros_like(t)
            for s, (i, j) in enumerate(self.ranges):
                part = parts[s][n]
                if n < 5:
                    total[i:j] = part
                elif t.numel():
                    row = total[0:1] if len(t) == 1 else total[s : s + 1]
                    row[:, : part.shape[1]] += part
            out.append(total)
        return out

    def each(self, function: Callable[[int], T]) -> list[T]:
        """The function of every scene's number, as many at a time as there are cores; the first error is raised."""
        pool = self.whole.simulator.pool
        with _one_thread_each():
            return list(pool.map(function, range(len(self.plans))))


def pool() -> ThreadPoolExecutor:
    """One worker for each core that this process may use."""
    return ThreadPoolExecutor(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(), "scene")


class ThreadedRollout(torch.autograd.Function):
    """`rollout._Rollout` of several scenes on the CPU."""

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

        out = scenes.whole_gradient(inputs, scenes.each(one))
        return (None, None, *(g if want else None for g, want in zip(out, wanted, strict=True)))
