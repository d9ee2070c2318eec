"""The interface of a constitutive law, and adapters that turn any torch function into a law.

An elastic law maps the deformation gradient F to the Kirchhoff stress [Pa]. A plastic law maps a trial F to the corrected F. One law
object serves S scenes at once; with S = 1 it serves all particles. A rollout calls `tensors`, `forward` and `adjoint`, which do not use
autograd. Calling the law itself runs a slower implementation in plain torch, which autograd differentiates.
"""

import copy
from collections.abc import Callable, Hashable, Sequence
from itertools import pairwise

import torch
from torch import Tensor

from neuido.errors import UserError
from neuido.types import Particles

Parameter = float | Tensor
"""A number, or a tensor of shape (S,) that may require a gradient."""


class Law:
    """Base class of elastic and plastic laws for S scenes."""

    identity: bool = False
    """Whether the law returns F unchanged in every scene, so that a rollout may skip it."""

    strain_limit: float | None = None
    """Largest absolute logarithmic stretch for which the law is valid [-]; None: no limit."""

    def tensors(self) -> tuple[Tensor, ...]:
        """Return the differentiable inputs of `forward`, each with a leading axis of S scenes.

        They are computed from the law's parameters by torch operations, so that gradients flow back to the parameters.
        """
        raise NotImplementedError

    def forward(self, tensors: Sequence[Tensor], F: Tensor, out: Tensor, particles: Particles) -> None:
        """Evaluate the law without autograd.

        Args:
            tensors: The result of `tensors()`, converted to the dtype and device of F.
            F: Deformation gradient [-], (P, 3, 3), contiguous.
            out: Stress [Pa] or corrected F [-], (P, 3, 3), contiguous; overwritten. It must not share memory with F.
            particles: The scene of each particle.
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
        """Add the vector-Jacobian product of the law to the given gradients.

        Args:
            tensors: As for `forward`.
            F: As for `forward`.
            grad_out: Gradient of a loss with respect to the law's result, (P, 3, 3).
            grad_F: Gradient with respect to F, (P, 3, 3), contiguous; added to.
            grad_tensors: Gradient with respect to each tensor; added to. None where a gradient is not needed.
            particles: The scene of each particle.
        """
        raise NotImplementedError

    def engine(self, tensors: Sequence[Tensor], particles: Particles) -> "Engine":
        """Return the object that runs this law during one rollout. A law with faster kernels for a device overrides this method."""
        return Engine(self, tensors, particles)

    def single_scene(self, s: int) -> "Law":
        """Return this law for scene s alone; its `forward` takes the row of scene s of each tensor."""
        return self

    def key(self, tensors: Sequence[Tensor]) -> Hashable | None:
        """Return what determines the kernel launches of this law, apart from the shapes of its tensors.

        Two laws with equal keys may share a captured CUDA graph. None: the launches must not be captured.
        """
        return None

    def __call__(self, F: Tensor, particles: Particles | None = None) -> Tensor:
        """Evaluate the law in plain torch, differentiable by autograd.

        Args:
            F: Deformation gradient [-], (..., 3, 3); with several scenes (P, 3, 3).
            particles: The scene of each particle; needed with several scenes.
        """
        raise NotImplementedError


def strain_limit(*laws: Law | None) -> float | None:
    """Return the smallest `strain_limit` of some laws; None if no law has a limit."""
    limits = [law.strain_limit for law in laws if law is not None and law.strain_limit is not None]
    return min(limits, default=None)


class Engine:
    """A law bound to its tensors and particles for one rollout.

    Args:
        law: The law.
        tensors: Result of `law.tensors()`, in the dtype and on the device of the rollout.
        particles: The scene of each particle.
    """

    def __init__(self, law: Law, tensors: Sequence[Tensor], particles: Particles):
        self.law, self.tensors, self.particles = law, list(tensors), particles

    def forward(self, F: Tensor, out: Tensor) -> None:
        """Evaluate the law (`Law.forward`)."""
        self.law.forward(self.tensors, F, out, self.particles)

    def start_adjoint(self, wanted: Sequence[bool]) -> None:
        """Allocate zero gradients for the tensors that are marked in `wanted`, before the first `adjoint` of a backward pass."""
        self.grads = [torch.zeros_like(t) if want else None for t, want in zip(self.tensors, wanted, strict=True)]

    def adjoint(self, F: Tensor, grad_out: Tensor, grad_F: Tensor) -> None:
        """Add to `grad_F` and accumulate the gradients of the tensors (`Law.adjoint`)."""
        self.law.adjoint(self.tensors, F, grad_out, grad_F, self.grads, self.particles)

    def gradients(self) -> list[Tensor | None]:
        """Return the accumulated gradients of the tensors, once the last `adjoint` has run."""
        return self.grads


class EngineLaw(Law):
    """Base class of laws that are implemented by their engine; `forward` and `adjoint` create a temporary one."""

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
    """Map the deformation gradient F [-] to the Kirchhoff stress tau [Pa]."""

    viscosity: Tensor | None = None
    """Shear viscosity that the material brings beside its stress [Pa s], (S,); a rollout adds it to the effect `viscosity_shear`."""

    def modulus(self) -> Tensor:
        """Return the P-wave modulus d tau_11 / d F_11 at F = I [Pa], (S,); it bounds the stable time step."""
        raise NotImplementedError

    def particle_modulus(self) -> Tensor | None:
        """Return the P-wave modulus at each particle [Pa], (P,) float64, where it differs within a scene; else None."""
        return None

    def particle_viscosity(self) -> Tensor | None:
        """Return the shear viscosity at each particle [Pa s], (P,) float64, where laws of a scene bring one; else None."""
        return None


class PlasticLaw(Law):
    """Map the trial deformation gradient to the corrected one."""


class AutogradLaw(Law):
    """Base class of laws from a torch function; use `AutogradElastic` or `AutogradPlastic`.

    The function is called as `function(F, *tensors)` once for each scene, with the n particles of the scene, F (n, 3, 3), and the
    scene's row of each tensor. It returns (n, 3, 3). With S = 1 it is called once for all particles. The backward pass evaluates it again
    and calls `torch.autograd.grad`. In a rollout, gradients reach F and `tensors`, but no other tensor that the function uses. Such a
    law is slower than one with kernels, and its launches are not captured in a CUDA graph.
    """

    def __init__(self, function: Callable[..., Tensor], tensors: Sequence[Tensor] = (), *, fields: Sequence[str] = ()):
        self.function, self.fields = function, tuple(fields)
        self._given: tuple[tuple[Tensor, Tensor], ...] = ()
        self._tensors = tuple(tensors)
        sizes = {t.shape[0] if t.ndim else 0 for t in self._tensors}
        if len(sizes) > 1 or 0 in sizes:
            raise UserError(
                f"{type(self).__name__}: tensors have shapes {[tuple(t.shape) for t in self._tensors]}; "
                "give each the same leading axis, one row for each scene"
            )
        self._scenes = sizes.pop() if sizes else 1

    def tensors(self) -> tuple[Tensor, ...]:
        if self.fields:
            raise UserError(
                f"{type(self).__name__} takes the fields {', '.join(self.fields)}; give the law to a `Body` with these `fields`"
            )
        return (*self._tensors, *(value[rows][None] for value, rows in self._given))

    def with_fields(self, values: Sequence[Tensor], rows: Tensor) -> "AutogradLaw":
        """Return this law for some particles of a body.

        Args:
            values: Values of its fields at all particles of the body, (P, ...) each.
            rows: The particles, (n,).
        """
        law = copy.copy(self)
        law.fields, law._given = (), tuple((value, rows) for value in values)
        return law

    def _ranges(self, particles: Particles) -> list[tuple[int, int, int]]:
        """List the row of the tensors, the first particle and the end of each scene."""
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
            return self.function(F, *(t[0] for t in self.tensors()))
        if particles is None:
            raise UserError(f"{type(self).__name__} has {self._scenes} scenes: give `particles`, the scene of each F")
        return torch.cat([self.function(F[a:b], *(t[s] for t in self._tensors)) for s, a, b in self._ranges(particles)])

    def __repr__(self) -> str:
        return f"{type(self).__name__}({getattr(self.function, '__qualname__', self.function)}, {len(self._tensors)} tensors)"


class AutogradElastic(AutogradLaw, ElasticLaw):
    """An elastic law from a torch function F -> tau."""

    def __init__(self, function: Callable[..., Tensor], tensors: Sequence[Tensor] = (), *, modulus: Parameter, fields: Sequence[str] = ()):
        """
        Args:
            function: Maps F (n, 3, 3) and the tensors of one scene to tau [Pa], (n, 3, 3).
            tensors: Differentiable inputs, each with a leading axis of S scenes.
            modulus: P-wave modulus at F = I [Pa], a number or (S,); it bounds the time step.
            fields: Names of `Body.fields` that the function takes after the tensors, (n, ...) each.

        Raises:
            UserError: Tensors without a common leading axis.
        """
        super().__init__(function, tensors, fields=fields)
        self._modulus = torch.as_tensor(modulus).reshape(-1).expand(self._scenes)

    def modulus(self) -> Tensor:
        return self._modulus


class AutogradPlastic(AutogradLaw, PlasticLaw):
    """A plastic law from a torch function that maps the trial F to the corrected F.

    Args:
        function: Maps the trial F (n, 3, 3) and the tensors of one scene to the corrected F (n, 3, 3).
        tensors: Differentiable inputs, each with a leading axis of S scenes.
        fields: Names of `Body.fields` that the function takes after the tensors, (n, ...) each.

    Raises:
        UserError: Tensors without a common leading axis.
    """
