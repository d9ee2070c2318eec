"""What a constitutive law is, and any torch function as one.

A law serves S scenes at once (S = 1: one law for all particles). Elastic laws give the Kirchhoff stress [Pa], plastic laws the corrected
deformation gradient of a trial one. Each has an engine form (`tensors`, `forward`, `adjoint`: no autograd) and a slow twin (`__call__`).
"""

from collections.abc import Callable, Hashable, Sequence
from itertools import pairwise

import torch
from torch import Tensor

from neuido.errors import UserError
from neuido.types import Particles

Parameter = float | Tensor
"""A number, or a tensor of shape (S,), which may require grad."""


class Law:
    """One elastic or one plastic law for S scenes."""

    def tensors(self) -> tuple[Tensor, ...]:
        """Return the differentiable inputs in the form that `forward` takes, each with leading S; graph nodes of the law's parameters."""
        raise NotImplementedError

    def forward(self, tensors: Sequence[Tensor], F: Tensor, out: Tensor, particles: Particles) -> None:
        """Write the law of F (P, 3, 3) into `out` (P, 3, 3); both contiguous, of one dtype and device, not aliased. No autograd.

        `tensors` are those of `tensors()`, brought to the dtype and device of F by the caller, once.
        """
        raise NotImplementedError

    def adjoint(
        self,
        tensors: Sequence[Tensor],
        F: Tensor,
        grad_out: Tensor,
        grad_F: Tensor,
        grad_tensors: Sequence[Tensor | None],
        particles: Particles,
    ) -> None:
        """Add the vector-Jacobian product to `grad_F` (P, 3, 3), contiguous, and to each of `grad_tensors` (None: not wanted)."""
        raise NotImplementedError

    def engine(self, tensors: Sequence[Tensor], particles: Particles) -> "Engine":
        """Return what runs this law in one rollout; a law with faster kernels for a device overrides it."""
        return Engine(self, tensors, particles)

    def single_scene(self, s: int) -> "Law":
        """Return this law for scene s; `forward` then gets that scene's rows of the tensors."""
        return self

    def key(self, tensors: Sequence[Tensor]) -> Hashable | None:
        """Return what, beside the shapes of its tensors, decides its launches with them; None: they may not be captured in a graph."""
        return None

    def __call__(self, F: Tensor, particles: Particles | None = None) -> Tensor:
        """Return the law of F in plain torch, for autograd. F (..., 3, 3) where S = 1, else (P, 3, 3) with its `particles`."""
        raise NotImplementedError


class Engine:
    """A law with its tensors and particles for the length of one rollout."""

    def __init__(self, law: Law, tensors: Sequence[Tensor], particles: Particles):
        self.law, self.tensors, self.particles = law, list(tensors), particles

    def forward(self, F: Tensor, out: Tensor) -> None:
        """`Law.forward`."""
        self.law.forward(self.tensors, F, out, self.particles)

    def start_adjoint(self, wanted: Sequence[bool]) -> None:
        """Zero the gradients of the tensors that are wanted."""
        self.grads = [torch.zeros_like(t) if want else None for t, want in zip(self.tensors, wanted, strict=True)]

    def adjoint(self, F: Tensor, grad_out: Tensor, grad_F: Tensor) -> None:
        """`Law.adjoint`, gathering the gradients of the tensors."""
        self.law.adjoint(self.tensors, F, grad_out, grad_F, self.grads, self.particles)

    def gradients(self) -> list[Tensor | None]:
        """Return the gradients of the tensors, after the last `adjoint`."""
        return self.grads


class EngineLaw(Law):
    """A law whose `engine` does all its work; a call outside a rollout makes one for itself."""

    def engine(self, tensors: Sequence[Tensor], particles: Particles) -> Engine:
        raise NotImplementedError

    def forward(self, tensors: Sequence[Tensor], F: Tensor, out: Tensor, particles: Particles) -> None:
        self.engine(tensors, particles).forward(F, out)

    def adjoint(
        self,
        tensors: Sequence[Tensor],
        F: Tensor,
        grad_out: Tensor,
        grad_F: Tensor,
        grad_tensors: Sequence[Tensor | None],
        particles: Particles,
    ) -> None:
        engine = self.engine(tensors, particles)
        engine.start_adjoint([False] * len(tensors))
        engine.grads = list(grad_tensors)
        engine.adjoint(F, grad_out, grad_F)


class ElasticLaw(Law):
    """F -> Kirchhoff stress tau [Pa]."""

    def modulus(self) -> Tensor:
        """P-wave modulus dtau_11/dF_11 at F = I [Pa], (S,)."""
        raise NotImplementedError


class PlasticLaw(Law):
    """Trial F -> corrected F."""

    identity: bool = False
    """True where the law returns F itself for every scene, so that a rollout may skip it."""


class AutogradLaw(Law):
    """Any torch function as a law; use `AutogradElastic` or `AutogradPlastic`.

    `function(F, *tensors)` is called once for each scene, with that scene's F (n, 3, 3) and each tensor indexed for the scene
    (leading S removed); it returns (n, 3, 3). With S = 1 that is one call for all particles. Its adjoint is torch.autograd.grad
    after a recomputation; in a rollout gradients reach F and `tensors`, not what the function closes over. Slow, general, and on CUDA
    not capturable where the function is not.
    """

    def __init__(self, function: Callable[..., Tensor], tensors: Sequence[Tensor] = ()):
        self.function = function
        self._tensors = tuple(tensors)
        sizes = {t.shape[0] if t.ndim else 0 for t in self._tensors}
        if len(sizes) > 1 or 0 in sizes:
            raise UserError(
                f"{type(self).__name__}: tensors need one leading axis of S scenes, got {[tuple(t.shape) for t in self._tensors]}"
            )
        self._scenes = sizes.pop() if sizes else 1

    def tensors(self) -> tuple[Tensor, ...]:
        return self._tensors

    def _ranges(self, particles: Particles) -> list[tuple[int, int, int]]:
        """(row of the tensors, first particle, end)."""
        if self._scenes == 1:
            return [(0, 0, particles.offsets[-1])]
        return [(s, first, end) for s, (first, end) in enumerate(pairwise(particles.offsets))]

    def forward(self, tensors: Sequence[Tensor], F: Tensor, out: Tensor, particles: Particles) -> None:
        with torch.no_grad():
            for s, first, end in self._ranges(particles):
                out[first:end] = self.function(F[first:end], *(t[s] for t in tensors))

    def adjoint(
        self,
        tensors: Sequence[Tensor],
        F: Tensor,
        grad_out: Tensor,
        grad_F: Tensor,
        grad_tensors: Sequence[Tensor | None],
        particles: Particles,
    ) -> None:
        for s, first, end in self._ranges(particles):
            with torch.enable_grad():
                local = F[first:end].detach().requires_grad_()
                leaves = [t[s].detach().requires_grad_(g is not None) for t, g in zip(tensors, grad_tensors)]
                wanted = [(leaf, g) for leaf, g in zip(leaves, grad_tensors) if g is not None]
                result = self.function(local, *leaves)
                if not result.requires_grad:
                    continue
                grads = torch.autograd.grad(result, [local, *(leaf for leaf, _ in wanted)], grad_out[first:end], allow_unused=True)
            if grads[0] is not None:
                grad_F[first:end] += grads[0]
            for grad, (_, sink) in zip(grads[1:], wanted):
                if grad is not None:
                    sink[s] += grad

    def __call__(self, F: Tensor, particles: Particles | None = None) -> Tensor:
        if self._scenes == 1:
            return self.function(F, *(t[0] for t in self._tensors))
        if particles is None:
            raise UserError(f"{type(self).__name__} holds {self._scenes} scenes: give `particles` to say which scene each F belongs to")
        return torch.cat([self.function(F[a:b], *(t[s] for t in self._tensors)) for s, a, b in self._ranges(particles)])

    def __repr__(self) -> str:
        return f"{type(self).__name__}({getattr(self.function, '__qualname__', self.function)}, {len(self._tensors)} tensors)"


class AutogradElastic(AutogradLaw, ElasticLaw):
    """A torch function F -> tau as an elastic law."""

    def __init__(self, function: Callable[..., Tensor], tensors: Sequence[Tensor] = (), *, modulus: Parameter):
        """
        Args:
            function: (F (n, 3, 3), *tensors of one scene) -> tau (n, 3, 3) [Pa].
            tensors: Differentiable inputs, each with leading S.
            modulus: P-wave modulus at F = I [Pa], a number or (S,); bounds the time step.
        """
        super().__init__(function, tensors)
        self._modulus = torch.as_tensor(modulus).reshape(-1).expand(self._scenes)

    def modulus(self) -> Tensor:
        return self._modulus


class AutogradPlastic(AutogradLaw, PlasticLaw):
    """A torch function, trial F -> corrected F, as a plastic law. Arguments as for `AutogradElastic`, without the modulus."""
