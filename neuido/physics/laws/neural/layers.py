"""Linear layers with one set of weights per scene, and their adjoints, written into existing memory without autograd."""

from collections.abc import Sequence

import torch
from torch import Tensor


def linear(x: Tensor, W: Tensor, b: Tensor | None, offsets: Sequence[int], out: Tensor) -> None:
    """Write x W^T + b into `out`, with the weights of each particle's scene.

    Args:
        x: Inputs, (P, n).
        W: Weights, (1 or S, m, n); with a leading 1 all scenes share them.
        b: Biases, (1 or S, m), or None.
        offsets: Index of the first particle of each scene, then P.
        out: Outputs, (P, m); overwritten.
    """
    shared = W.shape[0] == 1 and (b is None or b.shape[0] == 1)
    for s, (i, j) in enumerate(((0, len(x)),) if shared else zip(offsets[:-1], offsets[1:])):
        weight = W[min(s, len(W) - 1)].T
        if b is None:
            torch.mm(x[i:j], weight, out=out[i:j])
        else:
            torch.addmm(b[min(s, len(b) - 1)], x[i:j], weight, out=out[i:j])


def linear_adjoint(
    x: Tensor, W: Tensor, gy: Tensor, offsets: Sequence[int], ones: Tensor | None, gx: Tensor | None, gW: Tensor | None, gb: Tensor | None
) -> None:
    """Compute the adjoint of `linear`; a gradient that is None is skipped.

    Args:
        x: Inputs of the layer, (P, n).
        W: Weights, (1 or S, m, n).
        gy: Gradient with respect to the outputs, (P, m).
        offsets: As for `linear`.
        ones: Ones (P,), which sum the rows for gb; needed with gb.
        gx: Gradient with respect to the inputs, (P, n); overwritten.
        gW: Gradient with respect to the weights; added to.
        gb: Gradient with respect to the biases; added to.
    """
    count = gy.shape[0]
    for target, parameter in ((gx, W), (gW, gW), (gb, gb)):
        if target is None or parameter is None:
            continue
        shared = parameter.shape[0] == 1
        for s, (i, j) in enumerate(((0, count),) if shared else zip(offsets[:-1], offsets[1:])):
            if target is gx:
                torch.mm(gy[i:j], W[s], out=target[i:j])
            elif target is gW:
                target[s].addmm_(gy[i:j].T, x[i:j])
            else:
                assert ones is not None  # given with gb
                target[s].addmv_(gy[i:j].T, ones[i:j])
