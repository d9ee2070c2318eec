"""What peers do with the images of a scene, each as a `Method`.

Here: the parameters of a known law (PAC-NeRF, GIC), NCLaw's networks, NeuMA, UniPhy, and latents as given. Mass-spring and the symbolic
law are in `springs` and `symbolic`. Rates and steps that a peer publishes are the defaults.
"""

import math
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn

from neuido.data.bodies.scene_files import data_root
from neuido.errors import UserError
from neuido.models.fewshot.method import Laws, Method
from neuido.models.inference.pipeline import Prepared
from neuido.models.operator.branch import small_strain_modulus
from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
from neuido.physics.effects.parameters import Effects
from neuido.physics.laws.classical import material
from neuido.physics.laws.neural.invariants import InvariantElastic, InvariantPlastic
from neuido.types import ParticleState

LAYERS = (("layers.0", (64, 13)), ("layers.1", (64, 64)), ("final_layer", (9, 64)))
PARTS = ("elasticity", "plasticity")
MATERIALS = {"identity": "jelly", "von_mises": "plasticine", "drucker_prager": "sand"}
"""NCLaw's material for a plasticity; NeuMA chooses so for its six scenes."""


def nclaw(path: str | Path) -> tuple[InvariantElastic, InvariantPlastic]:
    """NCLaw's trained laws (Ma et al. 2023, `InvariantFullMeta`); see `physics.invariants`.

    Args:
        path: npz file with `elasticity.*` and `plasticity.*`, each `layers.0`, `layers.1` and `final_layer`.

    Returns:
        (elastic law, plastic law) for one scene or shared by all.

    Raises:
        UserError: the file is missing or holds other arrays.
    """
    elastic, plastic = nclaw_weights(path)
    return InvariantElastic(*(w[None] for w in elastic)), InvariantPlastic(*(w[None] for w in plastic))


def nclaw_weights(path: str | Path) -> tuple[list[Tensor], list[Tensor]]:
    """The three layers of the elastic and of the plastic network, (64, 13), (64, 64) and (9, 64) each.

    Raises:
        UserError: As `nclaw`.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"NCLaw's weights {path} are missing: give the path of an nclaw-*.npz file")
    try:
        with np.load(path, allow_pickle=False) as arrays:
            weights = {name: torch.from_numpy(arrays[name]) for name in arrays.files}
    except (ValueError, OSError, EOFError) as error:
        raise UserError(f"NCLaw's weights {path} are no npz file: {error}") from error
    return tuple([_layer(weights, f"{part}.{name}", shape, path) for name, shape in LAYERS] for part in PARTS)  # type: ignore[return-value]


def _layer(weights: dict[str, Tensor], name: str, shape: tuple[int, int], path: Path) -> Tensor:
    found = [w for key, w in weights.items() if key.startswith(name)]
    if len(found) != 1 or tuple(found[0].shape) != shape:
        raise UserError(f"{path}: no array {name} of shape {shape}; it has {', '.join(sorted(weights))}")
    return found[0]


def positive(**values: float) -> None:
    """Refuse options of a method that are not positive numbers.

    Raises:
        UserError: Names the option and the value.
    """
    for name, value in values.items():
        if not 0 < value < math.inf:
            raise UserError(f"model.method.{name} = {value}: it must be positive")


# A law whose family is known.


class KnownLaw(Method):
    """The parameters of a law whose family is given, by gradient through simulator and renderer (PAC-NeRF; GIC).

    The family is that of the truth where a scene knows it, else that of the believed model. Young's modulus, yield stress and viscosity are
    fitted as decimal logarithms, Poisson's ratio and the friction angle within bounds.

    Args:
        young: Start of Young's modulus [Pa] (PAC-NeRF: 316228).
        poisson: Start of Poisson's ratio, between 0 and 0.49 (PAC-NeRF: 0.25).
        yield_stress: Start of the yield stress [Pa] (GIC: 1000).
        friction_angle: Start of the friction angle [degrees], between 1 and 60 (GIC: 10).
        viscosity: Start of a Kelvin-Voigt shear viscosity [Pa s], fitted too; none: the body has none.
        free: Which of these are fitted, of those that the family has; all where absent.
        rates: Rates of some, in decades, Poisson's ratio, degrees; the others as `RATES`.

    Raises:
        UserError: A start outside its range, an unknown name.
    """

    RATES = {"young": 0.1, "poisson": 0.01, "yield_stress": 0.1, "friction_angle": 1.0, "viscosity": 0.05}
    """PAC-NeRF's and GIC's."""
    BOUNDS = {"poisson": (0.0, 0.49), "friction_angle": (1.0, 60.0)}

    steps = 100

    def __init__(
        self,
        young: float = 316228.0,
        poisson: float = 0.25,
        yield_stress: float = 1e3,
        friction_angle: float = 10.0,
        viscosity: float | None = None,
        free: list[str] | None = None,
        rates: dict[str, float] | None = None,
    ):
        super().__init__()
        positive(young=young, yield_stress=yield_stress, **({} if viscosity is None else {"viscosity": viscosity}))
        self.start = {"young": young, "poisson": poisson, "yield_stress": yield_stress, "friction_angle": friction_angle}
        if viscosity is not None:
            self.start["viscosity"] = viscosity
        for name, (low, high) in self.BOUNDS.items():
            if not low < self.start[name] < high:
                raise UserError(f"model.method.{name} = {self.start[name]}: it must lie between {low:g} and {high:g}")
        for option, names in (("free", free or []), ("rates", rates or {})):
            for name in names:
                if name not in self.RATES or (option == "free" and name not in self.start):
                    raise UserError(f"model.method.{option}: there is no parameter {name!r}; they are {', '.join(self.start)}")
        positive(**{f"rates.{name}": rate for name, rate in (rates or {}).items()})
        self.free, self.rates = free, {**self.RATES, **(rates or {})}

    def build(self, scene: Prepared) -> None:
        truth = scene.source.truth
        law = scene.source.model if truth is None else truth.law
        self.families = {part: law[part]["law"] for part in PARTS}
        own = [name for part in PARTS for name in law[part] if name != "law"] + ["viscosity"]
        names = [name for name in self.start if name in own]
        self.raw = nn.ParameterDict({name: nn.Parameter(torch.tensor(self._inverse(name)), self._is_free(name)) for name in names})

    def _is_free(self, name: str) -> bool:
        return self.free is None or name in self.free

    def _inverse(self, name: str) -> float:
        value = self.start[name]
        if name not in self.BOUNDS:
            return math.log10(value)
        low, high = self.BOUNDS[name]
        half = (high - low) / 2
        return half * math.atanh((value - low) / half - 1)

    def values(self) -> dict[str, Tensor]:
        """The parameters in SI units and degrees, differentiable, () each."""
        values = {}
        for name, raw in self.raw.items():
            if name in self.BOUNDS:  # of slope one in the middle, so that a rate has the parameter's own unit (PAC-NeRF)
                low, high = self.BOUNDS[name]
                half = (high - low) / 2
                values[name] = low + half * (1 + (raw / half).tanh())
            else:
                values[name] = 10**raw
        return values

    def laws(self, scene: Prepared) -> Laws:
        values = self.values()
        elastic = {"law": self.families["elasticity"], "young": values["young"], "poisson": values["poisson"]}
        plastic = {name: values[name] for name in ("yield_stress", "friction_angle") if name in values}
        return material(elastic, {"law": self.families["plasticity"], **plastic})

    def roll(self, scene: Prepared, frames: int, *, effects: Effects | None = None, **options) -> ParticleState:
        if "viscosity" in self.raw:
            effects = Effects() if effects is None else effects
            known = 0.0 if effects.viscosity_shear is None else effects.viscosity_shear
            effects = effects._replace(viscosity_shear=self.values()["viscosity"] + known)
        return super().roll(scene, frames, effects=effects, **options)

    def parameter_groups(self) -> list[dict[str, Any]]:
        return [{"params": [raw], "lr": self.rates[name]} for name, raw in self.raw.items() if raw.requires_grad]

    def describe(self) -> dict[str, Any]:
        return {**self.families, **{name: float(value.detach()) for name, value in self.values().items()}}


# NCLaw's networks, as given and adapted.


class LowRank(nn.Module):
    """W + alpha / r B A with a fixed W (m, n): A (r, n) by Kaiming, B (m, r) zero at the start (NeuMA, `loralib`)."""

    def __init__(self, weight: Tensor, rank: int, alpha: float, generator: torch.Generator):
        super().__init__()
        self.scale = alpha / rank
        self.register_buffer("weight", weight)
        self.A = nn.Parameter(torch.empty(rank, weight.shape[1]))
        self.B = nn.Parameter(torch.zeros(weight.shape[0], rank))
        nn.init.kaiming_uniform_(self.A, a=math.sqrt(5), generator=generator)

    def forward(self) -> Tensor:
        return self.weight + self.scale * self.B @ self.A


class NCLaw(Method):
    """NCLaw's networks as they were trained, without any image (Ma et al. 2023).

    Args:
        weights: Folder of nclaw-{jelly,plasticine,sand}.npz, or one such file for every scene; none: `peers` in the data folder.
        base: Which of the three; `auto`: by the plasticity of the scene's believed model, as NeuMA chooses for its scenes.

    Raises:
        UserError: In `build`: no such file.
    """

    steps = 0

    def __init__(self, weights: str | None = None, base: Literal["auto", "jelly", "plasticine", "sand"] = "auto"):
        super().__init__()
        self.source, self.base = weights, base

    def build(self, scene: Prepared) -> None:
        self.chosen = MATERIALS[scene.source.model["plasticity"]["law"]] if self.base == "auto" else self.base
        self._take(*nclaw_weights(self._file()))

    def _file(self) -> Path:
        given = Path(self.source).expanduser() if self.source is not None else None
        if given is not None and not given.is_dir():
            return given
        if given is None:
            try:
                given = data_root() / "peers"
            except UserError as error:
                raise UserError("model.method.weights: give the folder of nclaw-*.npz, or set the variable NEUIDO_DATA") from error
        return given / f"nclaw-{self.chosen}.npz"

    def _take(self, elastic: list[Tensor], plastic: list[Tensor]) -> None:
        for part, weights in zip(PARTS, (elastic, plastic)):
            for i, weight in enumerate(weights):
                self.register_buffer(f"{part}_{i}", weight)

    def _layers(self, part: str) -> list[Tensor]:
        return [getattr(self, f"{part}_{i}")[None] for i in range(len(LAYERS))]

    def laws(self, scene: Prepared) -> Laws:
        return InvariantElastic(*self._layers("elasticity")), InvariantPlastic(*self._layers("plasticity"))

    def describe(self) -> dict[str, Any]:
        return {"base": self.chosen, "modulus": float(InvariantElastic(*self._layers("elasticity")).modulus()[0])}


class NeuMA(NCLaw):
    """NCLaw's networks with LoRA on every layer, by RAdam over a thousand steps (Cao et al. 2024, configs/synthetic).

    Args:
        weights, base: As for `NCLaw`.
        rank, alpha: Of the LoRA.
        elastic_rate, plastic_rate: Rates; where absent NeuMA's for the base: 0.008, 0.02 or 0.005, and a tenth of it.
        seed: Of the first factors.

    Raises:
        UserError: A rank below one, an alpha or a rate that is not positive.
    """

    RATES = {"jelly": (0.008, 0.025), "plasticine": (0.02, 0.01), "sand": (0.005, 0.04)}
    """The elastic rate, and the share of the rates at which their cosine ends."""

    steps = 1000

    def __init__(
        self,
        weights: str | None = None,
        base: Literal["auto", "jelly", "plasticine", "sand"] = "auto",
        rank: int = 16,
        alpha: float = 16.0,
        elastic_rate: float | None = None,
        plastic_rate: float | None = None,
        seed: int = 0,
    ):
        super().__init__(weights, base)
        if rank < 1:
            raise UserError(f"model.method.rank = {rank}: at least 1 is needed")
        given = {"elastic_rate": elastic_rate, "plastic_rate": plastic_rate}
        positive(alpha=alpha, **{name: value for name, value in given.items() if value is not None})
        self.rank, self.alpha, self.given, self.seed = rank, alpha, (elastic_rate, plastic_rate), seed

    def _take(self, elastic: list[Tensor], plastic: list[Tensor]) -> None:
        generator = torch.Generator().manual_seed(self.seed)
        parts = zip(PARTS, (elastic, plastic))
        lora = {part: nn.ModuleList(LowRank(w, self.rank, self.alpha, generator) for w in weights) for part, weights in parts}
        self.lora = nn.ModuleDict(lora)

    def _layers(self, part: str) -> list[Tensor]:
        return [layer()[None] for layer in self.lora[part]]

    def parameter_groups(self) -> list[dict[str, Any]]:
        usual = self.RATES[self.chosen][0]
        rates = (self.given[0] or usual, self.given[1] or 0.1 * usual)
        return [{"params": list(self.lora[part].parameters()), "lr": rate} for part, rate in zip(PARTS, rates)]

    def optimizer(self, groups: list[dict[str, Any]]) -> torch.optim.Optimizer:
        return torch.optim.RAdam(groups)

    def rate(self, done: float) -> float:
        last = self.RATES[self.chosen][1]
        return last + (1 - last) * super().rate(done)


# Latents of Stage I.


class _Latent(Method):
    """A latent z of the frozen operator; not a method by itself.

    Args:
        operator: File of the operator, or `pretrained`.
    """

    def __init__(self, operator: str = "pretrained"):
        super().__init__()
        self.operator = IntrinsicDynamicsOperator.load(operator).eval().requires_grad_(False)
        if not len(self.operator.latents):
            raise UserError(f"model.method.operator = {operator} holds no latents of Stage I to start from")

    def laws(self, scene: Prepared) -> Laws:
        return self.operator.laws(self.z)

    def describe(self) -> dict[str, Any]:
        with torch.no_grad():
            modulus = float(small_strain_modulus(self.operator, self.z[None])[0])
        return {"modulus": modulus, "z": self.z.detach().cpu().tolist()}


class MeanLatent(_Latent):
    """The mean of Stage I's latents for every scene; nothing is learned."""

    steps = 0

    def build(self, scene: Prepared) -> None:
        self.register_buffer("z", self.operator.latents.mean(0))


class RandomLatent(_Latent):
    """A random latent; nothing is learned.

    Args:
        operator: File of the operator, or `pretrained`.
        of: `normal`: of the mean and deviation of Stage I's latents; `trained`: one of Stage I's at random.
        seed: Which.
    """

    steps = 0

    def __init__(self, operator: str = "pretrained", of: Literal["normal", "trained"] = "normal", seed: int = 0):
        super().__init__(operator)
        self.of, self.seed = of, seed

    def build(self, scene: Prepared) -> None:
        generator, latents = torch.Generator().manual_seed(self.seed), self.operator.latents
        z = self.operator.random_latents(1, generator)[0]
        if self.of == "trained":
            z = latents[int(torch.randint(len(latents), (), generator=generator))].clone()
        self.register_buffer("z", z)


class UniPhy(_Latent):
    """The latent alone, from the mean latent, by gradient through simulator and renderer; trunks and heads are frozen (Mittal et al. 2025).

    UniPhy's own operator is published without weights, so that ours, which is trained in the same way, takes its place.

    Args:
        operator: File of the operator, or `pretrained`.
        lr: Rate of the latent.
    """

    steps = 100

    def __init__(self, operator: str = "pretrained", lr: float = 0.05):
        super().__init__(operator)
        positive(lr=lr)
        self.lr = lr

    def build(self, scene: Prepared) -> None:
        self.z = nn.Parameter(self.operator.latents.mean(0).clone())
