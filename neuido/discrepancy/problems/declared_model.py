"""The declared model of an experiment: its fitted values, and the laws and effects of a rollout.

The laws are classical, or a neural law that `neuido predict` has written.
"""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from neuido.data.files.parsing import read_yaml
from neuido.data.files.writing import atomic_write
from neuido.data.measured.experiment import Experiment, read_declared_model
from neuido.discrepancy.problems.candidates import effects_of
from neuido.discrepancy.problems.problem import Parameter
from neuido.errors import UserError
from neuido.models.inference.law_file import load_law
from neuido.physics.effects.coefficients import shear_modulus
from neuido.physics.effects.library import KNOTS
from neuido.physics.effects.parameters import Effects
from neuido.physics.fem.finite_elements import FiniteElements
from neuido.physics.laws.base import ElasticLaw, PlasticLaw
from neuido.physics.laws.classical import material
from neuido.physics.mpm.simulator import Simulator
from neuido.physics.runtime.once import cached


class Figure(NamedTuple):
    """Unit, typical step and range of a declared value in a fit."""

    unit: str
    step: float
    """Typical step, relative if `log`, else in `unit`."""
    lower: float
    upper: float
    log: bool
    """Whether the logarithm is fitted."""


FIGURES = {
    "young": Figure("Pa", 0.1, 1e-3, 1e13, True),
    "poisson": Figure("1", 0.03, -0.9, 0.4999, False),
    "density": Figure("kg/m^3", 0.05, 1.0, 3e4, True),
    "yield_stress": Figure("Pa", 0.1, 1e-2, 1e12, True),
    "viscosity": Figure("Pa s", 0.1, 1e-9, 1e15, True),
    "stiffness": Figure("1", 0.1, 1e-3, 1e3, True),
    "friction_angle": Figure("degrees", 2.0, 1.0, 80.0, False),
}


def declared(name: str, value: float, *, within: tuple[float, float] | None = None) -> Parameter:
    """Return the parameter of a declared value (a key of `FIGURES`).

    `within` is a narrower range for simulators that need one.
    """
    figure = FIGURES[name]
    lower, upper = within or (figure.lower, figure.upper)
    return Parameter(name, figure.unit, float(value), figure.step, lower, upper, log=figure.log)


CLASSICAL = {
    name: "the law is a neural one, whose flow has no such parameter"
    for name in ("yield", "hardening", "softening", "kinematic_hardening", "rate_yield", "cohesion")
}
"""Effects that need a classical plastic law, with the reason that the report gives beside a neural law."""


class Ready(NamedTuple):
    """Laws and effects in the form that a rollout takes."""

    elasticity: ElasticLaw
    plasticity: PlasticLaw
    effects: Effects


def read_model_file(path: str) -> dict[str, Any]:
    """Read a model from a `model_after.yaml`, or from a file with the key `model`.

    Raises:
        UserError: No such file, or no YAML mapping.
    """
    file = Path(path).expanduser()
    if not file.is_file():
        raise UserError(f"model = {path}: there is no such file")
    try:
        content = read_yaml(file)
    except (UnicodeDecodeError, RecursionError) as error:
        raise UserError(f"model = {path} is not valid YAML: {error}") from error
    model = content["model"] if set(content) == {"model"} and isinstance(content["model"], dict) else content
    law = model.get("law")
    if isinstance(law, dict) and isinstance(law.get("file"), str):  # the path of the law is relative to the file
        model = model | {"law": law | {"file": str(file.resolve().parent / law["file"])}}
    return model


def with_law(experiment: Experiment, path: str) -> Experiment:
    """Return the experiment with a neural law in place of elasticity and plasticity; a factor on its stress is fitted.

    Raises:
        UserError: No such file, or no law in it.
    """
    _load(path)
    model = experiment.model | {"law": {"file": str(Path(path).expanduser().resolve()), "stiffness": 1.0}}
    free = ("stiffness", *(name for name in experiment.free if name in model))
    return replace(experiment, model=model, free=free)


def laws_of(model: Mapping[str, Any], points: Sequence[Mapping[str, float]]) -> tuple[ElasticLaw, PlasticLaw]:
    """Build the laws of a model for several parameter sets, one scene each.

    A value in a parameter set replaces that of the model.

    Raises:
        UserError: An impossible material, or no law in the file that the model names.
    """

    def values(part: Mapping[str, Any], name: str) -> Tensor:
        return torch.tensor([point.get(name, part[name]) for point in points], dtype=torch.float64)

    if "law" in model:
        elastic, plastic = _load(model["law"]["file"])
        return elastic.scaled(values(model["law"], "stiffness")), plastic
    parts = []
    for part in (model["elasticity"], model["plasticity"]):
        parts.append({key: value if key == "law" else values(part, key) for key, value in part.items()})
    return material(*parts)


def classical(experiment: Experiment) -> Experiment:
    """Return the experiment with Young's modulus of its neural law at rest in the elasticity, for estimates of typical sizes.

    Raises:
        UserError: The modulus is not positive.
    """
    if "law" not in experiment.model:
        return experiment
    elastic, _ = laws_of(experiment.model, [{}])
    mu, wave = float(shear_modulus(elastic).mean()), float(elastic.modulus().mean())
    young = mu * (3 * wave - 4 * mu) / max(wave - mu, 1e-9 * wave)
    if not young > 0:
        raise UserError(f"law = {experiment.model['law']['file']} has a Young's modulus of {young:.3g} Pa at rest; it must be positive")
    model = experiment.model | {"elasticity": experiment.model["elasticity"] | {"young": young}, "plasticity": {"law": "identity"}}
    return replace(experiment, model=model)


def ready(model: str | Path | Mapping[str, Any], simulator: Simulator | FiniteElements, *, duration: float | None = None) -> Ready:
    """Build the laws and effects of a model for a rollout of `simulator`.

    Args:
        model: A model_after.yaml, or its content.
        simulator: Simulator of one body, or of several with the same model. Gradients and fibres refer to the bodies at t = 0.
        duration: Length [s] of the recording to which a time-dependent force was fitted, where the model does not contain it.

    Raises:
        UserError: The file is no model, the material is impossible, or an effect is unknown.
    """
    content = read_model_file(str(model)) if isinstance(model, str | Path) else dict(model)
    checked, _ = read_declared_model(content)
    effects = dict(checked.get("effects", {}))
    if duration is None:
        interval = effects.get("time_force.interval")
        if interval is None and any(name.startswith("time_force.") and name[-1].isdigit() for name in effects):
            raise UserError("model.effects has time_force without its interval: give the recording's duration")
        duration = (KNOTS - 1) * interval if interval is not None else 1.0
    x = simulator.state.x
    offsets = simulator.particles.offsets
    centred = torch.cat([x[i:j] - x[i:j].mean(dim=0) for i, j in zip(offsets[:-1], offsets[1:])])
    rows = [effects] * (len(offsets) - 1)
    return Ready(*laws_of(checked, [{}]), effects_of(rows, centred, simulator.particles.scene, duration))


def beside(folder: Path, model: Mapping[str, Any]) -> dict[str, Any]:
    """Copy the neural law of a model to `folder`, and return the model with the name of the copy; other models stay as they are."""
    if "law" not in model:
        return dict(model)
    source, target = Path(model["law"]["file"]), folder / "law.safetensors"
    if not (target.is_file() and target.samefile(source)):
        with atomic_write(target) as hidden:
            shutil.copyfile(source, hidden)
    return {**model, "law": {**model["law"], "file": target.name}}


def _load(path: str) -> tuple[Any, Any]:
    file = Path(path).expanduser()
    if not file.is_file():
        raise UserError(f"law = {path}: there is no such file")
    return _loaded(str(file), file.stat().st_mtime_ns)


@cached(limit=4)
def _loaded(path: str, changed: int) -> tuple[Any, Any]:
    return load_law(path)
