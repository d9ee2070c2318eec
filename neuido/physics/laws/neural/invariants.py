"""NCLaw's networks as laws (Ma et al. 2023, class `InvariantFullMeta`): three layers without bias on invariants of F.

In a rollout, Warp kernels compute the features and the read-out (`invariant_kernels`) and torch multiplies the matrices. Each engine
owns its buffers, so that the rollout may be captured in a CUDA graph. Calling a law evaluates it in plain torch.
"""

from collections.abc import Hashable, Sequence

import torch
from torch import Tensor
from torch.nn import functional

from neuido.errors import UserError
from neuido.physics.laws.base import ElasticLaw, Engine, EngineLaw, PlasticLaw
from neuido.physics.laws.neural import invariant_kernels
from neuido.physics.laws.neural.invariant_kernels import EPSILON, FEATURES, TIE
from neuido.physics.laws.neural.layers import linear, linear_adjoint
from neuido.physics.linalg import decompositions as linalg
from neuido.physics.runtime import device
from neuido.physics.runtime.device import real_of, torch_stream
from neuido.physics.runtime.internals import gelu_adjoint_into, gelu_into
from neuido.types import Particles

PLASTIC_SCALE = 1e-3
"""Factor of the plastic correction in NCLaw: F_hat = F + 1e-3 R X."""


class InvariantEngine(Engine):
    """The engine of an invariant network, with its own buffers for the intermediate results and their adjoints.

    Args:
        law: The law.
        tensors: Result of `law.tensors()`, in the dtype and on the device of the rollout.
        particles: The scene of each particle.
    """

    law: "_Invariant"

    def __init__(self, law: "_Invariant", tensors: Sequence[Tensor], particles: Particles):
        super().__init__(law, [t.detach() for t in tensors], particles)
        count, like = particles.offsets[-1], self.tensors[0]
        first, second = (t.shape[1] for t in self.tensors[:2])
        widths = {"x": FEATURES, "z1": first, "h1": first, "z2": second, "h2": second, "y": 9}
        self.buffer = {name: like.new_empty(count, width) for name, width in widths.items()}
        self.R = like.new_empty(count, 3, 3)
        self.kernels = invariant_kernels.build(real_of(like.dtype))

    def _launch(self, kernel, *arguments) -> None:
        with torch_stream(self.R.device):
            device.launch(kernel, len(self.R), arguments, self.R.device)

    def _evaluate(self, F: Tensor) -> None:
        b, offsets = self.buffer, self.particles.offsets
        self._launch(self.kernels.features, F, b["x"], self.R)
        for W, x, z, h in ((0, "x", "z1", "h1"), (1, "h1", "z2", "h2")):
            linear(b[x], self.tensors[W], None, offsets, b[z])
            gelu_into(b[z], b[h])
        linear(b["h2"], self.tensors[2], None, offsets, b["y"])

    def forward(self, F: Tensor, out: Tensor) -> None:
        self._evaluate(F)
        readout = self.kernels.stress if self.law.elastic else self.kernels.correction
        self._launch(readout, F, self.R, self.buffer["y"], self.law.scale, out)

    def start_adjoint(self, wanted: Sequence[bool]) -> None:
        super().start_adjoint(wanted)
        self.adjoints = {name: torch.empty_like(self.buffer[name]) for name in ("x", "h1", "h2", "y")}

    def adjoint(self, F: Tensor, grad_out: Tensor, grad_F: Tensor) -> None:
        self._evaluate(F)
        b, g, elastic = self.buffer, self.adjoints, int(self.law.elastic)
        self._launch(self.kernels.outputs_adjoint, F, self.R, self.law.scale, elastic, grad_out, g["y"])
        self._layer_adjoint(2, "h2", g["y"])
        self._layer_adjoint(1, "h1", self._gelu_adjoint("h2", "z2"))
        self._layer_adjoint(0, "x", self._gelu_adjoint("h1", "z1"))
        self._launch(self.kernels.gradient_adjoint, F, self.R, b["y"], self.law.scale, elastic, grad_out, g["x"], grad_F)

    def _gelu_adjoint(self, h: str, z: str) -> Tensor:
        grad = self.adjoints[h]
        gelu_adjoint_into(grad, self.buffer[z], grad)
        return grad

    def _layer_adjoint(self, i: int, x: str, grad: Tensor) -> None:
        linear_adjoint(self.buffer[x], self.tensors[i], grad, self.particles.offsets, None, self.adjoints[x], self.grads[i], None)


class _Invariant(EngineLaw):
    """Base class of the elastic and the plastic network.

    Args:
        W1: Weights of the first layer, (1 or S, hidden, 13); with a leading 1 all scenes share them.
        W2: Weights of the second layer, (1 or S, hidden, hidden).
        W3: Weights of the last layer, (1 or S, 9, hidden).

    Raises:
        UserError: Shapes that do not agree.
    """

    elastic: bool
    scale: float

    def __init__(self, W1: Tensor, W2: Tensor, W3: Tensor):
        scenes, hidden = max(len(W) for W in (W1, W2, W3)), W1.shape[-2]
        for name, W, shape in (("W1", W1, (hidden, FEATURES)), ("W2", W2, (hidden, hidden)), ("W3", W3, (9, hidden))):
            if tuple(W.shape[1:]) != shape or len(W) not in (1, scenes):
                needed = f"(1 or {scenes}, {shape[0]}, {shape[1]})"
                raise UserError(f"{type(self).__name__}: {name} has shape {tuple(W.shape)}; needed {needed}")
        self.weights = (W1, W2, W3)

    def tensors(self) -> tuple[Tensor, ...]:
        """Return W1, W2 and W3."""
        return self.weights

    def engine(self, tensors: Sequence[Tensor], particles: Particles) -> Engine:
        return InvariantEngine(self, tensors, particles)

    def key(self, tensors: Sequence[Tensor]) -> Hashable:
        return type(self).__name__, self.scale

    def _network(self, F: Tensor, s: int) -> Tensor:
        """Evaluate R X with the weights of scene s in plain torch, (..., 3, 3)."""
        W1, W2, W3 = (W[min(s, len(W) - 1)].to(F.dtype) for W in self.weights)
        hidden = functional.gelu(functional.linear(functional.gelu(functional.linear(features(F), W1)), W2))
        Y = functional.linear(hidden, W3).unflatten(-1, (3, 3))
        return linalg.polar(F)[0] @ (0.5 * (Y + Y.mT))

    def _readout(self, F: Tensor, RX: Tensor) -> Tensor:
        raise NotImplementedError

    def __call__(self, F: Tensor, particles: Particles | None = None) -> Tensor:
        if max(len(W) for W in self.weights) == 1:
            return self._readout(F, self._network(F, 0))
        if particles is None:
            raise UserError(f"{type(self).__name__} has several scenes: give `particles`, the scene of each F")
        ends = zip(particles.offsets[:-1], particles.offsets[1:])
        return torch.cat([self._readout(F[i:j], self._network(F[i:j], s)) for s, (i, j) in enumerate(ends)])

    def __repr__(self) -> str:
        return f"{type(self).__name__}({max(len(W) for W in self.weights)} scenes, {self.weights[0].shape[1]} hidden units)"


class InvariantElastic(_Invariant, ElasticLaw):
    """NCLaw's elastic network: tau = R X F^T [Pa].

    X is the symmetric part of the network's outputs, and R the rotation of F.
    """

    elastic, scale = True, 1.0

    def _readout(self, F: Tensor, RX: Tensor) -> Tensor:
        return self.scale * RX @ F.mT

    def modulus(self) -> Tensor:
        """Return the secant P-wave modulus over F_11 = 1 +- 1e-3 [Pa], (S,), computed in float64."""
        step, like = 1e-3, self.weights[0]
        F = torch.eye(3, dtype=torch.float64, device=like.device).repeat(2, 1, 1)
        F[:, 0, 0] += torch.tensor([step, -step], dtype=torch.float64, device=like.device)
        with torch.no_grad():
            tau = [self._readout(F, self._network(F, s))[:, 0, 0] for s in range(max(len(W) for W in self.weights))]
        return torch.stack([(t[0] - t[1]) / (2 * step) for t in tau])


class InvariantPlastic(_Invariant, PlasticLaw):
    """NCLaw's plastic network: F_hat = F + 1e-3 R X.

    X is the symmetric part of the network's outputs, and R the rotation of F.
    """

    elastic, scale, identity = False, PLASTIC_SCALE, False

    def _readout(self, F: Tensor, RX: Tensor) -> Tensor:
        return F + self.scale * RX


def features(F: Tensor) -> Tensor:
    """Compute the inputs of an invariant network: sigma - 1, F^T F - I and det F - 1.

    In the backward pass, equal singular values share the mean of their gradients.

    Args:
        F: Deformation gradient [-], (..., 3, 3).

    Returns:
        Features [-], (..., 13).
    """
    eye = torch.eye(3, dtype=F.dtype, device=F.device)
    sigma = linalg.frame(F).sigma
    sigma = (_ties(sigma.detach()) @ sigma.unsqueeze(-1)).squeeze(-1)
    G = F - eye
    strain = (G + G.mT + G.mT @ G).flatten(-2)
    return torch.cat([sigma - 1, strain, torch.linalg.det(F).unsqueeze(-1) - 1], -1)


def _ties(sigma: Tensor) -> Tensor:
    """Return matrices (..., 3, 3) that replace each of three descending values (..., 3) by the mean of those equal to it."""
    tie = TIE * EPSILON[real_of(sigma.dtype)]
    gaps = sigma[..., :-1] - sigma[..., 1:]
    group = torch.cat([torch.zeros_like(gaps[..., :1]), (gaps > tie).to(sigma.dtype).cumsum(-1)], -1)
    equal = (group.unsqueeze(-1) == group.unsqueeze(-2)).to(sigma.dtype)
    return equal / equal.sum(-1, keepdim=True)
