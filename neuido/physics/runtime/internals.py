"""Adapter for private functions of Warp and torch: packed launches, array descriptors, activations that write into existing memory.

They save time and change no result. With an untested version of a package, this module warns once and uses slower public functions.
"""

import ctypes
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.nn import functional

TESTED = {"torch": ((2, 11), (2, 13)), "warp": ((1, 19), (1, 19))}
"""First and last minor version of each package with which its private functions were tested."""


def is_tested(package: str, version: str) -> bool:
    """Return whether a version of a package is in `TESTED`, and warn if it is not."""
    numbers = version.split("+")[0].split(".")[:2]
    first, last = TESTED[package]
    if first <= tuple(int(n) if n.isdigit() else 0 for n in numbers) <= last:
        return True
    span = " to ".join(dict.fromkeys(".".join(map(str, v)) for v in (first, last)))
    warnings.warn(f"{package} {version} was not tested (tested: {span}); neuido uses slower public functions in place of private ones",
                  RuntimeWarning, stacklevel=2)  # fmt: skip
    return False


TORCH_TESTED, WARP_TESTED = is_tested("torch", torch.__version__), is_tested("warp", wp.__version__)


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
    if WARP_TESTED and kernel.func.__module__.startswith("neuido.") and module.options["cpu_compiler_flags"] is None:
        flags = wp.config.cpu_compiler_flags
        flags = "-march=native" if flags is None else flags
        wp.set_module_options({"cpu_compiler_flags": f"{flags} -ffp-contract=fast".strip()}, module=module)


def load(kernel: wp.Kernel, device: torch.device, block: int) -> None:
    """Load the code of a kernel ahead of its first launch, for `block` threads per block."""
    if WARP_TESTED:
        kernel.module.load(wp.device_from_torch(device), block)


def describe_array(t: Tensor, dtype: type) -> Any:
    """Return Warp's descriptor of a tensor: address, shape and strides. It does not keep the tensor alive; the slower public call does."""
    if not WARP_TESTED:
        return wp.from_torch(t.detach(), dtype=dtype, requires_grad=False)
    found: Any = wp.from_torch(t.detach(), dtype=dtype, requires_grad=False, return_ctype=True)
    found._ref = found._gradref = None  # else the descriptor would keep the tensor's memory alive
    return found


_layouts: dict[wp.Kernel, type[ctypes.Structure]] = {}


class PackedLaunch:
    """A launch on the CPU with packed arguments, since Warp's packing takes as long as the computation for 500 particles.

    It does not keep its tensors alive. When it is launched again, there must be tensors at the same addresses.

    Args:
        kernel: The kernel.
        dim: Number of threads.
        inputs: As for `wp.launch`.
    """

    __slots__ = ("arguments", "bounds", "enter", "module")

    def __init__(self, kernel: wp.Kernel, dim: int, inputs: Sequence) -> None:
        recorded: Any = wp.launch(kernel, dim=dim, inputs=inputs, device="cpu", record_cmd=True)
        layout = _layouts.get(kernel)
        if layout is None:
            fields = [(arg.label, type(value)) for arg, value in zip(kernel.adj.args, recorded.params[1:], strict=True)]
            layout = _layouts[kernel] = type("Arguments", (ctypes.Structure,), {"_fields_": fields})
        self.bounds, self.arguments = recorded.bounds, layout(*recorded.params[1:])
        self.enter: Callable[[Any, Any], None] = recorded.hooks.forward
        self.module = recorded.module_exec  # keeps the code loaded


# torch.


if TORCH_TESTED:
    from torch.utils._python_dispatch import TorchDispatchMode as DispatchMode  # type: ignore[assignment]  # the replacement below
else:

    class DispatchMode:
        """Replacement that intercepts no operation; `launches.LaunchRecordings` then repeats nothing."""

        def __enter__(self) -> "DispatchMode":
            return self

        def __exit__(self, *error: object) -> None:
            pass


def silu_into(x: Tensor, out: Tensor) -> None:
    """Write SiLU of x into `out`."""
    if TORCH_TESTED:
        torch._C._nn.silu(x, out=out)  # type: ignore[attr-defined]
    else:
        out.copy_(functional.silu(x))


def silu_adjoint_into(grad: Tensor, x: Tensor, out: Tensor) -> None:
    """Write the adjoint of SiLU's input x into `out`, which may be `grad`."""
    if TORCH_TESTED:
        torch.ops.aten.silu_backward.grad_input(grad, x, grad_input=out)
    else:
        s = torch.sigmoid(x)
        torch.mul(grad, s * (1 + x * (1 - s)), out=out)


def gelu_into(x: Tensor, out: Tensor) -> None:
    """Write GELU of x into `out`."""
    if TORCH_TESTED:
        torch._C._nn.gelu(x, out=out)  # type: ignore[attr-defined]
    else:
        out.copy_(functional.gelu(x))


def gelu_adjoint_into(grad: Tensor, x: Tensor, out: Tensor) -> None:
    """Write the adjoint of GELU's input x into `out`, which may be `grad`."""
    if TORCH_TESTED:
        torch.ops.aten.gelu_backward.grad_input(grad, x, approximate="none", grad_input=out)
    else:
        slope = 0.5 * (1 + torch.erf(x / 2**0.5)) + x * torch.exp(-0.5 * x * x) / (2 * torch.pi) ** 0.5
        torch.mul(grad, slope, out=out)
