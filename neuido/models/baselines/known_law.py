"""System identification with a known constitutive family (PAC-NeRF, Li et al. 2023; GIC, Cai et al. 2024)."""

import math
from typing import Any

import torch
from torch import Tensor, nn

from neuido.data.files.renamed_options import renamed_options
from neuido.errors import UserError
from neuido.models.fewshot.method import Method, require_positive
from neuido.models.inference.prepared_scene import Laws, PreparedScene
from neuido.physics.effects.parameters import Effects
from neuido.physics.laws.classical import material
from neuido.types import ParticleState

PARTS = ("elasticity", "plasticity")


@renamed_options(free="free_parameters")
class KnownLaw(Method):
    """Fit the parameters of a given constitutive family by gradients through simulator and renderer (PAC-NeRF; GIC).

    The family is that of the true law if the scene has it, else that of the declared model. Young's modulus, yield stress and viscosity are
    fitted as decimal logarithms; Poisson's ratio and the friction angle are fitted within bounds.

    Args:
        young: Initial Young's modulus [Pa] (PAC-NeRF: 316228).
        poisson: Initial Poisson's ratio, between 0 and 0.49 (PAC-NeRF: 0.25).
        yield_stress: Initial yield stress [Pa] (GIC: 1000).
        friction_angle: Initial friction angle [degrees], between 1 and 60 (GIC: 10).
        viscosity: Initial Kelvin-Voigt shear viscosity [Pa s], which is fitted too; no viscosity where absent.
        free_parameters: Names of the parameters to fit; all that the family has where absent.
        rates: Learning rates that replace those of `RATES`: decades for logarithms, absolute for Poisson's ratio, degrees for the angle.

    Raises:
        UserError: An initial value is out of range, or a name is unknown.
    """

    RATES = {"young": 0.1, "poisson": 0.01, "yield_stress": 0.1, "friction_angle": 1.0, "viscosity": 0.05}
    """Learning rates of PAC-NeRF and GIC."""
    BOUNDS = {"poisson": (0.0, 0.49), "friction_angle": (1.0, 60.0)}

    steps = 100

    def __init__(
        self,
        young: float = 316228.0,
        poisson: float = 0.25,
        yield_stress: float = 1e3,
        friction_angle: float = 10.0,
        viscosity: float | None = None,
        free_parameters: list[str] | None = None,
        rates: dict[str, float] | None = None,
    ):
        super().__init__()
        require_positive(young=young, yield_stress=yield_stress, **({} if viscosity is None else {"viscosity": viscosity}))
        self.start = {"young": young, "poisson": poisson, "yield_stress": yield_stress, "friction_angle": friction_angle}
        if viscosity is not None:
            self.start["viscosity"] = viscosity
        for name, (low, high) in self.BOUNDS.items():
            if not low < self.start[name] < high:
                raise UserError(f"model.method.{name} = {self.start[name]}: it must lie between {low:g} and {high:g}")
        for option, names in (("free_parameters", free_parameters or []), ("rates", rates or {})):
            for name in names:
                if name not in self.RATES or (option == "free_parameters" and name not in self.start):
                    raise UserError(f"model.method.{option}: there is no parameter {name!r}; they are {', '.join(self.start)}")
        require_positive(**{f"rates.{name}": rate for name, rate in (rates or {}).items()})
        self.free_parameters, self.rates = free_parameters, {**self.RATES, **(rates or {})}

    def build(self, scene: PreparedScene) -> None:
        truth = scene.source.truth
        law = scene.source.model if truth is None else truth.law
        self.families = {part: law[part]["law"] for part in PARTS}
        own = [name for part in PARTS for name in law[part] if name != "law"] + ["viscosity"]
        names = [name for name in self.start if name in own]
        self.raw = nn.ParameterDict({name: nn.Parameter(torch.tensor(self._inverse(name)), self._is_free(name)) for name in names})

    def _is_free(self, name: str) -> bool:
        return self.free_parameters is None or name in self.free_parameters

    def _inverse(self, name: str) -> float:
        value = self.start[name]
        if name not in self.BOUNDS:
            return math.log10(value)
        low, high = self.BOUNDS[name]
        half = (high - low) / 2
        return half * math.atanh((value - low) / half - 1)

    def values(self) -> dict[str, Tensor]:
        """Return the parameters in SI units and degrees, differentiable, () each."""
        values = {}
        for name, raw in self.raw.items():
            if name in self.BOUNDS:  # slope one at the centre, so that a rate has the unit of the parameter (PAC-NeRF)
                low, high = self.BOUNDS[name]
                half = (high - low) / 2
                values[name] = low + half * (1 + (raw / half).tanh())
            else:
                values[name] = 10**raw
        return values

    def laws(self, scene: PreparedScene) -> Laws:
        values = self.values()
        elastic = {"law": self.families["elasticity"], "young": values["young"], "poisson": values["poisson"]}
        plastic = {name: values[name] for name in ("yield_stress", "friction_angle") if name in values}
        return material(elastic, {"law": self.families["plasticity"], **plastic})

    def rollout(self, scene: PreparedScene, frames: int, *, effects: Effects | None = None, **options) -> ParticleState:
        if "viscosity" in self.raw:
            effects = Effects() if effects is None else effects
            known = 0.0 if effects.viscosity_shear is None else effects.viscosity_shear
            effects = effects._replace(viscosity_shear=self.values()["viscosity"] + known)
        return super().rollout(scene, frames, effects=effects, **options)

    def parameter_groups(self) -> list[dict[str, Any]]:
        return [{"params": [raw], "lr": self.rates[name]} for name, raw in self.raw.items() if raw.requires_grad]

    def describe(self) -> dict[str, Any]:
        return {**self.families, **{name: float(value.detach()) for name, value in self.values().items()}}
