"""Warp kernels on torch tensors: choice of the device, start of Warp, streams and launches."""

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
    """Return the torch device for the `device` option of a command: `auto` (CUDA if available), `cpu` or `cuda`.

    Raises:
        UserError: Another name, or `cuda` without a CUDA device.
    """
    if name not in ("auto", "cpu", "cuda"):
        raise UserError(f"device must be auto, cpu or cuda, got {name!r}")
    if name == "cuda" and not torch.cuda.is_available():
        raise UserError("device cuda was asked for and there is none here: use device auto or cpu")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def as_device(device: str | torch.device) -> torch.device:
    """Return the torch device, with its index, for `auto` (CUDA if available), `cpu`, `cuda`, `cuda:1`, ..., or a `torch.device`.

    Raises:
        UserError: Another name, or a CUDA device that does not exist.
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
    """Initialise Warp once, without its banner and without its warning of a missing CUDA driver."""
    level = max(wp.config.log_level, wp.LOG_WARNING)
    wp.config.log_level = wp.LOG_ERROR
    with contextlib.nullcontext() if torch.cuda.is_available() else _silent_stderr():
        wp.init()
    wp.config.log_level = level


@contextlib.contextmanager
def _silent_stderr() -> Iterator[None]:
    """Discard what is written to standard error, by C code too."""
    saved, null = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(null, 2)
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(null)


def real_of(dtype: torch.dtype) -> type:
    """Return the Warp scalar type for `torch.float32` or `torch.float64`."""
    return {torch.float32: wp.float32, torch.float64: wp.float64}[dtype]


@contextlib.contextmanager
def torch_stream(device: torch.device) -> Iterator[None]:
    """Open a context in which Warp launches go to torch's current stream."""
    if device.type == "cuda":
        # no synchronisation between streams: all work is on torch's stream, and a graph capture forbids it
        with wp.ScopedStream(_stream(torch.cuda.current_stream(device)), sync_enter=False):
            yield
    else:
        yield


STREAM_CAPACITY = 64
"""Largest number of streams in the cache; torch has 32 of each priority."""
_streams: dict[tuple[int, int], wp.Stream] = {}


def _stream(stream: torch.cuda.Stream) -> wp.Stream:
    """Return Warp's object of a torch stream, from a cache: registering a stream takes longer than a launch."""
    key = (stream.device_index, stream.cuda_stream)
    found = _streams.get(key)
    if found is None:
        if len(_streams) >= STREAM_CAPACITY:
            _streams.clear()
        found = _streams[key] = wp.stream_from_torch(stream)
    return found


def launch(kernel: wp.Kernel, dim: int, arguments: Sequence, device: torch.device, *, block: int = 256) -> None:
    """Launch a Warp kernel on torch tensors.

    Call it within `torch_stream`. The tensors must stay alive until the launch has run.

    Args:
        kernel: The kernel; its annotations give the array types.
        dim: Number of threads.
        arguments: Arguments of the kernel, with tensors for arrays and None for absent arrays.
        device: Device of the tensors.
        block: Threads per block on a GPU.
    """
    if device.type == "cpu":
        if dim:
            _launch_cached(kernel, dim, arguments, device)
        return
    _load(kernel, device, block)
    if torch.cuda.is_current_stream_capturing():  # a graph is captured once: nothing to reuse
        wp.launch(kernel, dim=dim, inputs=_inputs(kernel, arguments), device=wp.device_from_torch(device), block_dim=block)
    elif dim:
        launch_recorded(kernel, dim, arguments, device, block)


def launch_adjoint(kernel: wp.Kernel, dim: int, arguments: Sequence, adjoints: Sequence, device: torch.device) -> None:
    """Launch the adjoint that Warp generates of a kernel, on torch tensors.

    Warp's adjoints of loops that carry a value from turn to turn are silently wrong: use it for kernels without them.

    Args:
        kernel: The kernel, built with `enable_backward`.
        dim: Number of threads.
        arguments: As for `launch`, as in the forward pass.
        adjoints: Adjoint of each argument, in part read and in part added to; None for scalars, and for arrays without one.
        device: Device of the tensors.
    """
    if device.type == "cuda":
        _load(kernel, device, 256)
    with BUILDING:  # as in `_launch_cached`
        inputs, own = _inputs(kernel, arguments), _inputs(kernel, adjoints)
    launches.forbid_repetition()
    where = "cpu" if device.type == "cpu" else wp.device_from_torch(device)
    wp.launch(kernel, dim=dim, inputs=inputs, adj_inputs=own, adjoint=True, device=where)


def repeated(kernel: wp.Kernel, dim: int, arguments: Sequence, device: torch.device, *, block: int = 256) -> Callable[[int], None]:
    """Prepare the repeated launch of a kernel whose first argument is the number of the step.

    On a GPU the arguments are packed once for all launches, since packing takes longer than a launch.

    Args:
        kernel: The kernel.
        dim: Number of threads.
        arguments: The arguments after the step; the tensors must stay alive until the last launch has run.
        device: Device of the tensors.
        block: Threads per block on a GPU.

    Returns:
        A function that launches the kernel for a step.
    """
    if device.type == "cpu":
        return lambda step: launch(kernel, dim, [step, *arguments], device)
    _load(kernel, device, block)
    inputs = _inputs(kernel, [0, *arguments])
    command = wp.launch(kernel, dim=dim, inputs=inputs, device=wp.device_from_torch(device), block_dim=block, record_cmd=True)
    assert command is not None  # since it is recorded

    def again(step: int) -> None:
        command.set_param_at_index(0, step)
        command.launch()

    return again


@cached
def _load(kernel: wp.Kernel, device: torch.device, block: int) -> None:
    """Load the code of a kernel on a GPU; one thread at a time, since Warp's module tables are not thread-safe."""
    _contract(kernel)
    internals.load(kernel, device, block)


_contract = cached(internals.contract_products)


def _inputs(kernel: wp.Kernel, arguments: Sequence) -> list:
    """Convert the arguments of a kernel for Warp, and set the compiler options of its module."""
    _contract(kernel)
    return [
        _array(value, arg.type.dtype) if isinstance(value, Tensor) else value
        for value, arg in zip(arguments, internals.parameters(kernel), strict=True)
    ]


class _Command:
    """A packed launch, with references to the arguments that are identified by their address, so that no other object gets it."""

    __slots__ = ("launch", "references")

    def __init__(self, kernel: wp.Kernel, dim: int, arguments: Sequence) -> None:
        self.launch = internals.PackedLaunch(kernel, dim, _inputs(kernel, arguments))
        self.references = [value for value in arguments if not isinstance(value, Tensor)]


COMMAND_CAPACITY = 12_000
"""Largest number of packed launches in the cache: those of a thousand substeps with their adjoints."""
_commands: dict[tuple, _Command] = {}


class _RecordedLaunch:
    """A launch that Warp has recorded, with its numbers, and references to the arguments that are identified by their address."""

    __slots__ = ("command", "numbers", "references")

    def __init__(self, kernel: wp.Kernel, dim: int, arguments: Sequence, device: torch.device, block: int) -> None:
        where = wp.device_from_torch(device)
        self.command = wp.launch(kernel, dim=dim, inputs=_inputs(kernel, arguments), device=where, block_dim=block, record_cmd=True)
        self.numbers = [(i, value) for i, value in enumerate(arguments) if isinstance(value, int | float)]
        self.references = [value for value in arguments if not isinstance(value, Tensor)]

    def run(self, numbers: list[int | float]) -> None:
        """Launch again with these numbers."""
        assert self.command is not None  # since it is recorded
        for k, value in enumerate(numbers):
            index, last = self.numbers[k]
            if value != last:
                self.command.set_param_at_index(index, value)
                self.numbers[k] = index, value
        self.command.launch()


RECORDED_CAPACITY = 4_000
"""Largest number of recorded launches in the cache: those of a few hundred substeps that are not captured."""
_recorded: dict[tuple, _RecordedLaunch] = {}


def launch_recorded(kernel: wp.Kernel, dim: int, arguments: Sequence, device: torch.device, block: int = 256) -> None:
    """Launch on a GPU; the launch that Warp recorded of the same tensors is reused, since packing arguments takes longer than a launch.

    Args:
        kernel, dim, arguments, device: As for `launch`.
        block: Threads per block.
    """
    key: list = [kernel, dim, device, block]
    numbers = []
    for value in arguments:
        if isinstance(value, Tensor):
            key += (value.data_ptr(), value.shape, value.stride())
        elif isinstance(value, int | float):  # bool too
            numbers.append(value)
        else:
            key.append(id(value))
    found = _recorded.get(tuple(key))
    if found is None:
        with BUILDING:
            if len(_recorded) >= RECORDED_CAPACITY:
                _recorded.clear()
            found = _recorded[tuple(key)] = _RecordedLaunch(kernel, dim, arguments, device, block)
    found.run(numbers)


def forget_launches() -> None:
    """Empty the caches of packed and recorded launches."""
    with BUILDING:
        _commands.clear()
        _recorded.clear()


def packed_launches() -> int:
    """Return the number of packed and recorded launches in the caches."""
    return len(_commands) + len(_recorded)


def _launch_cached(kernel: wp.Kernel, dim: int, arguments: Sequence, device: torch.device) -> None:
    """Launch on the CPU; the packed arguments of an earlier launch on the same tensors are reused."""
    if not internals.WARP_TESTED:
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
        with BUILDING:  # two threads must not load a module at the same time: one would get the code of the other, or none
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
    """Return Warp's descriptor of a tensor (address, shape, strides), from a cache if possible, which saves 4 us."""
    if not internals.WARP_TESTED:
        return internals.describe_array(t, dtype)
    key = (t.data_ptr(), t.shape, t.stride(), dtype)
    found = _arrays.get(key)
    if found is None:
        if len(_arrays) > 20_000:
            _arrays.clear()
        found = _arrays[key] = internals.describe_array(t, dtype)
    return found
