"""A rollout as one autograd function: with a full tape, in pieces, or with one thread per scene."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import torch
from torch import Tensor

from neuido.errors import UserError
from neuido.physics.mpm.graphs import RolloutCache
from neuido.physics.mpm.kernels import transfers as kernels
from neuido.physics.mpm.plan import FIXED, KINDS, SOLIDS, STATES, Plan
from neuido.physics.mpm.rollout import Tape
from neuido.physics.mpm.window.placement import PIECE, Piece, corners, pieces
from neuido.physics.runtime.invalidation import invalidate
from neuido.physics.runtime.limits import UNCHECKED, check_memory
from neuido.physics.runtime.threads import one_thread_each

T = TypeVar("T")

FRICTION = 8
"""Index of the friction input; the number of colliders, hence its width, differs between scenes."""


class _Permuted(torch.autograd.Function):
    """A permutation whose gradient is permuted back; torch adds the gradient of any index to zeros, number by number."""

    @staticmethod
    def forward(ctx: Any, t: Tensor, order: Tensor, inverse: Tensor, axis: int) -> Tensor:
        ctx.axis = axis
        ctx.save_for_backward(inverse)
        return t.index_select(axis, order)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        return gradient.index_select(ctx.axis, *ctx.saved_tensors), None, None, None


def permuted(t: Tensor, order: Tensor, inverse: Tensor, axis: int = 0) -> Tensor:
    """Return a copy of t in another order along an axis.

    Args:
        t: Any tensor.
        order: Index of each element of the result, a permutation.
        inverse: The inverse permutation.
        axis: The axis.
    """
    return _Permuted.apply(t, order, inverse, axis)


def run(
    plan: Plan, inputs: tuple[Tensor, ...], segment: int | None, cache: RolloutCache, pool: ThreadPoolExecutor | None
) -> tuple[Tensor, ...]:
    """Return frames of x, v, C, F and the history; differentiable if an input requires a gradient.

    The frames lie in memory that the next rollout overwrites.

    Args:
        plan: The rollout to run.
        inputs: The inputs in the order of `KINDS`, then the tensors of the laws.
        segment: Substeps between two checkpoints; None: one tape for the whole rollout.
        cache: The cached rollouts of the simulator.
        pool: Threads, one scene each; None: all scenes share their launches.

    Raises:
        UserError: As `check`, or more memory than there is.
    """
    differentiable = torch.is_grad_enabled() and any(t.requires_grad for t in inputs)
    _check_memory(plan, inputs, segment, differentiable, cache)
    captured = plan.setup.device.type == "cuda"  # a graph of many thousand substeps is large and slow to capture
    if plan.setup.window is not None:
        return _Pieces.apply(plan, pieces(plan.steps, plan.every, segment), cache, differentiable, *inputs)
    if (differentiable or captured) and segment is not None and segment < plan.steps:
        parts = [Piece(n, segment, plan.every) for n in range(0, plan.steps, segment)]
        return _Pieces.apply(plan, parts, cache, differentiable, *inputs)
    if pool is not None:
        return _ThreadedRollout.apply(SingleScenes(plan, cache, pool), differentiable, *inputs)
    if differentiable:
        return _Rollout.apply(plan, cache, *inputs)
    return _frames(plan, cache, tuple(t.detach() for t in inputs))


def check(plan: Plan, tape: Tape) -> None:
    """Note the events of a run, and raise the earliest failure that the kernels reported, or that the last frame is not finite.

    With `nan_on_failure` the frames of failed scenes are set to NaN instead.

    Raises:
        UserError: A particle lost, too fast, or not finite.
    """
    setup, found = plan.setup, tape.status.view(-1, 3)
    plan.recorder.add(tape.lowest, tape.since, setup.first_particle, plan.offset)
    finite = torch.isfinite(tape.F[-1]).all(dim=(1, 2))
    if bool(finite.all() & ~found.any()):  # one transfer
        return
    if plan.nan_on_failure:
        invalidate(tape.states[:4], ~finite | (found[:, 0] != 0)[setup.field.long()], setup.particles.scene)
        return
    # report the earliest failure
    code, p, step = min((row for row in found.tolist() if row[0]), key=lambda row: row[2], default=(0, 0, 0))
    if code == 0:
        p, step = int((~finite).nonzero()[0]), plan.steps - 1
    s = int(setup.particles.scene[p])
    p = int(setup.order[p]) + setup.first_particle
    scene = setup.scenes[s]
    s += setup.first_scene
    what = {
        kernels.LOST: "left the domain; enlarge `lower`/`upper`, close it with `walls`, or set `on_leave` to clamp or delete",
        kernels.FAST: f"moved by more than a cell ({scene.dx:.4g} m) or became NaN; lower `dt` (now {scene.dt:g} s) or the stiffness",
        0: f"has a deformation gradient that is not finite; lower `dt` (now {scene.dt:g} s) or check the law",
    }[code]
    raise UserError(f"particle {p} of scene {s} {what} (substep {plan.offset + step + 1} of {plan.total})")


def _check_memory(plan: Plan, inputs: Sequence[Tensor], segment: int | None, differentiable: bool, cache: RolloutCache) -> None:
    """Raise UserError where the frames and the tape of a rollout need more memory than there is; arguments as for `run`."""
    setup, state = plan.setup, sum(t.numel() for t in inputs[:STATES])
    frames = plan.steps // plan.every + 1
    taped = min(segment or plan.steps, plan.steps) if differentiable else 0
    if setup.window is not None and differentiable:
        frames, taped = frames + plan.steps // PIECE, min(taped, PIECE)  # the states between pieces, and the tape of one
    numbers = state * (2 * frames + taped)  # as computed and in the order of the bodies
    if setup.keep_grid:
        numbers += taped * (9 * len(setup.mass) * (2 if plan.corrects else 1) + 8 * setup.room.count)
    what = f"a rollout of {len(setup.mass)} particles, {plan.steps} steps and {frames} frames{' with gradients' if differentiable else ''}"
    change = f"raise `every`, lower `steps`{', give `segment`' if taped == plan.steps else ''}"
    needed = numbers * setup.dtype.itemsize
    check_memory(needed, setup.device, what, change, own=cache.held_bytes() if needed > UNCHECKED else 0)


def _frames(plan: Plan, cache: RolloutCache, inputs: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """Return the frames of a rollout without a tape."""
    cached = cache.find(plan, inputs, keep_all=False)
    cached.forward(plan, inputs)
    check(plan, cached.tape)
    return (*cached.tape.states, *of_solids(cached.tape, plan.every))


def of_solids(tape: Tape, every: int) -> tuple[Tensor, ...]:
    """Return the frames of the states of solids, (K, S, C, 13), and the impulses of all substeps, (T, S, C, 6); nothing without solids."""
    return () if tape.solids is None else (tape.solids.state[::every], tape.solids.impulse)


class _Rollout(torch.autograd.Function):
    """Map the initial state, the parameters and the tensors of the laws to frames of x, v, C, F and the history."""

    @staticmethod
    def forward(ctx: Any, plan: Plan, cache: RolloutCache, *inputs: Tensor) -> tuple[Tensor, ...]:
        ctx.set_materialize_grads(False)
        inputs = tuple(t.detach() for t in inputs)
        # the tape is shared: if a later rollout overwrote it, the backward pass repeats this forward pass
        ctx.plan, ctx.lock, ctx.cached = plan, cache.lock, cache.find(plan, inputs, keep_all=True)
        ctx.serial = ctx.cached.forward(plan, inputs)
        check(plan, ctx.cached.tape)
        ctx.save_for_backward(*(t.clone() for t in inputs))
        return (*(t[:: plan.every] for t in ctx.cached.tape.states), *of_solids(ctx.cached.tape, plan.every))

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        wanted = ctx.needs_input_grad[2:]
        with ctx.lock:
            out = ctx.cached.backward(ctx.plan, ctx.saved_tensors, ctx.serial, gradients, wanted)
        return (None, None, *(g if want else None for g, want in zip(out, wanted, strict=True)))


class _Pieces(torch.autograd.Function):
    """`_Rollout` piece by piece: stores the states between pieces and recomputes the tape of one piece at a time.

    This is gradient checkpointing; and where the grid follows the matter, each piece has its own place of the grid.
    """

    @staticmethod
    def forward(
        ctx: Any, plan: Plan, parts: Sequence[Piece], cache: RolloutCache, differentiable: bool, *inputs: Tensor
    ) -> tuple[Tensor, ...]:
        ctx.set_materialize_grads(False)
        inputs = tuple(t.detach() for t in inputs)
        ctx.plan, ctx.parts, ctx.cache, ctx.carried, ctx.places = plan, parts, cache, _carried(plan), []
        now = tuple(inputs[c] for c in ctx.carried)
        frames = tuple(t.new_empty(plan.steps // plan.every + 1, *t.shape) for t in now)
        for frame, t in zip(frames, now):
            frame[0] = t
        starts, impulses = [], []
        for piece in parts:
            starts += now if differentiable else ()
            ctx.places.append(_place(plan, now[0], piece))
            found = _frames(_part(plan, piece), cache, _piece_inputs(ctx.carried, now, inputs, piece))
            own, whole = _frames_of(piece, plan.every)
            for frame, part in zip(frames, found):
                frame[whole] = part[own]
            impulses += [part.clone() for part in found[len(frames) :]]
            now = tuple(part[-1].clone() for part in found[: len(frames)])
        ctx.save_for_backward(*inputs, *starts)
        return (*frames, *([torch.cat(impulses)] if impulses else []))

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        plan, wanted, tensors, carried = ctx.plan, ctx.needs_input_grad[4:], ctx.saved_tensors, ctx.carried
        given, starts = tensors[: len(wanted)], tensors[len(wanted) :]
        carry = [torch.zeros_like(given[c]) for c in carried]
        kinds = _kinds(given)
        total = [torch.zeros_like(t) for t in given]
        needed = tuple(want or c in carried for c, want in enumerate(wanted))
        for i, piece in reversed(list(enumerate(ctx.parts))):
            inputs = _piece_inputs(carried, starts[len(carried) * i : len(carried) * (i + 1)], given, piece)
            own_frames, whole = _frames_of(piece, plan.every)
            own = []
            for a, gradient in zip(carry, gradients):
                of_frames = a.new_zeros(piece.steps // piece.every + 1, *a.shape)
                if gradient is not None:
                    of_frames[own_frames] = gradient[whole]
                    if i == 0:  # the first frame of another piece is the last frame of the one before
                        of_frames[0] = gradient[0]
                of_frames[-1] += a
                own.append(of_frames)
            steps = slice(piece.first, piece.first + piece.steps)
            own += [None if g is None else g[steps] for g in gradients[len(carried) :]]
            part = _part(plan, piece)
            with ctx.cache.lock:
                if ctx.places[i] is not None:
                    plan.setup.place(*ctx.places[i])
                cached = ctx.cache.find(part, inputs, keep_all=True)
                serial = cached.forward(part, inputs)
                out = cached.backward(part, inputs, serial, own, needed)
            carry = [out[c] for c in carried]
            for c, (t, kind, new) in enumerate(zip(total, kinds, out, strict=True)):
                if new is not None and c not in carried:
                    _own(t, kind, piece).add_(new)
        for c, a in zip(carried, carry):
            total[c] = a
        return (None, None, None, None, *(g if want else None for g, want in zip(total, wanted, strict=True)))


def _place(plan: Plan, x: Tensor, piece: Piece) -> tuple[tuple[int, int, int], Tensor] | None:
    """Move a window around the particles at x, and return where it is; None where the grid is the whole domain."""
    setup = plan.setup
    if setup.window is None:
        return None
    shape, origin = setup.window.fit(*corners(x, setup.particles.offsets), piece.steps)
    setup.place(shape, origin)
    return shape, origin


def _part(plan: Plan, piece: Piece) -> Plan:
    """Return the plan of a piece."""
    part = plan.shortened(piece.steps)
    part.every, part.offset = piece.every, piece.first
    return part


def _frames_of(piece: Piece, every: int) -> tuple[slice, slice]:
    """Return which frames of a piece, after its first, are frames of the rollout, and which of the rollout's they are."""
    end = piece.first + piece.steps
    if piece.every == every:
        return slice(1, None), slice(piece.first // every + 1, end // every + 1)
    return (slice(0, 0), slice(0, 0)) if end % every else (slice(-1, None), slice(end // every, end // every + 1))


def _kinds(inputs: Sequence[Tensor]) -> tuple[str, ...]:
    """Return the kinds of the inputs."""
    return (*KINDS, *("law",) * (len(inputs) - FIXED))


def _carried(plan: Plan) -> tuple[int, ...]:
    """Return the indices of the inputs that a piece takes from the end of the one before: the state, and that of solids."""
    return (*range(STATES), *([SOLIDS] if plan.setup.solids is not None else []))


def _piece_inputs(carried: Sequence[int], start: Sequence[Tensor], inputs: Sequence[Tensor], piece: Piece) -> tuple[Tensor, ...]:
    """Return the inputs of a piece, with `start` in place of the carried ones."""
    out = [_own(t, kind, piece) for t, kind in zip(inputs, _kinds(inputs))]
    for c, t in zip(carried, start):
        out[c] = t
    return tuple(out)


def _own(t: Tensor, kind: str, piece: Piece) -> Tensor:
    """Return the part of an input that belongs to a piece."""
    return t[piece.first : piece.first + piece.steps] if kind == "time" and t.numel() and len(t) > 1 else t


class SingleScenes:
    """A rollout of several scenes, split into one rollout per scene.

    Args:
        plan: The rollout of all scenes.
        cache: The cached rollouts of the simulator.
        pool: Threads, one scene each.
    """

    def __init__(self, plan: Plan, cache: RolloutCache, pool: ThreadPoolExecutor) -> None:
        self.whole, self.pool, self.lock = plan, pool, cache.lock
        count, offsets = plan.setup.scene_count, plan.setup.particles.offsets
        self.plans = [plan.single_scene(s) for s in range(count)]
        self.caches = [cache.single_scene(s) for s in range(count)]
        self.ranges = list(zip(offsets[:-1], offsets[1:]))

    def part(self, inputs: Sequence[Tensor], s: int) -> tuple[Tensor, ...]:
        """Return the inputs of scene s: its particles, its row of each table, and its row of each law, or the row that all scenes share."""
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
        parts[FRICTION] = parts[FRICTION][:, : self.plans[s].setup.colliders.friction.shape[1]]
        return tuple(t.contiguous() for t in parts)

    def whole_gradient(self, inputs: Sequence[Tensor], parts: Sequence[Sequence[Tensor | None]]) -> list[Tensor | None]:
        """Assemble the gradients of all inputs from those of the single scenes."""
        out: list[Tensor | None] = []
        for n, t in enumerate(inputs):
            if parts[0][n] is None:
                out.append(None)
                continue
            kind = KINDS[n] if n < FIXED else "law"
            total = torch.zeros_like(t)
            for s, (i, j) in enumerate(self.ranges):
                part = parts[s][n]
                if part is None or not t.numel():
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
        """Return `function(s)` for every scene s, computed in parallel; the first error is raised."""
        with one_thread_each():
            return list(self.pool.map(function, range(len(self.plans))))


class _ThreadedRollout(torch.autograd.Function):
    """`_Rollout` of several scenes on the CPU, one thread per scene."""

    @staticmethod
    def forward(ctx: Any, scenes: SingleScenes, keep_all: bool, *inputs: Tensor) -> tuple[Tensor, ...]:
        ctx.set_materialize_grads(False)
        inputs = tuple(t.detach() for t in inputs)
        ctx.scenes = scenes

        def one(s: int):
            plan, part = scenes.plans[s], scenes.part(inputs, s)
            cached = scenes.caches[s].find(plan, part, keep_all)
            serial = cached.forward(plan, part)
            check(plan, cached.tape)
            return cached, serial

        ctx.cached = scenes.each(one)
        ctx.save_for_backward(*(t.clone() for t in inputs))
        stride = scenes.whole.every if keep_all else 1
        return tuple(torch.cat([cached.tape.states[n][::stride] for cached, _ in ctx.cached], dim=1) for n in range(STATES))

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        scenes, wanted, inputs = ctx.scenes, ctx.needs_input_grad[2:], ctx.saved_tensors

        def one(s: int):
            i, j = scenes.ranges[s]
            own = [None if g is None else g[:, i:j] for g in gradients]
            cached, serial = ctx.cached[s]
            return cached.backward(scenes.plans[s], scenes.part(inputs, s), serial, own, wanted)

        with scenes.lock:
            out = scenes.whole_gradient(inputs, scenes.each(one))
        return (None, None, *(g if want else None for g, want in zip(out, wanted, strict=True)))
