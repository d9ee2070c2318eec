"""Objective networks as one fused kernel per law (CUDA, float32): features, network and read-out without memory traffic in between.

A warp processes 32 particles of one scene, one per lane. Each lane computes the strain, the features and the read-out of its particle.
The layers are matrix products of the whole warp on the tensor cores, in tf32. Each product is computed as three, of the rounded operands
and of their residues, which makes the relative error 1e-7 instead of 1e-3. Plain float32 would be slower, bound by reading the weights.
The rows of the weights are permuted so that the columns that a lane holds of one layer's result are those that it needs as operand of the
next layer: activations never leave the registers. `networks.py` is the implementation without fusion.

    m16n8k8: a lane (g, t) = (lane / 4, lane % 4) holds rows g, g + 8 and columns 2t, 2t + 1 of a 16 x 8 result.
"""

import functools
from collections.abc import Callable, Sequence
from types import SimpleNamespace

import torch
import warp as wp
from torch import Tensor

from neuido.physics.laws.base import Engine
from neuido.physics.laws.neural import bounded_kernels, network_kernels, return_kernels
from neuido.physics.laws.neural.fused_source import BACKWARD, FORWARD
from neuido.physics.runtime.device import launch, start_warp
from neuido.physics.runtime.once import cached
from neuido.types import Particles

WIDTHS = (32, 64)
"""Hidden widths for which fused kernels exist."""

STRESS, CORRECTION, BOUNDED, RETURN = "stress", "correction", "bounded", "return"
"""Read-outs of an objective law: coefficients of a stress, radii of a yield surface, moduli of a bounded stress, a full return map."""

BATCH, BATCH_NUMBERS = 16, 2**27
"""Most substeps whose activations are kept for one product of matrices, and numbers that they may take: half a gigabyte. A product and a
sum for each substep took longer than the networks (few-shot on an H200: 47 of 171 ms a step)."""

TURNS = 1
"""Turns of the loop over the tiles of the first layer that are written out."""

BLOCK = 32
"""Threads per block; with one warp per block, the warps of a small body spread evenly over the multiprocessors."""

INPUTS = 16
"""Columns of the first operand: nine features, a one for the bias, padding."""


def readout(kind: str, name: str) -> SimpleNamespace:
    """Return the functions of one particle around the network: features, value, and the adjoints of coefficients and F."""
    if kind == BOUNDED:
        own = bounded_kernels.functions(wp.float32, name)
        return SimpleNamespace(**vars(own), value=own.stress_of, coefficients=own.stress_coefficients, gradient=own.stress_gradient)
    own = network_kernels.functions(wp.float32, name)
    if kind == STRESS:
        return SimpleNamespace(**vars(own), value=own.stress_of, coefficients=own.stress_coefficients, gradient=own.stress_gradient)
    return SimpleNamespace(**vars(own) | vars(correction(own, name, kind)))


def correction(own: SimpleNamespace, name: str, kind: str) -> SimpleNamespace:
    """Return features, value and adjoints of the correction of a kind, from the functions of `network_kernels` or `bounded_kernels`."""
    if kind == RETURN:
        own = SimpleNamespace(**vars(own) | vars(return_kernels.functions(own, wp.float32, name)))
    vec4, mat33, correction_coefficients = own.vec4, own.mat33, own.correction_coefficients

    @wp.func(module=name)
    def coefficients(F: mat33, l: float, A: mat33, q: float, c: vec4, scale: float, g: mat33):
        return correction_coefficients(F, l, A, q, c, scale, 0, g)

    features_of = getattr(own, "plain_features", own.features_of)  # those of the bounded law are of a shortened strain
    return SimpleNamespace(features_of=features_of, value=own.correction_of, coefficients=coefficients, gradient=own.correction_gradient)


def networks(width: int, name: str, per_warp: int = 32) -> SimpleNamespace:
    """Return the functions of a network of one width and their types: its values, its adjoint, and the outputs in what the values keep.

    Args:
        width: Hidden width, one of `WIDTHS`.
        name: Name of the Warp module that the functions belong to.
        per_warp: Particles of a warp, 16 or 32, in its first lanes.
    """
    tiles = width // 8
    kept = 8 * tiles + 4
    sizes = {
        "H": width, "MT": per_warp // 16, "NT": tiles, "TURNS": TURNS, "KEPT": kept,
        "SIZE1": 2 * tiles * 128, "SIZE2": tiles * tiles * 128, "SIZE3": tiles * 128,
        "SIZE3T": tiles * 128,
    }  # fmt: skip
    vec4 = wp.types.vector(length=4, dtype=wp.float32)
    vec9 = wp.types.vector(length=9, dtype=wp.float32)
    vecK = wp.types.vector(length=kept, dtype=wp.float32)
    floats = wp.array(dtype=wp.float32)

    @wp.func_native(FORWARD.format(**sizes))
    def network(x: vec9, shared: int, scene: int, W1: floats, W2: floats, B2: floats, W3: floats, B3: floats) -> vecK: ...

    @wp.func_native(BACKWARD.format(**sizes))
    def network_adjoint(
        x: vec9, kept: vecK, gy: vec4, shared: int, scene: int, W1: floats, W2T: floats, W3T: floats, W1T: floats,
        warp: int, first: int, last: int, P3: floats, PB: floats, H1: floats, G1: floats, G2: floats,
    ) -> vec9: ...  # fmt: skip

    @wp.func(module=name)
    def outputs(k: vecK):
        return vec4(k[wp.static(kept - 4)], k[wp.static(kept - 3)], k[wp.static(kept - 2)], k[wp.static(kept - 1)])

    return SimpleNamespace(network=network, network_adjoint=network_adjoint, outputs=outputs, vecK=vecK)


def kernels_of(name: str) -> list[Callable]:
    """Return the decorators of kernels and of their adjoints, which a run without gradients does not compile.

    Both approximate logarithms, roots and divisions: relative error 1e-6 with a third of the instructions.
    """
    modules = name, f"{name}.backward"
    for module in modules:
        wp.set_module_options({"fast_math": True}, module=wp.get_module(module))
    return [functools.partial(wp.kernel, module=module, enable_backward=False) for module in modules]


@cached
def build(width: int, kind: str, per_warp: int = 32) -> SimpleNamespace:
    """Return the fused kernels for one hidden width, one of `WIDTHS`, and one read-out: `STRESS`, `BOUNDED`, `CORRECTION` or `RETURN`.

    `per_warp` is as for `networks`.
    """
    start_warp()
    name = f"neuido.fused.{width}.{kind}.{per_warp}"
    own, layers = readout(kind, name), networks(width, name, per_warp)
    vec4, vec9, mat33 = own.vec4, own.vec9, own.mat33
    strain_invariants, features_of = own.strain_invariants, own.features_of
    value, coefficients, gradient = own.value, own.coefficients, own.gradient
    network, network_adjoint, outputs = layers.network, layers.network_adjoint, layers.outputs
    kernel, adjoint_kernel = kernels_of(name)
    floats = wp.array(dtype=wp.float32)
    ints = wp.array(dtype=wp.int32)

    @kernel
    def forward(
        F: wp.array(dtype=mat33), scenes: ints, firsts: ints, lasts: ints, shared: int, rows: int,
        W1: floats, W2: floats, B2: floats, W3: floats, B3: floats, scale: float, out: wp.array(dtype=mat33),
    ):  # fmt: skip
        tid = wp.tid()
        warp = tid / 32
        p = firsts[warp] + tid % 32
        s = scenes[warp]
        Fp = F[wp.min(p, lasts[warp] - 1)]
        N, h, l, A, q = strain_invariants(Fp)
        k = network(features_of(l, A, q), wp.min(s, shared - 1), wp.min(s, rows - 1), W1, W2, B2, W3, B3)
        if p < lasts[warp]:
            out[p] = value(Fp, l, A, q, outputs(k), scale)

    @adjoint_kernel
    def adjoint(
        F: wp.array(dtype=mat33), scenes: ints, firsts: ints, lasts: ints, shared: int, rows: int,
        W1: floats, W2: floats, B2: floats, W3: floats, B3: floats, scale: float, W2T: floats, W3T: floats, W1T: floats,
        g_out: wp.array(dtype=mat33), g_F: wp.array(dtype=mat33),
        P3: floats, PB: floats, X: wp.array(dtype=vec9), H1: floats, G1: floats, G2: floats,
    ):  # fmt: skip
        """Add to g_F.

        With P3, add to the warp's part of the last layer's gradient; with X, write the features and activations for the other layers.
        """
        tid = wp.tid()
        warp = tid / 32
        last = lasts[warp]
        p = firsts[warp] + tid % 32
        s = wp.min(scenes[warp], shared - 1)
        r = wp.min(scenes[warp], rows - 1)
        pp = wp.min(p, last - 1)
        g = g_out[pp]
        N, h, l, A, q = strain_invariants(F[pp])
        x = features_of(l, A, q)
        k = network(x, s, r, W1, W2, B2, W3, B3)
        gy = coefficients(F[pp], l, A, q, outputs(k), scale, g)
        if p >= last:
            gy = vec4(0.0, 0.0, 0.0, 0.0)
        gx = network_adjoint(x, k, gy, s, r, W1, W2T, W3T, W1T, warp, firsts[warp], last, P3, PB, H1, G1, G2)
        if p < last:
            if X:
                X[p] = x
            # computed again, since keeping it would cost registers
            N2, h2, l2, A2, q2 = strain_invariants(F[p])
            g_F[p] = g_F[p] + gradient(F[p], N2, h2, l2, A2, q2, outputs(k), scale, g_out[p], gx)

    return SimpleNamespace(forward=forward, adjoint=adjoint)


@cached(limit=16)
def warps_of(offsets: tuple[int, ...], device: torch.device, per_warp: int = 32) -> list[Tensor]:
    """Return the scene, the first particle and the end of every warp of up to `per_warp` particles.

    The tensors are cached, since nothing may be copied from the host while a graph is captured.
    """
    table = [(s, p, min(p + per_warp, j)) for s, (i, j) in enumerate(zip(offsets[:-1], offsets[1:])) for p in range(i, j, per_warp)]
    return [torch.tensor(column, dtype=torch.int32, device=device) for column in zip(*table)]


@cached(limit=16)
def _order(rows: int, columns: int, device: torch.device) -> Tensor:
    """Return the flat indices of the two entries of each lane in a (rows, columns) matrix, (tiles, 32 lanes, 2)."""
    lane = torch.arange(32)
    g, t = lane // 4, lane % 4
    tiles = [
        torch.stack([(8 * k + 2 * t + half) * columns + 8 * n + g for half in (0, 1)], dim=1)
        for k in range(rows // 8)
        for n in range(columns // 8)
    ]
    return torch.stack(tiles).to(device)


def _fragments(W: Tensor) -> Tensor:
    """Pack matrices (S, rows, columns) as (S, tiles * 32 * 4): for each lane two entries rounded to tf32, then their residues."""
    entries = W.flatten(1)[:, _order(W.shape[1], W.shape[2], W.device)]
    high = ((entries.contiguous().view(torch.int32) + 0x1000) & ~0x1FFF).view(torch.float32)
    return torch.cat([high, entries - high], dim=-1).flatten(1).contiguous()


class FusedEngine(Engine):
    """The engine of an objective network with fused kernels; same interface and results as `Engine`.

    Args:
        law: The law.
        tensors: Result of `law.tensors()`, in the dtype and on the device of the rollout.
        particles: The scene of each particle.
        per_warp: As for `networks`.
    """

    def __init__(self, law, tensors: Sequence[Tensor], particles: Particles, per_warp: int = 32):
        super().__init__(law, tensors, particles)
        W1, b1, W2, b2, W3, b3 = self.tensors
        self.width, self.outputs = W1.shape[1], W3.shape[1]
        self.kernels = build(self.width, law.readout, per_warp)
        shared, own = max(t.shape[0] for t in (W1, b1, W2, b2)), max(W3.shape[0], b3.shape[0])
        first = W1.new_zeros(shared, INPUTS, self.width)
        first[:, :9], first[:, 9] = W1.mT, b1
        last, offset = W1.new_zeros(own, self.width, 8), W1.new_zeros(own, 4)
        last[..., : self.outputs], offset[:, : self.outputs] = W3.mT, b3
        second, bias = W2.mT.expand(shared, -1, -1), b2.expand(shared, -1).contiguous()
        self.first, self.second, self.last = first, second, last
        self.rows = (shared, own)
        self.packed = [t.view(-1) for t in (_fragments(first), _fragments(second), bias, _fragments(last), offset)]
        self.warps = warps_of(particles.offsets, W1.device, per_warp)

    @property
    def threads(self) -> int:
        return 32 * len(self.warps[0])

    def forward(self, F: Tensor, out: Tensor) -> None:
        arguments = [F, *self.warps, *self.rows, *self.packed, self.law.scale, out]
        launch(self.kernels.forward, self.threads, arguments, F.device, block=BLOCK)

    def start_adjoint(self, wanted: Sequence[bool]) -> None:
        super().start_adjoint(wanted)
        like, count = self.first, self.particles.offsets[-1]
        self.transposed = [_fragments(t.mT.contiguous()).view(-1) for t in (self.second, self.last, self.first)]
        self.full, self.ends = any(wanted[:4]), any(wanted[4:])
        self.P3 = self.PB = self.X = self.H1 = self.G1 = self.G2 = None
        if self.ends:
            self.P3, self.PB = like.new_zeros(self.threads * self.width // 8), like.new_zeros(len(self.warps[0]) * 4)
        if self.full:
            depth = max(1, min(BATCH, BATCH_NUMBERS // max(1, count * (9 + 3 * self.width))))
            self.X = like.new_empty(depth, count, 9)
            self.H1, self.G1, self.G2 = (like.new_empty(depth, count, self.width) for _ in range(3))
            self.filled = 0

    def adjoint(self, F: Tensor, grad_out: Tensor, grad_F: Tensor) -> None:
        kept = [self.X[self.filled], *(t[self.filled].view(-1) for t in (self.H1, self.G1, self.G2))] if self.full else [None] * 4
        arguments = [F, *self.warps, *self.rows, *self.packed, self.law.scale, *self.transposed, grad_out, grad_F,
                     self.P3, self.PB, *kept]  # fmt: skip
        launch(self.kernels.adjoint, self.threads, arguments, F.device, block=BLOCK)
        if self.full:
            self.filled += 1
            if self.filled == len(self.X):
                self._add_layer_gradients()

    def _add_layer_gradients(self) -> None:
        """Add the kept substeps to the gradients of the first two layers, which all scenes share or each scene has for itself."""
        g1, b1, g2, b2 = self.grads[:4]
        x, h1, d1, d2 = (t[: self.filled] for t in (self.X, self.H1, self.G1, self.G2))
        self.filled = 0
        ranges = [(0, 0, x.shape[1])] if self.rows[0] == 1 else [
            (s, i, j) for s, (i, j) in enumerate(zip(self.particles.offsets[:-1], self.particles.offsets[1:]))
        ]  # fmt: skip
        for s, i, j in ranges:
            own = [t[:, i:j].flatten(0, 1) for t in (x, h1, d1, d2)]
            for target, d, value in ((g1, own[2], own[0]), (g2, own[3], own[1])):
                if target is not None:
                    target[min(s, len(target) - 1)].addmm_(d.T, value)
            for target, d in ((b1, own[2]), (b2, own[3])):
                if target is not None:
                    target[min(s, len(target) - 1)].add_(d.sum(0))

    def gradients(self) -> list[Tensor | None]:
        if self.full and self.filled:
            self._add_layer_gradients()
        if self.ends:
            # in the part of a warp, lane (g, t) of tile j holds output g % 4 of column 8 j + 2 t + g / 4
            tiles = self.width // 8
            share = self.P3.view(-1, tiles, 2, 4, 4).permute(0, 3, 1, 4, 2).reshape(-1, 4, self.width)
            for target, value in ((self.grads[4], share), (self.grads[5], self.PB.view(-1, 4))):
                if target is not None:
                    rows = self.warps[0].long().clamp(max=len(target) - 1)
                    target.index_add_(0, rows, value[:, : self.outputs].contiguous())
        return self.grads
