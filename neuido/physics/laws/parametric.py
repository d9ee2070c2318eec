"""Laws with a few material parameters per scene, evaluated by the Warp kernels of `classical_kernels` or `extended_kernels`."""

import math
import numbers
from collections.abc import Hashable, Sequence
from typing import Any

import torch
from torch import Tensor

from neuido.errors import UserError
from neuido.physics.laws import classical_kernels, extended_kernels
from neuido.physics.laws.base import ElasticLaw, Law, Parameter, PlasticLaw
from neuido.physics.runtime.device import launch, real_of, torch_stream
from neuido.types import Particles, brief


def lame(young: Tensor, poisson: Tensor) -> tuple[Tensor, Tensor]:
    """Convert Young's modulus and Poisson's ratio to Lamé's parameters.

    Args:
        young: Young's modulus [Pa].
        poisson: Poisson's ratio [-].

    Returns:
        mu and lambda [Pa].
    """
    return young / (2 * (1 + poisson)), young * poisson / ((1 + poisson) * (1 - 2 * poisson))


def young_poisson(bulk: float, shear: float) -> tuple[float, float]:
    """Convert bulk and shear modulus [Pa] to Young's modulus [Pa] and Poisson's ratio [-]."""
    return 9 * bulk * shear / (3 * bulk + shear), (3 * bulk - 2 * shear) / (2 * (3 * bulk + shear))


# the open interval in which each parameter must lie, and its unit
_RANGES = {
    "young": (0.0, math.inf, " Pa"),
    "poisson": (-1.0, 0.5, ""),
    "yield_stress": (0.0, math.inf, " Pa"),
    "friction_angle": (0.0, 90.0, " degrees"),
    "c10": (0.0, math.inf, " Pa"),
    "c01": (0.0, math.inf, " Pa"),
    "shear": (0.0, math.inf, " Pa"),
    "bulk": (0.0, math.inf, " Pa"),
    "limit": (0.0, math.inf, ""),
    "exponent": (0.0, math.inf, ""),
    "compression": (0.0, 1.0, ""),
    "stretch": (0.0, math.inf, ""),
}
_MAY_BE_ZERO = ("c01",)


def checked_parameters(law: type, **values: Parameter) -> tuple[Tensor, ...]:
    """Validate the parameters of a law and expand them to one shape (S,).

    Args:
        law: Class of the law, for the errors.
        values: The parameters by name. A number becomes a float64 tensor on the device of the other parameters.

    Raises:
        UserError: A value of another type or shape, or out of its range.
    """
    tensors = []
    device = next((value.device for value in values.values() if isinstance(value, Tensor)), None)
    for name, value in values.items():
        low, high, unit = _RANGES[name]
        if not isinstance(value, Tensor):
            if isinstance(value, bool) or not isinstance(value, numbers.Real):
                hint = " (YAML reads 1e5 as text: write 1.0e+5)" if isinstance(value, str) else ""
                raise UserError(f"{law.__name__}: {name} = {value!r} is not a number{hint}")
            value = torch.tensor(float(value), dtype=torch.float64, device=device)
        if value.dtype not in (torch.float32, torch.float64) or value.ndim > 1 or value.numel() == 0:
            raise UserError(
                f"{law.__name__}: {name} is a {value.dtype} tensor of shape {tuple(value.shape)}; give float32 or float64, (S,)"
            )
        value = value.reshape(-1)
        above = value >= low if name in _MAY_BE_ZERO else value > low
        bad = ~(above & (value < high)).detach()
        if bad.any():
            least = ">=" if name in _MAY_BE_ZERO else ">"
            allowed = f"{name} {least} {low:g}" if high == math.inf else f"{low:g} < {name} < {high:g}"
            finite = " and finite" if high == math.inf else ""
            raise UserError(f"{law.__name__}: {name} = {value.detach()[bad][0].item():g}{unit} is out of range: need {allowed}{finite}")
        tensors.append(value)
    sizes = {name: t.shape[0] for name, t in zip(values, tensors)}
    scenes = max(sizes.values())
    if any(size not in (1, scenes) for size in sizes.values()):
        raise UserError(f"{law.__name__}: parameters have different lengths {sizes}; give one value, or one for each scene")
    return tuple(t.expand(scenes) for t in tensors)


class ParametricLaw(Law):
    """Base class of the classical laws, which may differ between scenes.

    A subclass defines `tensors`, with one tensor (S, n) of the n parameters of each scene's law, and `twin`, the law in plain torch.
    """

    kind: int
    """Number of the law in `classical_kernels` or `extended_kernels`."""
    columns = 1
    """Number of parameters of the law that the kernels read."""
    _plastic: bool
    """Whether the law is plastic."""

    def scene_laws(self) -> tuple[type["ParametricLaw"], ...]:
        """Return the class of each scene's law, S of them."""
        return (type(self),) * self.tensors()[0].shape[0]

    @staticmethod
    def twin(F: Tensor, parameters: Tensor) -> Tensor:
        """Evaluate the law in plain torch.

        Args:
            F: Deformation gradient [-], (..., 3, 3).
            parameters: The row of `tensors()` of each F, (..., n), broadcast against the leading axes of F.
        """
        raise NotImplementedError

    def kinds(self, device: torch.device) -> Tensor:
        """Return the number of each scene's law in the kernels, (S,) int32."""
        cache = self.__dict__.setdefault("_kind_cache", {})
        if device not in cache:  # recorded launches refer to the tensor by its address, so two threads must share one
            cache.setdefault(device, torch.tensor([law.kind for law in self.scene_laws()], dtype=torch.int32, device=device))
        return cache[device]

    @property
    def extended(self) -> bool:
        """Whether the law of a scene is one that only `extended_kernels` has."""
        last = classical_kernels.DRUCKER_PRAGER if self._plastic else classical_kernels.NEO_HOOKEAN
        if "_extended" not in self.__dict__:
            self.__dict__["_extended"] = any(law.kind > last for law in self.scene_laws())
        return self.__dict__["_extended"]

    def _launch(
        self, name: str, tensors: Sequence[Tensor], arrays: Sequence[Tensor], parameters: Tensor | None, particles: Particles
    ) -> None:
        F = arrays[0]
        kernel = getattr((extended_kernels if self.extended else classical_kernels).kernels(real_of(F.dtype)), name)
        row = tensors[0].detach().to(F).contiguous()
        inputs: list[Any] = [F, self.kinds(F.device), row, particles.scene, *arrays[1:]]
        if name.endswith("adjoint"):
            inputs.append(parameters)
        with torch_stream(F.device):
            launch(kernel, len(F), inputs, F.device)

    def single_scene(self, s: int) -> Law:
        laws = self.scene_laws()
        return _SingleScene(laws[min(s, len(laws) - 1)], self._plastic)

    def key(self, tensors: Sequence[Tensor]) -> Hashable:
        return tuple(law.__name__ for law in self.scene_laws())

    def forward(self, tensors: Sequence[Tensor], F: Tensor, out: Tensor, particles: Particles) -> None:
        self._launch("correct" if self._plastic else "stress", tensors, [F, out], None, particles)

    def adjoint(
        self,
        tensors: Sequence[Tensor],
        F: Tensor,
        grad_out: Tensor,
        grad_F: Tensor,
        grad_tensors: Sequence[Tensor | None],
        particles: Particles,
    ) -> None:
        name = "correct_adjoint" if self._plastic else "stress_adjoint"
        wanted = grad_tensors[0]
        if wanted is None or (wanted.dtype == F.dtype and wanted.device == F.device and wanted.is_contiguous()):
            self._launch(name, tensors, [F, grad_out, grad_F], wanted, particles)
        else:
            sink = torch.zeros(wanted.shape, dtype=F.dtype, device=F.device)
            self._launch(name, tensors, [F, grad_out, grad_F], sink, particles)
            wanted += sink.to(wanted)

    def __call__(self, F: Tensor, particles: Particles | None = None) -> Tensor:
        (parameters,), laws = self.tensors(), self.scene_laws()
        parameters = parameters.to(F)
        if len(laws) == 1:
            return laws[0].twin(F, parameters[0, : laws[0].columns])
        if particles is None:
            raise UserError(f"{type(self).__name__} has {len(laws)} scenes: give `particles`, the scene of each F")
        out = torch.zeros_like(F)
        scene = particles.scene.long()
        kinds = self.kinds(F.device)[scene]
        for law in dict.fromkeys(laws):
            (index,) = torch.nonzero(kinds == law.kind, as_tuple=True)
            out = out.index_copy(0, index, law.twin(F[index], parameters[scene[index], : law.columns]))
        return out

    def __repr__(self) -> str:
        parts = []
        for name, t in self._named().items():
            one = len(t.unique()) == 1
            parts.append(f"{name} {brief(t[0]) if one else f'{t.min():.4g} to {t.max():.4g}'}{_RANGES[name][2]}")
        scenes = len(self.scene_laws())
        values = ", ".join(parts if scenes == 1 else [*parts, f"{scenes} scenes"])
        return f"{type(self).__name__}({values})"

    def _named(self) -> dict[str, Tensor]:
        """Return the parameters that the constructor was given, by name."""
        return {name: t.detach() for name in _RANGES if isinstance(t := getattr(self, name, None), Tensor)}


class _SingleScene(ParametricLaw):
    """The law of one scene out of several; its tensors are passed to `forward`."""

    identity = False

    def __init__(self, law: type[ParametricLaw], plastic: bool):
        self._law, self._plastic = law, plastic

    def scene_laws(self) -> tuple[type[ParametricLaw], ...]:
        return (self._law,)


class ParametricElastic(ParametricLaw, ElasticLaw):
    """Base class of isotropic elastic laws; a subclass defines `moduli`."""

    _plastic = False

    def moduli(self) -> tuple[Tensor, Tensor]:
        """Return the shear and the bulk modulus at F = I [Pa], (S,) each."""
        raise NotImplementedError

    def modulus(self) -> Tensor:
        shear, bulk = self.moduli()
        return bulk + 4 / 3 * shear


class ParametricPlastic(ParametricLaw, PlasticLaw):
    """Base class of isotropic plastic laws."""

    _plastic = True
