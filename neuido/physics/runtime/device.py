"""Where torch and Warp meet: start-up, streams, and launches of Warp kernels on torch tensors."""

import contextlib
import ctypes
import os
from collections.abc import Callable, Iterator, Sequence

import torch
import warp as wp
from torch import Tensor

from neuido.errors import UserError
from neuido.physics.runtime import internals, launches
from neuido.physics.runtime.once import BUILDING, cached


def choose_device(name: str) -> torch.device:
    """Return the device for `auto` (cuda where there is one), `cpu` or `cuda`.

    Raises:
        UserError: Another name, or cuda where there is none.
    """
    if name not in ("auto", "cpu", "cuda"):
        raise UserError(f"device must be auto, cpu or cuda, got {name!r}")
    if name == "cuda" and not torch.cuda.is_available():
        raise UserError("device cuda was asked for and there is none here: use device auto or cpu")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def as_device(device: str | torch.device) -> torch.device:
    """Return the torch device, with its index, for `auto`, `cpu`, `cuda`, `cuda:1`, ... or a device.

    Raises:
        UserError: Another name, or a CUDA device that is not there.
    """
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(device)
    except RuntimeError as error:
        raise UserError(f"device is {device!r}; give auto, cpu, cuda, or cuda:1 for a second GPU") from error
    if device.type == "cuda":
        count = torch.cuda.device_count() if torch.cuda.is_available() else 0
        if (device.index or 0) >= count:
            raise UserError(f"device is {str(device)!r} and there are {count} CUDA devices here; use device auto or cpu")
    elif device.type != "cpu":
        raise UserError(f"device is {str(device)!r}; the simulators run on cpu and cuda")
    return torch.empty(0, device=device).device  # with its index, which Warp needs


@cached
def start_warp() -> None:
    """Initialise Warp without its banner, and without its remark on a missing driver; safe to call again, and from several threads."""
    level = max(wp.config.log_level, wp.LOG_WARNING)
    wp.config.log_level = wp.LOG_ERROR
    with contextlib.nullcontext() if torch.cuda.is_available() else _silent_stderr():
        wp.init()
    wp.config.log_level = level


@contextlib.contextmanager
def _silent_stderr() -> Iterator[None]:
    """Redirect standard error while Warp's C library prints its remark."""
    kept, hole = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(hole, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(hole)


def real_of(dtype: torch.dtype) -> type:
    """Return the Warp scalar type of a torch float type."""
    return {torch.float32: wp.float32, torch.float64: wp.float64}[dtype]


@contextlib.contextmanager
def torch_stream(device: torch.device) -> Iterator[None]:
    """Warp launches go to torch's current stream while this is open."""
    if device.type == "cuda":
        # no events between streams: everything is on torch's, and a capture forbids them
        with wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(device)), sync_enter=False):
            yield
    else:
        yield


def launch(kernel: wp.Kernel, dim: int, arguments: Sequence, device: torch.device, *, block: int = 256) -> None:
    """Launch a kernel with torch tensors in place of Warp arrays, typed by the kernel's own annotations.

    Inside `torch_stream` it goes to torch's current stream. The tensors keep their memory and must outlive the launch. None is
    an absent array; `block` is the number of threads a block on a GPU.
    """
    if device.type == "cpu":
        if dim:
            _launch_again(kernel, dim, arguments, device)
        return
    _load(kernel, device, block)
    wp.launch(kernel, dim=dim, inputs=_inputs(kernel, arguments), device=wp.device_from_torch(device), block_dim=block)


def repeated(kernel: wp.Kernel, dim: int, arguments: Sequence, device: torch.device, *, block: int = 256) -> Callable[[int], None]:
    """Prepare a launch for many steps, of a kernel whose first argument is the step; `arguments` are the others.

    On a GPU they are packed once, which takes longer than a launch. They must outlive the last one.
    """
    if device.type == "cpu":
        return lambda step: launch(kernel, dim, [step, *arguments], device)
    _load(kernel, device, block)
    inputs = _inputs(kernel, [0, *arguments])
    command = wp.launch(kernel, dim=dim, inputs=inputs, device=wp.device_from_torch(device), block_dim=block, record_cmd=True)

    def again(step: int) -> None:
        command.set_param_at_index(0, step)
        command.launch()

    return again


@cached
def _load(kernel: wp.Kernel, device: torch.device, block: int) -> None:
    """Load a kernel's code on a GPU, one thread at a time, since Warp's tables of modules are not for several."""
    _contract(kernel)
    internals.load(kernel, device, block)


_contract = cached(internals.contract_products)


def _inputs(kernel: wp.Kernel, arguments: Sequence) -> list:
    """Return what Warp takes for the arguments of a kernel, whose module has its options from here on."""
    _contract(kernel)
    return [
        _array(value, arg.type.dtype) if isinstance(value, Tensor) else value
        for value, arg in zip(arguments, internals.parameters(kernel), strict=True)
    ]


class _Command:
    """A packed launch, and the arguments that its key knows by their address."""

    __slots__ = ("kept", "launch")

    def __init__(self, kernel: wp.Kernel, dim: int, arguments: Sequence) -> None:
        self.launch = internals.PackedLaunch(kernel, dim, _inputs(kernel, arguments))
        self.kept = [value for value in arguments if not isinstance(value, Tensor)]


COMMAND_CAPACITY = 12_000
"""Packed launches that are kept: those of a thousand substeps with their adjoints."""
_commands: dict[tuple, _Command] = {}


def forget_launches() -> None:
    """Drop all packed launches."""
    with BUILDING:
        _commands.clear()


def packed_launches() -> int:
    """Return how many packed launches are kept."""
    return len(_commands)


def _launch_again(kernel: wp.Kernel, dim: int, arguments: Sequence, device: torch.device) -> None:
    """Launch on the CPU, with the arguments packed where a launch of these tensors was before."""
    if not internals.WARP_TRIED:
        with BUILDING:
            inputs = _inputs(kernel, arguments)
        launches.forbid_repetition()
        wp.launch(kernel, dim=dim, inputs=inputs, device="cpu")
        return
    key: list = [kernel, dim]
    scalars = []
    for i, value in enumerate(arguments):
        if isinstance(value, Tensor):
            key += (value.data_ptr(), value.shape, value.stride())
        elif isinstance(value, int | float):  # bool too
            scalars.append((i, value))
        else:
            key.append(id(value))
    command = _commands.get(tuple(key))
    if command is None:
        with BUILDING:  # two threads that load one module at a time would leave one of them with the other's code, or with none
            if len(_commands) > COMMAND_CAPACITY:
                _commands.clear()
            command = _commands[tuple(key)] = _Command(kernel, dim, arguments)
    packed = command.launch
    for i, value in scalars:
        setattr(packed.arguments, internals.parameters(kernel)[i].label, value)
    launches.record_launch(packed.enter, packed.bounds, packed.arguments, command)
    packed.enter(ctypes.byref(packed.bounds), ctypes.byref(packed.arguments))


_arrays: dict[tuple, object] = {}


def _array(t: Tensor, dtype: type) -> object:
    """Return Warp's descriptor of a tensor. It is address, shape and strides, so one serves whatever lies there next: 4 us saved."""
    if not internals.WARP_TRIED:
        return internals.describe_array(t, dtype)
    key = (t.data_ptr(), t.shape, t.stride(), dtype)
    found = _arrays.get(key)
    if found is None:
        if len(_arrays) > 20_000:
            _arrays.clear()
        found = _arrays[key] = internals.describe_array(t, dtype)
    return found
