"""A rollout as one autograd function: whole, in segments that keep only the states between them, or a thread for each scene."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from neuido.physics.mpm.rollout import FIXED, KINDS, STATES, Plan
from neuido.physics.mpm.threads import Scenes, ThreadedRollout


def run(plan: Plan, inputs: tuple[Tensor, ...], segment: int | None = None) -> tuple[Tensor, ...]:
    """Frames of x, v, C, F and the history, in memory that the next rollout overwrites; differentiable where an input requires it.

    Args:
        plan: What to run.
        inputs: As `KINDS` says, and the tensors of the laws.
        segment: Substeps between checkpoints of a differentiable run; none: the tape spans the whole of it.

    Raises:
        UserError: What `Plan.check` finds.
    """
    differentiable = torch.is_grad_enabled() and any(t.requires_grad for t in inputs)
    captured = plan.simulator.device.type == "cuda"  # a graph of many thousand substeps would be large and slow to make
    if (differentiable or captured) and segment is not None and segment < plan.steps:
        return _Segments.apply(plan, segment, *inputs)
    if plan.simulator.pool is not None:
        return ThreadedRollout.apply(Scenes(plan), differentiable, *inputs)
    if differentiable:
        return _Rollout.apply(plan, *inputs)
    return _frames(plan, tuple(t.detach() for t in inputs))


def _frames(plan: Plan, inputs: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """A run without a tape."""
    kept = plan.simulator.cache.find(plan, inputs, keep_all=False)
    kept.forward(plan, inputs)
    plan.check(kept.tape)
    return kept.tape.states


class _Rollout(torch.autograd.Function):
    """Frames of x, v, C, F from the start, the parameters and the laws' tensors."""

    @staticmethod
    def forward(ctx: Any, plan: Plan, *inputs: Tensor) -> tuple[Tensor, ...]:
        ctx.set_materialize_grads(False)
        inputs = tuple(t.detach() for t in inputs)
        # the tape belongs to the simulator: a later rollout may overwrite it, and the backward pass then runs this one again
        ctx.plan, ctx.kept = plan, plan.simulator.cache.find(plan, inputs, keep_all=True)
        ctx.serial = ctx.kept.forward(plan, inputs)
        plan.check(ctx.kept.tape)
        ctx.save_for_backward(*(t.clone() for t in inputs))
        return tuple(t[:: plan.every] for t in ctx.kept.tape.states)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        wanted = ctx.needs_input_grad[1:]
        with ctx.plan.simulator.lock:
            out = ctx.kept.backward(ctx.plan, ctx.saved_tensors, ctx.serial, gradients, wanted)
        return (None, *(g if want else None for g, want in zip(out, wanted, strict=True)))


class _Segments(torch.autograd.Function):
    """`_Rollout` in pieces: only the states between them are kept, and the backward pass makes the tape of one piece at a time."""

    @staticmethod
    def forward(ctx: Any, plan: Plan, segment: int, *inputs: Tensor) -> tuple[Tensor, ...]:
        ctx.set_materialize_grads(False)
        inputs = tuple(t.detach() for t in inputs)
        ctx.piece, ctx.count = plan.piece(segment), plan.steps // segment
        length = segment // plan.every
        frames = tuple(t.new_empty(ctx.count * length + 1, *t.shape) for t in inputs[:STATES])
        starts = [inputs[:STATES]]
        for i in range(ctx.count):
            rest = [_own(t, kind, i, segment) for t, kind in zip(inputs[STATES:], _kinds(inputs))]
            for frame, part in zip(frames, _frames(ctx.piece, (*starts[i], *rest))):
                frame[i * length : (i + 1) * length + 1] = part
            starts.append(tuple(frame[(i + 1) * length].clone() for frame in frames))
        ctx.save_for_backward(*inputs[STATES:], *(t for start in starts[:-1] for t in start))
        return frames

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        piece, wanted, tensors = ctx.piece, ctx.needs_input_grad[2:], ctx.saved_tensors
        rest, starts = tensors[: len(wanted) - STATES], tensors[len(wanted) - STATES :]
        length = piece.steps // piece.every
        cache = piece.simulator.cache
        carry = [torch.zeros_like(t) for t in starts[:STATES]]
        kinds = _kinds((*carry, *rest))
        total = [torch.zeros_like(t) for t in rest]
        for i in reversed(range(ctx.count)):
            inputs = (*starts[STATES * i : STATES * (i + 1)], *(_own(t, kind, i, piece.steps) for t, kind in zip(rest, kinds)))
            own = []
            for a, gradient in zip(carry, gradients):
                part = a.new_zeros(length + 1, *a.shape)
                if gradient is not None:
                    # a piece's first frame is the last one of the piece before
                    part[0 if i == 0 else 1 :] = gradient[i * length + (0 if i == 0 else 1) : (i + 1) * length + 1]
                part[-1] += a
                own.append(part)
            with piece.simulator.lock:
                kept = cache.find(piece, inputs, keep_all=True)
                serial = kept.forward(piece, inputs)
                out = kept.backward(piece, inputs, serial, own, (True,) * STATES + tuple(wanted[STATES:]))
            carry = out[:STATES]
            for t, kind, new in zip(total, kinds, out[STATES:], strict=True):
                if new is not None:
                    _own(t, kind, i, piece.steps).add_(new)
        return (None, None, *(g if want else None for g, want in zip([*carry, *total], wanted, strict=True)))


def _kinds(inputs: Sequence[Tensor]) -> tuple[str, ...]:
    """The kinds of the inputs after the start."""
    return (*KINDS[STATES:], *("law",) * (len(inputs) - FIXED))


def _own(t: Tensor, kind: str, i: int, steps: int) -> Tensor:
    """The part of an input that piece i of `steps` substeps reads."""
    return t[i * steps : (i + 1) * steps] if kind == "time" and t.numel() and len(t) > 1 else t
