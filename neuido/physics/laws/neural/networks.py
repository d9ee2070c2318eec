"""Neural laws of a rollout: three-layer networks with hand-written adjoints.

The operator's coefficients lambda are constant over a rollout, and its last layer is linear. So the sum of lambda_k W3_k over k is
one matrix per scene, exactly, and the law is a small network F -> 9 -> hidden -> hidden -> outputs with SiLU (paper, "Model Architecture
Details"). There are two kinds, and a third in `bounded`:

    raw        input 10 (F - I), outputs nine components of tau, or of F_hat - F (the paper's form)
    objective  input invariants of the Hencky strain, outputs coefficients of an isotropic stress, or radii of a yield surface
               (`network_kernels`): frame-indifferent, isotropic, symmetric, free of stress at rest

`forward` and `adjoint` write intermediate results into buffers that laws of the same size share; `adjoint` recomputes the hidden
activations. Calling a law evaluates it in plain torch, which autograd differentiates.
"""

import copy
import threading
from collections.abc import Hashable, Sequence
from typing import Self

import torch
from torch import Tensor

from neuido.errors import UserError
from neuido.physics.laws.base import ElasticLaw, Engine, Law, PlasticLaw
from neuido.physics.laws.neural import fused, network_kernels
from neuido.physics.laws.neural.layers import linear, linear_adjoint
from neuido.physics.laws.neural.network_kernels import COARSE, DELTA, FINE, LINEAR, LODE
from neuido.physics.runtime import device
from neuido.physics.runtime.device import real_of, torch_stream
from neuido.physics.runtime.internals import silu_adjoint_into, silu_into
from neuido.physics.runtime.once import cached
from neuido.types import Particles

RAW_GAIN = 10.0
"""Factor on F - I at the input of a raw network; with a larger input the network learns faster."""

STRESS_SCALE = 1e5
"""Unit of the objective elastic coefficients [Pa]."""

RAW_STRESS_SCALE = 1e4
"""Unit of the raw elastic outputs [Pa]."""

STRAIN_LIMIT = 0.5
"""Largest logarithmic stretch of the objective networks: their series of ln V is right to 3e-4 there, and at 1.6 has the wrong sign."""

STRAIN_SCALE = 1e-2
"""Unit of the yield radii and of the raw plastic correction [-]."""


def launch(kernel, like: Tensor, *arguments) -> None:
    """Launch a kernel on torch's current stream, with one thread for each row of `like`, on its device."""
    with torch_stream(like.device):
        device.launch(kernel, like.shape[0], arguments, like.device)


def kernels(like: Tensor):
    """Return the kernels of `network_kernels` for the scalar type of a tensor."""
    return network_kernels.build(real_of(like.dtype))


# The same functions in plain torch: any leading shape, differentiable by autograd.


def raw_features(F: Tensor) -> Tensor:
    """Compute the input features 10 (F - I) of a raw network.

    Args:
        F: Deformation gradient [-], (..., 3, 3).

    Returns:
        Features [-], (..., 9).
    """
    return RAW_GAIN * (F - torch.eye(3, dtype=F.dtype, device=F.device)).flatten(-2)


def raw_stress(F: Tensor, y: Tensor, scale: float = RAW_STRESS_SCALE) -> Tensor:
    """Return the stress [Pa], (..., 3, 3), of a raw network from its outputs (..., 9); F plays no part."""
    return scale * y.unflatten(-1, (3, 3))


def raw_correction(F: Tensor, y: Tensor, scale: float = STRAIN_SCALE) -> Tensor:
    """Return the corrected deformation gradient, (..., 3, 3), of a raw network from F (..., 3, 3) and its outputs (..., 9)."""
    return F + scale * y.unflatten(-1, (3, 3))


def hencky_strain(F: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the trace and deviator of the left Hencky strain ln V by a series, without SVD.

    The series ends at the seventh order. Its relative error is below 1e-6 at strains of 0.2, and 3e-4 at 0.5.

    Args:
        F: Deformation gradient [-], (..., 3, 3).

    Returns:
        The trace l (...), the deviator A (..., 3, 3), and the norm q (...) of the deviator, bounded below by `DELTA`.
    """
    eye = torch.eye(3, dtype=F.dtype, device=F.device)
    G = F - eye
    e = 0.5 * (G + G.mT + G @ G.mT)
    h = e @ torch.linalg.inv(eye + e)
    h = 0.5 * (h + h.mT)
    h2 = h @ h
    H = h + h @ h2 @ (eye / 3 + h2 @ (eye / 5 + h2 / 7))
    l = H.diagonal(dim1=-2, dim2=-1).sum(-1)
    A = H - l[..., None, None] / 3 * eye
    return l, A, (A.square().sum((-2, -1)) + DELTA**2).sqrt()


def strain_features(l: Tensor, A: Tensor, q: Tensor) -> Tensor:
    """Compute the nine input features of an objective network, each of order 1 for strains of 1e-5 to 0.5.

    Args:
        l: Trace of the Hencky strain [-], (...).
        A: Deviator of the Hencky strain [-], (..., 3, 3).
        q: Norm of the deviator [-], (...).

    Returns:
        Features, (..., 9), as defined in `network_kernels`.
    """
    a, b, c = A.unbind(-2)
    d = (torch.linalg.cross(a, b) * c).sum(-1)
    return torch.stack(
        [
            torch.asinh(l / FINE) / 4,
            torch.asinh(l / COARSE),
            torch.asinh(q / FINE) / 4,
            torch.asinh(q / COARSE),
            l / (l * l + q * q).sqrt(),
            LODE * d / q**3,
            LINEAR * l,
            LINEAR * q,
            LINEAR * d / q**2,
        ],
        dim=-1,
    )


def isotropic_stress(F: Tensor, c: Tensor, scale: float = STRESS_SCALE) -> Tensor:
    """Compute the Kirchhoff stress [Pa], (..., 3, 3), of an objective network from its outputs.

    Args:
        F: Deformation gradient [-], (..., 3, 3).
        c: Coefficients of the four generators, (..., 4); the formula is in `network_kernels`.
        scale: Unit of the stress [Pa].
    """
    l, A, q = hencky_strain(F)
    eye = torch.eye(3, dtype=F.dtype, device=F.device)
    a = A.square().sum((-2, -1))
    D = A @ A - a[..., None, None] / 3 * eye
    c0, c1, c2, c3 = c.unbind(-1)
    return scale * ((c0 * l + c3 * a / q)[..., None, None] * eye + c1[..., None, None] * A + (c2 / q)[..., None, None] * D)


def return_map(F: Tensor, c: Tensor, scale: float = STRAIN_SCALE) -> Tensor:
    """Compute the corrected deformation gradient, (..., 3, 3), of an objective network from its outputs.

    Args:
        F: Trial deformation gradient [-], (..., 3, 3).
        c: Coefficients of the yield radii, (..., 3); the formula is in `network_kernels`.
        scale: Unit of the yield radii [-].
    """
    l, A, q = hencky_strain(F)
    f = (1 - (scale * c[..., 0] + c[..., 1] * (-l).clamp(min=0)) / q).clamp(0, 1)
    u = torch.minimum((l - scale * c[..., 2]).clamp(min=0), l) * (l > 0)
    return taken_back(F, f[..., None, None] * A, u)


def taken_back(F: Tensor, deviator: Tensor, volume: Tensor) -> Tensor:
    """Return exp(-volume/3) exp(-deviator) F, (..., 3, 3), of a symmetric deviator (..., 3, 3) and a volume (...) of the Hencky strain."""
    eye = torch.eye(3, dtype=F.dtype, device=F.device)
    Y = -0.25 * deviator
    E = eye + Y @ (eye + Y / 2 @ (eye + Y / 3 @ (eye + Y / 4)))
    E = E @ E
    return (-volume / 3).exp()[..., None, None] * (E @ E @ F)


# The network: features (P, 9) -> outputs (P, n), with buffers that laws of the same size share.


class _Workspace:
    """Buffers for the intermediate results of a network for P particles, and for their adjoints; each thread has its own."""

    def __init__(self, rows: int, hidden: int, outputs: int, dtype: torch.dtype, device: torch.device, thread: int):
        def empty(columns: int) -> Tensor:
            return torch.empty(rows, columns, dtype=dtype, device=device)

        self.x, self.gx = empty(network_kernels.FEATURES), empty(network_kernels.FEATURES)
        self.z1, self.h1, self.g1 = empty(hidden), empty(hidden), empty(hidden)
        self.z2, self.h2, self.g2 = empty(hidden), empty(hidden), empty(hidden)
        self.y, self.gy = empty(outputs), empty(outputs)
        self.ones = torch.ones(rows, dtype=dtype, device=device)


_workspace = cached(_Workspace, limit=8)


class _Network(Law):
    """Base class of the four network laws.

    Args:
        W1: Weights of the first layer, (1 or S, hidden, 9); with a leading 1 all scenes share them.
        b1: Biases of the first layer, (1 or S, hidden).
        W2: Weights of the second layer, (1 or S, hidden, hidden).
        b2: Biases of the second layer, (1 or S, hidden).
        W3: Weights of the last layer, contracted with lambda, (S, outputs, hidden).
        b3: Biases of the last layer, (S, outputs).
        scale: Unit of the outputs, [Pa] for an elastic law and [-] for a plastic one; `unit` by default.

    Raises:
        UserError: Shapes that do not agree.
    """

    outputs = 9
    unit: float
    """Default of `scale`."""

    def __init__(self, W1: Tensor, b1: Tensor, W2: Tensor, b2: Tensor, W3: Tensor, b3: Tensor, *, scale: float | None = None):
        hidden = W1.shape[-2]
        wanted = ((hidden, 9), (hidden,), (hidden, hidden), (hidden,), (self.outputs, hidden), (self.outputs,))
        scenes = W3.shape[0]
        for name, tensor, shape in zip(("W1", "b1", "W2", "b2", "W3", "b3"), (W1, b1, W2, b2, W3, b3), wanted):
            if tuple(tensor.shape[1:]) != shape or tensor.shape[0] not in (1, scenes):
                needed = f"(1 or {scenes}, {', '.join(map(str, shape))})"
                raise UserError(f"{type(self).__name__}: {name} has shape {tuple(tensor.shape)}; needed {needed}")
        self.weights = (W1, b1, W2, b2, W3, b3)
        self.scale = self.unit if scale is None else scale

    def tensors(self) -> tuple[Tensor, ...]:
        """Return W1, b1, W2, b2, W3 and b3."""
        return self.weights

    def scaled(self, factor: Tensor) -> Self:
        """Return this law with its outputs (of an elastic law, the stress) times a factor per scene, (S,); the last layer is linear."""
        *hidden, W3, b3 = self.weights
        factor = factor.to(W3)
        return self._with(*hidden, factor[:, None, None] * W3, factor[:, None] * b3)

    def _with(self, *weights: Tensor) -> Self:
        """Return a copy of this law with other weights."""
        law = copy.copy(self)
        law.weights = weights  # type: ignore[assignment]
        return law

    def engine(self, tensors: Sequence[Tensor], particles: Particles) -> Engine:
        """Return an engine with fused kernels where they exist (CUDA, float32, some widths), else the general one."""
        if self._fusable(tensors[0]):
            return fused.FusedEngine(self, tensors, particles)
        return Engine(self, tensors, particles)

    def key(self, tensors: Sequence[Tensor]) -> Hashable | None:
        """Return a key for the fused kernels alone: the others write into shared buffers and must not be captured."""
        return (type(self).__name__, self.scale) if self._fusable(tensors[0]) else None

    def _fusable(self, W1: Tensor) -> bool:
        return W1.is_cuda and W1.dtype == torch.float32 and W1.shape[-2] in fused.WIDTHS and self.outputs < 9

    def _features(self, F: Tensor, out: Tensor) -> None:
        """Write the input features of F (P, 3, 3) into `out` (P, 9)."""
        raise NotImplementedError

    def _buffers(self, F: Tensor, hidden: int) -> _Workspace:
        return _workspace(F.shape[0], hidden, self.outputs, F.dtype, F.device, threading.get_ident())

    def _evaluate(self, tensors: Sequence[Tensor], F: Tensor, particles: Particles | None) -> _Workspace:
        """Run the network and return the workspace with all intermediate results."""
        W1, b1, W2, b2, W3, b3 = (t.detach() for t in tensors)
        offsets = self._offsets(F, particles)
        w = self._buffers(F, W1.shape[-2])
        self._features(F, w.x)
        linear(w.x, W1, b1, offsets, w.z1)
        silu_into(w.z1, w.h1)
        linear(w.h1, W2, b2, offsets, w.z2)
        silu_into(w.z2, w.h2)
        linear(w.h2, W3, b3, offsets, w.y)
        return w

    def _backpropagate(
        self, w: _Workspace, tensors: Sequence[Tensor], grads: Sequence[Tensor | None], F: Tensor, particles: Particles | None
    ) -> None:
        """Propagate the gradient w.gy of the outputs to w.gx and to the weights; `w` must come from the last `_evaluate`."""
        W1, _, W2, _, W3, _ = (t.detach() for t in tensors)
        gW1, gb1, gW2, gb2, gW3, gb3 = grads
        offsets = self._offsets(F, particles)
        linear_adjoint(w.h2, W3, w.gy, offsets, w.ones, w.g2, gW3, gb3)
        silu_adjoint_into(w.g2, w.z2, w.g2)
        linear_adjoint(w.h1, W2, w.g2, offsets, w.ones, w.g1, gW2, gb2)
        silu_adjoint_into(w.g1, w.z1, w.g1)
        linear_adjoint(w.x, W1, w.g1, offsets, w.ones, w.gx, gW1, gb1)

    @staticmethod
    def _offsets(F: Tensor, particles: Particles | None) -> Sequence[int]:
        return (0, F.shape[0]) if particles is None else particles.offsets

    def _twin(self, features: Tensor, particles: Particles | None) -> Tensor:
        """Evaluate the network in plain torch: (..., 9) -> (..., outputs), or (P, 9) -> (P, outputs) with several scenes."""
        rows = []
        offsets = (0, len(features)) if len(self.weights[4]) == 1 else self._offsets(features, particles)
        for s, (i, j) in enumerate(zip(offsets[:-1], offsets[1:])):
            W1, b1, W2, b2, W3, b3 = (t[min(s, len(t) - 1)].to(features.dtype) for t in self.weights)
            hidden = torch.nn.functional.silu(features[i:j] @ W1.T + b1)
            rows.append(torch.nn.functional.silu(hidden @ W2.T + b2) @ W3.T + b3)
        return torch.cat(rows)

    def _modulus(self) -> Tensor:
        """Return the secant of tau_11 over F_11 = 1 +- 1e-3 for each scene [Pa], (S,), computed in float64."""
        weights, step = self.weights, 1e-3
        F = torch.eye(3, dtype=torch.float64, device=weights[4].device).repeat(2, 1, 1)
        F[0, 0, 0] += step
        F[1, 0, 0] -= step
        values = []
        with torch.no_grad():
            for s in range(weights[4].shape[0]):
                self.weights = tuple(t[min(s, len(t) - 1)][None] for t in weights)
                tau = self(F)[:, 0, 0]
                values.append((tau[0] - tau[1]) / (2 * step))
        self.weights = weights
        return torch.stack(values)

    def __repr__(self) -> str:
        W1, scenes = self.weights[0], len(self.weights[4])
        plural = "" if scenes == 1 else "s"
        return f"{type(self).__name__}({scenes} scene{plural}, {W1.shape[1]} hidden units, scale {self.scale:g}, on {W1.device})"


class _Raw(_Network):
    features_of = staticmethod(raw_features)

    def _features(self, F: Tensor, out: Tensor) -> None:
        out.copy_(F.view(-1, 9))
        out[:, ::4] -= 1  # no rounding error near F = I
        out *= RAW_GAIN


class _Objective(_Network):
    strain_limit = STRAIN_LIMIT
    readout: str
    """Read-out of the fused kernels, one of `fused.STRESS`, `fused.BOUNDED`, `fused.CORRECTION` and `fused.RETURN`."""
    kernels = staticmethod(kernels)
    """The kernels of features and read-out for the scalar type of a tensor."""

    @staticmethod
    def features_of(F: Tensor) -> Tensor:
        """Compute the input features of F (..., 3, 3) in plain torch, (..., 9)."""
        return strain_features(*hencky_strain(F))

    def _features(self, F: Tensor, out: Tensor) -> None:
        launch(self.kernels(F).features, F, F, out)


class RawElastic(_Raw, ElasticLaw):
    """The paper's elastic network: tau = scale * network(10 (F - I)) [Pa]."""

    unit = RAW_STRESS_SCALE
    stress_of = staticmethod(raw_stress)

    def forward(self, tensors, F, out, particles=None) -> None:
        torch.mul(self._evaluate(tensors, F, particles).y, self.scale, out=out.view(-1, 9))

    def adjoint(self, tensors, F, grad_out, grad_F, grad_tensors, particles=None) -> None:
        w = self._evaluate(tensors, F, particles)
        torch.mul(grad_out.view(-1, 9), self.scale, out=w.gy)
        self._backpropagate(w, tensors, grad_tensors, F, particles)
        grad_F.view(-1, 9).add_(w.gx, alpha=RAW_GAIN)

    def __call__(self, F: Tensor, particles: Particles | None = None) -> Tensor:
        return self.stress_of(F, self._twin(self.features_of(F), particles), self.scale)

    def modulus(self) -> Tensor:
        """Return the secant P-wave modulus over F_11 = 1 +- 1e-3 [Pa], (S,)."""
        return self._modulus()


class RawPlastic(_Raw, PlasticLaw):
    """The paper's plastic network: F_hat = F + scale * network(10 (F - I))."""

    identity = False
    unit = STRAIN_SCALE
    corrected_of = staticmethod(raw_correction)

    def forward(self, tensors, F, out, particles=None) -> None:
        torch.add(F.view(-1, 9), self._evaluate(tensors, F, particles).y, alpha=self.scale, out=out.view(-1, 9))

    def adjoint(self, tensors, F, grad_out, grad_F, grad_tensors, particles=None) -> None:
        w = self._evaluate(tensors, F, particles)
        torch.mul(grad_out.view(-1, 9), self.scale, out=w.gy)
        self._backpropagate(w, tensors, grad_tensors, F, particles)
        grad_F.add_(grad_out)
        grad_F.view(-1, 9).add_(w.gx, alpha=RAW_GAIN)

    def __call__(self, F: Tensor, particles: Particles | None = None) -> Tensor:
        return self.corrected_of(F, self._twin(self.features_of(F), particles), self.scale)


class ObjectiveElastic(_Objective, ElasticLaw):
    """An isotropic elastic law whose four stress coefficients are a network of the strain's invariants.

    It is frame-indifferent, and its stress is zero at F = I for any weights (`network_kernels` has the formula).
    """

    outputs = network_kernels.STRESS_COEFFICIENTS
    unit = STRESS_SCALE
    readout = fused.STRESS
    stress_of = staticmethod(isotropic_stress)
    """Stress [Pa] of F and the coefficients in plain torch."""

    def forward(self, tensors, F, out, particles=None) -> None:
        w = self._evaluate(tensors, F, particles)
        launch(self.kernels(F).stress, F, F, w.y, self.scale, out)

    def adjoint(self, tensors, F, grad_out, grad_F, grad_tensors, particles=None) -> None:
        w = self._evaluate(tensors, F, particles)
        launch(self.kernels(F).stress_coefficients_adjoint, F, F, w.y, self.scale, grad_out, w.gy)
        self._backpropagate(w, tensors, grad_tensors, F, particles)
        launch(self.kernels(F).stress_adjoint, F, F, w.y, self.scale, grad_out, w.gx, grad_F)

    def __call__(self, F: Tensor, particles: Particles | None = None) -> Tensor:
        return self.stress_of(F, self._twin(self.features_of(F), particles), self.scale)

    def modulus(self) -> Tensor:
        """Return the secant P-wave modulus over F_11 = 1 +- 1e-3 [Pa], (S,)."""
        return self._modulus()


class ObjectivePlastic(_Objective, PlasticLaw):
    """A return map whose deviatoric and volumetric yield radii are a network of the strain's invariants.

    `network_kernels` has the formula.
    """

    identity = False
    outputs = network_kernels.YIELD_COEFFICIENTS
    unit = STRAIN_SCALE
    readout = fused.CORRECTION
    corrected_of = staticmethod(return_map)

    def forward(self, tensors, F, out, particles=None) -> None:
        w = self._evaluate(tensors, F, particles)
        launch(self.kernels(F).correction, F, F, w.y, self.scale, out)

    def adjoint(self, tensors, F, grad_out, grad_F, grad_tensors, particles=None) -> None:
        w = self._evaluate(tensors, F, particles)
        launch(self.kernels(F).correction_coefficients_adjoint, F, F, w.y, self.scale, 0, grad_out, w.gy)
        self._backpropagate(w, tensors, grad_tensors, F, particles)
        launch(self.kernels(F).correction_adjoint, F, F, w.y, self.scale, grad_out, w.gx, grad_F)

    def __call__(self, F: Tensor, particles: Particles | None = None) -> Tensor:
        return self.corrected_of(F, self._twin(self.features_of(F), particles), self.scale)
