"""The declared model of an experiment: the figures that a fit may move, and the laws and effects that a rollout takes.

The laws are classical ones, or a neural one that was read from video.
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
    """How a fit moves a declared figure."""

    unit: str
    step: float
    """A typical step: relative where `log`, else in the unit."""
    lower: float
    upper: float
    log: bool


FIGURES = {
    "young": Figure("Pa", 0.1, 1e2, 1e13, True),
    "poisson": Figure("1", 0.03, -0.9, 0.4999, False),
    "density": Figure("kg/m^3", 0.05, 1.0, 3e4, True),
    "yield_stress": Figure("Pa", 0.1, 1e-2, 1e12, True),
    "stiffness": Figure("1", 0.1, 1e-3, 1e3, True),
    "friction_angle": Figure("degrees", 2.0, 1.0, 80.0, False),
}


def declared(name: str, value: float, *, within: tuple[float, float] | None = None) -> Parameter:
    """The parameter of a figure at its declared value; `within`: a narrower range, where a simulator needs one."""
    figure = FIGURES[name]
    lower, upper = within or (figure.lower, figure.upper)
    return Parameter(name, figure.unit, float(value), figure.step, lower, upper, log=figure.log)


CLASSICAL = {
    name: "the law is a neural one, whose flow has no such parameter"
    for name in ("yield", "hardening", "softening", "kinematic_hardening", "rate_yield", "cohesion")
}
"""Effects that act on a classical plastic law alone, and what is said of them."""


class Ready(NamedTuple):
    """What a rollout takes."""

    elasticity: ElasticLaw
    plasticity: PlasticLaw
    effects: Effects


def read_model_file(path: str) -> dict[str, Any]:
    """The model of a file: a `model_after.yaml`, or a file with the key `model`.

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
    if isinstance(law, dict) and isinstance(law.get("file"), str):  # a law beside the file
        model = model | {"law": law | {"file": str(file.resolve().parent / law["file"])}}
    return model


def with_law(experiment: Experiment, path: str) -> Experiment:
    """The experiment with a neural law in place of its elasticity and plasticity; a factor on its stress is free.

    Raises:
        UserError: No such file, or no law.
    """
    _load(path)
    model = experiment.model | {"law": {"file": str(Path(path).expanduser().resolve()), "stiffness": 1.0}}
    free = ("stiffness", *(name for name in experiment.free if name in model))
    return replace(experiment, model=model, free=free)


def laws_of(model: Mapping[str, Any], points: Sequence[Mapping[str, float]]) -> tuple[ElasticLaw, PlasticLaw]:
    """The laws of several points, a row each: what a point names takes the place of the model's figure.

    Raises:
        UserError: An impossible material, or no law in the file that the model names.
    """

    def values(part: Mapping[str, Any], name: str) -> Tensor:
        return torch.tensor([point.get(name, part[name]) for point in points], dtype=torch.float64)

    if "law" in model:
        elastic, plastic = _load(model["law"]["file"])
        return scaled(elastic, values(model["law"], "stiffness")), plastic
    parts = []
    for part in (model["elasticity"], model["plasticity"]):
        parts.append({key: value if key == "law" else values(part, key) for key, value in part.items()})
    return material(*parts)


def scaled(law: Any, factor: Tensor) -> Any:
    """A neural elastic law with factors on its stress, one for each scene (S,): exact, since its last layer is linear."""
    W1, b1, W2, b2, W3, b3 = law.tensors()
    factor = factor.to(W3)
    return type(law)(W1, b1, W2, b2, factor[:, None, None] * W3, factor[:, None] * b3, scale=law.scale)


def classical(experiment: Experiment) -> Experiment:
    """The experiment with the small-strain moduli of its neural law in the model's elasticity, for typical sizes alone."""
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
    """The laws and effects of a model, ready for a rollout of `simulator`.

    Args:
        model: A model_after.yaml, or the content of one.
        simulator: Of one body or several alike; gradients and fibres lie in its bodies as they are at t = 0.
        duration: Length of the recording over which a force in time was fitted, s, where the model does not say.

    Raises:
        UserError: A file that is no model, an impossible material, an unknown effect.
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
    """The model for a file in `folder`, with its neural law, where it has one, copied there."""
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
