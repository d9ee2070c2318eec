"""Linear layers over the particles of several scenes, written into given memory, and their adjoints; no autograd."""

from collections.abc import Sequence

import torch
from torch import Tensor


def linear(x: Tensor, W: Tensor, b: Tensor | None, offsets: Sequence[int], out: Tensor) -> None:
    """out = x W^T + b with the weights of each particle's scene.

    Args:
        x: (P, n).
        W: (1 or S, m, n); a leading 1 is shared by all scenes.
        b: (1 or S, m), or None.
        offsets: First particle of each scene, and P at the end.
        out: (P, m), written.
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
    """Write gx; add to gW and gb. Any of them may be None: not wanted. `ones` (P,) sums the rows for gb."""
    single = gy.shape[0]
    for target, parameter in ((gx, W), (gW, gW), (gb, gb)):
        if target is None:
            continue
        shared = parameter.shape[0] == 1
        for s, (i, j) in enumerate(((0, single),) if shared else zip(offsets[:-1], offsets[1:])):
            if target is gx:
                torch.mm(gy[i:j], W[s], out=gx[i:j])
            elif target is gW:
                gW[s].addmm_(gy[i:j].T, x[i:j])
            else:
                gb[s].addmv_(gy[i:j].T, ones[i:j])
