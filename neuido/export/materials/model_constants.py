"""The constants of a declared or corrected model, in the quantities in which finite-element programs take them.

Conversions that all cards share, with a the norm of the plastic strain (tensor) and e = sqrt(2/3) a the equivalent one:

    yield       |dev tau| = tau_Y       ->  uniaxial sqrt(3/2) tau_Y
    hardening   tau_Y + H a             ->  uniaxial slope 3/2 H over e
    kinematic   backstress' = H_k e_p'  ->  modulus C = 3/2 H_k
    Perzyna     a' = <|s| - tau_Y>/eta  ->  e' = 2/3 (sigma - sigma_Y)/eta
    relaxation  G(t) = mu (1 + sum g_i exp(-t/T_i)), bulk modulus without relaxation
    cone        tan beta = 6 sin phi/(3 - sin phi) in the plane of sqrt(3/2)|s| and pressure (Drucker and Prager 1952, triaxial compression)
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import torch

from neuido.data.files.parsing import naming, read_yaml
from neuido.data.files.values import mapping
from neuido.data.measured.columns import read_effects
from neuido.data.measured.experiment import read_model
from neuido.errors import UserError, suggest
from neuido.physics.effects.coefficients import hysteresis_spectrum
from neuido.physics.effects.parameters import LIBRARY
from neuido.physics.laws.parametric import young_poisson

ROOT = math.sqrt(1.5)
MODEL_FILES = ("model_after.yaml", "experiment.yaml", "test.yaml", "scene.yaml")
"""Files of a folder in which a model is looked for, in this order."""
SURROUNDINGS = (
    "gravity", "uniform_acceleration", "drag_linear", "drag_quadratic", "magnus", "position_force", "time_force", "friction", "stick",
    "restitution", "added_mass", "spin_decay",
)  # fmt: skip
"""Effects that belong to the surroundings or to the contact, of which no material card speaks."""
SPECTRUM = 5
"""Relaxation times of the effect `relaxation_spectrum`."""
ELASTIC_WORDS = {"fixed_corotated": "fixed corotated", "sigma": "Hencky", "neo_hookean": "neo-Hookean"}


class Units(NamedTuple):
    """A consistent system of units: factors from SI."""

    name: str
    length: float
    stress: float
    density: float

    @property
    def words(self) -> str:
        """The units in words."""
        return "m, kg, s, N, Pa" if self.name == "si" else "mm, tonne, s, N, MPa"


UNITS = {"si": Units("si", 1.0, 1.0, 1.0), "mm": Units("mm", 1e3, 1e-6, 1e-12)}


def units_of(name: str) -> Units:
    """Return a system of units.

    Raises:
        UserError: It is not known.
    """
    if name not in UNITS:
        raise UserError(f"units = {name!r}{suggest(name, UNITS) or ';'} choose si (m, kg, s, Pa) or mm (mm, tonne, s, MPa)")
    return UNITS[name]


@dataclass
class Constants:
    """Constants of a material in SI units.

    Args:
        source: Where they come from.
        law: Elastic law, a key of `ELASTIC_WORDS`.
        young: Young's modulus of the relaxed law at small strains [Pa].
        poisson: Poisson's ratio [-].
        density: Mass density [kg/m^3].
        incompressible: Whether the model was fitted as incompressible.
        prony: Shares g_i of the relaxed shear modulus [-] and relaxation times T_i [s].
        yield_norm: tau_Y, the norm of the deviatoric Kirchhoff stress at yield [Pa]; None: elastic.
        friction_angle: Angle of friction of a Drucker-Prager material [degrees]; None: none.
        effects: Parameters of the effects by flat names.
        used: Names of the effects that a card has taken up.
    """

    source: str
    law: str
    young: float
    poisson: float
    density: float
    incompressible: bool = False
    prony: list[tuple[float, float]] = field(default_factory=list)
    yield_norm: float | None = None
    friction_angle: float | None = None
    effects: dict[str, float] = field(default_factory=dict)
    used: set[str] = field(default_factory=set)

    @property
    def mu(self) -> float:
        """Relaxed shear modulus [Pa]."""
        return self.young / (2 * (1 + self.poisson))

    @property
    def bulk(self) -> float:
        """Bulk modulus [Pa]."""
        return self.young / (3 * (1 - 2 * self.poisson))

    @property
    def instantaneous(self) -> tuple[float, float]:
        """Young's modulus [Pa] and Poisson's ratio [-] before any relaxation."""
        return young_poisson(self.bulk, self.mu * (1 + sum(g for g, _ in self.prony)))

    def effect(self, name: str, key: str | None = None) -> float:
        """Return a parameter of an effect, zero where it is absent, and mark the effect as taken up."""
        own = {part: value for flat, value in self.effects.items() for head, _, part in (flat.partition("."),) if head == name}
        if not own:
            return 0.0
        self.used.add(name)
        return next(iter(own.values())) if key is None else own.get(key, 0.0)

    @property
    def yields(self) -> bool:
        """Whether the material yields as von Mises has it."""
        return self.yield_norm is not None

    def flow_stress(self, strain: float) -> float:
        """Return the uniaxial yield stress [Pa] at an equivalent plastic strain, with isotropic hardening and softening."""
        a = ROOT * strain
        raised = (self.yield_norm or 0.0) + self.effect("hardening") * a
        raised += self.effect("cyclic_hardening", "q") * (1 - math.exp(-self.effect("cyclic_hardening", "b") * a))
        return ROOT * raised * math.exp(-self.effect("softening") * a)

    @property
    def linear_hardening(self) -> bool:
        """Whether `flow_stress` is linear."""
        return not self.effect("softening") and not self.effect("cyclic_hardening", "q")

    @property
    def backstresses(self) -> list[tuple[float, float]]:
        """Moduli C [Pa] and recalls gamma [-] of the backstresses over the equivalent plastic strain."""
        found = [(1.5 * self.effect("kinematic_hardening"), 0.0)]
        found += [(1.5 * self.effect("nonlinear_backstress", f"h{i}"), ROOT * self.effect("nonlinear_backstress", f"g{i}")) for i in "123"]
        return [(C, gamma) for C, gamma in found if C]

    @property
    def cone(self) -> tuple[float, float]:
        """Slope tan(beta) and cohesion d [Pa] of the cone q = p tan(beta) + d."""
        angle = math.radians(self.friction_angle or 0.0)
        slope = 6 * math.sin(angle) / (3 - math.sin(angle))
        return slope, slope * self.effect("cohesion") / math.tan(angle)

    def left_out(self) -> list[str]:
        """Return a line for each kind of effect that the card has not taken up."""
        names = dict.fromkeys(flat.partition(".")[0] for flat in self.effects)
        around = [name for name in names if name in SURROUNDINGS]
        others = [name for name in names if name not in SURROUNDINGS and name not in self.used]
        lines = [f"not part of a material, model it in the scene: {', '.join(around)}"] if around else []
        return lines + [f"DOES NOT MAP and is left out: {', '.join(others)}"] * bool(others)


def model_file(source: Path) -> Path:
    """Return the file that holds the model of a source, a file or a folder.

    Raises:
        UserError: There is none.
    """
    if source.is_file():
        return source
    for name in MODEL_FILES:
        if (source / name).is_file():
            return source / name
    if not source.exists():
        raise UserError(f"{source} is missing: give a diagnosis, a model_after.yaml, a scene, an experiment or a material test")
    raise UserError(f"{source} holds no model: none of {', '.join(MODEL_FILES)} is there")


def read_given_model(source: Path) -> tuple[Path, dict[str, Any]]:
    """Return the file of a model and the model as it stands there."""
    path = model_file(source)
    content = read_yaml(path)
    model = content.get("model", content)
    with naming(path):
        return path, mapping(model, "model")


def read_constants(source: Path) -> Constants:
    """Read the constants of a classical model.

    Args:
        source: Folder of a diagnosis, an experiment or a material test, or a YAML file with a model.

    Raises:
        UserError: There is no model, it is impossible, or it has a learned law.
    """
    path, model = read_given_model(source)
    if "law" in model:
        raise UserError(f"{path}: its law is a learned one, which no card can hold: give --to c (for a user material) or torchscript")
    with naming(path):
        return constants_of(model, str(path))


def constants_of(model: Mapping[str, Any], source: str = "the model") -> Constants:
    """Return the constants of a declared model (keys `density`, `elasticity`, `plasticity`, `effects`).

    Raises:
        UserError: The model is impossible.
    """
    model = dict(model)
    effects = read_effects(model.pop("effects", None), "model.effects", known=tuple(entry.name for entry in LIBRARY))
    incompressible = bool(model.pop("incompressible", False))
    checked, _ = read_model(model)
    elastic, plastic = checked["elasticity"], checked["plasticity"]
    made = Constants(
        source, elastic["law"], float(elastic["young"]), float(elastic["poisson"]), checked["density"], incompressible, effects=effects
    )
    if plastic["law"] == "von_mises":
        made.yield_norm = float(plastic["yield_stress"])
    elif plastic["law"] == "drucker_prager":
        made.friction_angle = float(plastic["friction_angle"])
    elif inverse := made.effect("yield", "inverse"):
        made.yield_norm = 1.0 / inverse
    made.prony = _prony(made)
    return made


def _prony(made: Constants) -> list[tuple[float, float]]:
    """Return the Prony series of all effects that relax."""
    found = [(made.effect("maxwell", "ratio"), made.effect("maxwell", "time"))]
    if loss := made.effect("hysteresis"):
        shares, times = hysteresis_spectrum(torch.tensor([loss], dtype=torch.float64))
        found += list(zip(shares[0].tolist(), times.tolist()))
    first, last = made.effect("relaxation_spectrum", "first"), made.effect("relaxation_spectrum", "last")
    if first and last:
        times = [first * (last / first) ** (i / (SPECTRUM - 1)) for i in range(SPECTRUM)]
        found += [(made.effect("relaxation_spectrum", f"g{i + 1}"), at) for i, at in enumerate(times)]
    return sorted(((g, T) for g, T in found if g > 0 and T > 0), key=lambda pair: pair[1])
