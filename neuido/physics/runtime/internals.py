"""Adapter for private parts of Warp and torch: packed launches, array descriptors, out-variants of activations.

They save time and change no result. With an untested version of either package a warning is given once and slower public calls are used.
"""

import ctypes
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.nn import functional

TRIED = {"torch": ((2, 11), (2, 13)), "warp": ((1, 19), (1, 19))}
"""First and last minor version of each package that the private parts were tested with."""


def was_tried(package: str, version: str) -> bool:
    """Return whether this version of a package is in `TRIED`, and warn in one line where it is not."""
    numbers = version.split("+")[0].split(".")[:2]
    first, last = TRIED[package]
    if first <= tuple(int(n) if n.isdigit() else 0 for n in numbers) <= last:
        return True
    span = " to ".join(dict.fromkeys(".".join(map(str, v)) for v in (first, last)))
    warnings.warn(f"{package} {version} was not tried (tried: {span}); neuido takes slower public calls in place of private ones",
                  RuntimeWarning, stacklevel=2)  # fmt: skip
    return False


TORCH_TRIED, WARP_TRIED = was_tried("torch", torch.__version__), was_tried("warp", wp.__version__)


# Warp.


def parameters(kernel: wp.Kernel) -> list[Any]:
    """Return the parameters of a kernel in order, each with a `label` and a `type`."""
    return kernel.adj.args


def contract_products(kernel: wp.Kernel) -> None:
    """Compile a kernel's module for the CPU with fused multiply-add across expressions: a tenth less time.

    Warp contracts only within an expression by default. Call it before the module is first loaded on any device, since the options are
    part of the module's hash. Modules of other packages and modules with flags of their own are left unchanged.
    """
    module = kernel.module
    if WARP_TRIED and kernel.func.__module__.startswith("neuido.") and module.options["cpu_compiler_flags"] is None:
        flags = wp.config.cpu_compiler_flags
        flags = "-march=native" if flags is None else flags
        wp.set_module_options({"cpu_compiler_flags": f"{flags} -ffp-contract=fast".strip()}, module=module)


def load(kernel: wp.Kernel, device: torch.device, block: int) -> None:
    """Load the code of a kernel ahead of its first launch, for `block` threads per block."""
    if WARP_TRIED:
        kernel.module.load(wp.device_from_torch(device), block)


def describe_array(t: Tensor, dtype: type) -> Any:
    """Return Warp's descriptor of a tensor: address, shape and strides. It does not keep the tensor alive; the slower public call does."""
    if not WARP_TRIED:
        return wp.from_torch(t.detach(), dtype=dtype, requires_grad=False)
    found = wp.from_torch(t.detach(), dtype=dtype, requires_grad=False, return_ctype=True)
    found._ref = found._gradref = None  # Warp would hold the tensor's memory as long as the descriptor exists
    return found


_layouts: dict[wp.Kernel, type[ctypes.Structure]] = {}


class PackedLaunch:
    """A CPU launch with packed arguments; Warp's own packing takes as long as the work of 500 particles.

    It does not hold its tensors. The caller must ensure that tensors at the same addresses are alive when it is launched again.

    Args:
        kernel: The kernel.
        dim: Number of threads.
        inputs: As for `wp.launch`.
    """

    __slots__ = ("arguments", "bounds", "enter", "module")

    def __init__(self, kernel: wp.Kernel, dim: int, inputs: Sequence) -> None:
        recorded = wp.launch(kernel, dim=dim, inputs=inputs, device="cpu", record_cmd=True)
        layout = _layouts.get(kernel)
        if layout is None:
            fields = [(arg.label, type(value)) for arg, value in zip(kernel.adj.args, recorded.params[1:], strict=True)]
            layout = _layouts[kernel] = type("Arguments", (ctypes.Structure,), {"_fields_": fields})
        self.bounds, self.arguments = recorded.bounds, layout(*recorded.params[1:])
        self.enter: Callable[[Any, Any], None] = recorded.hooks.forward
        self.module = recorded.module_exec  # keeps the code loaded


# torch.


if TORCH_TRIED:
    from torch.utils._python_dispatch import TorchDispatchMode as DispatchMode  # type: ignore[assignment]  # the stand-in below
else:

    class DispatchMode:
        """Stand-in that intercepts no operation; `launches.LaunchRecordings` then repeats nothing."""

        def __enter__(self) -> "DispatchMode":
            return self

        def __exit__(self, *error: object) -> None:
            pass


def silu_into(x: Tensor, out: Tensor) -> None:
    """Write SiLU of x into `out`."""
    if TORCH_TRIED:
        torch._C._nn.silu(x, out=out)
    else:
        out.copy_(functional.silu(x))


def silu_adjoint_into(grad: Tensor, x: Tensor, out: Tensor) -> None:
    """Write the adjoint of SiLU's input x into `out`, which may be `grad`."""
    if TORCH_TRIED:
        torch.ops.aten.silu_backward.grad_input(grad, x, grad_input=out)
    else:
        s = torch.sigmoid(x)
        torch.mul(grad, s * (1 + x * (1 - s)), out=out)


def gelu_into(x: Tensor, out: Tensor) -> None:
    """Write GELU of x into `out`."""
    if TORCH_TRIED:
        torch._C._nn.gelu(x, out=out)
    else:
        out.copy_(functional.gelu(x))


def gelu_adjoint_into(grad: Tensor, x: Tensor, out: Tensor) -> None:
    """Write the adjoint of GELU's input x into `out`, which may be `grad`."""
    if TORCH_TRIED:
        torch.ops.aten.gelu_backward.grad_input(grad, x, approximate="none", grad_input=out)
    else:
        slope = 0.5 * (1 + torch.erf(x / 2**0.5)) + x * torch.exp(-0.5 * x * x) / (2 * torch.pi) ** 0.5
        torch.mul(grad, slope, out=out)
