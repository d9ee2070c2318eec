"""Learned laws for other programs: which they are, and TorchScript."""

import os
import warnings
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from neuido.data.files.writing import atomic_write
from neuido.errors import UserError
from neuido.export.materials.model_constants import MODEL_FILES, read_given_model
from neuido.models.inference.law_file import load_law
from neuido.physics.laws.neural.bounded import BoundedElastic
from neuido.physics.laws.neural.networks import ObjectiveElastic, ObjectivePlastic, RawElastic, RawPlastic

ELASTIC, PLASTIC = (RawElastic, ObjectiveElastic, BoundedElastic), (RawPlastic, ObjectivePlastic)
LAW_FILE = "law.safetensors"


def learned_laws(source: Any) -> tuple[Any, Any]:
    """Return the elastic and the plastic law of one material, with weights contracted for its latent.

    Args:
        source: A pair of laws, a law file of `neuido predict` (law.safetensors), a folder that has one, or a folder or YAML file with a
            model that names one, such as a diagnosis of a learned law.

    Raises:
        UserError: There is no learned law, or it is of several materials.
    """
    if isinstance(source, str | os.PathLike):
        laws = _read(Path(source).expanduser())
    else:
        laws = tuple(source)
    if len(laws) != 2 or not isinstance(laws[0], ELASTIC) or not isinstance(laws[1], PLASTIC):
        names = ", ".join(type(law).__name__ for law in laws)
        raise UserError(f"laws = {names}: give an elastic and a plastic law of `neuido predict` (raw, objective, bounded or general)")
    for law in laws:
        if any(len(tensor) > 1 for tensor in law.tensors()):
            raise UserError(f"{type(law).__name__} is of {max(map(len, law.tensors()))} materials: give the law of one (`single_scene`)")
    return laws


def _read(path: Path) -> tuple[Any, Any]:
    if path.is_dir() and (path / LAW_FILE).is_file() and not any((path / name).is_file() for name in MODEL_FILES):
        path = path / LAW_FILE
    if path.suffix == ".safetensors":
        return load_law(path)
    file, model = read_given_model(path)
    law = model.get("law")
    if not isinstance(law, dict) or not isinstance(law.get("file"), str):
        raise UserError(f"{file}: its law is a classical one: give --to abaqus, ansys, febio or mujoco")
    from neuido.data.measured.experiment import read_declared_model

    checked, _ = read_declared_model(model, folder=file.resolve().parent)
    laws: tuple[Any, Any] = load_law(checked["law"]["file"])
    elastic, plastic = laws
    return elastic.scaled(torch.tensor([float(checked["law"]["stiffness"])])), plastic


class LawModule(nn.Module):
    """A learned law as a module: trial F (N, 3, 3) -> corrected F (N, 3, 3) [-] and its Kirchhoff stress (N, 3, 3) [Pa].

    The corrected F is the plastic law of the trial, and the stress is the elastic law of the corrected F, as in a substep. The buffer
    `viscosity` [Pa s], (1,), is that of the Cauchy stress 2 viscosity D beside it.

    Args:
        elastic: Elastic law of one material.
        plastic: Plastic law of one material.
    """

    def __init__(self, elastic: Any, plastic: Any) -> None:
        super().__init__()
        self.laws = (elastic, plastic)
        viscosity = torch.zeros(1) if elastic.viscosity is None else elastic.viscosity.detach().clone()
        self.register_buffer("viscosity", viscosity)
        for kind, law in (("elastic", elastic), ("plastic", plastic)):
            for name, tensor in zip(("W1", "b1", "W2", "b2", "W3", "b3"), law.tensors()):
                self.register_buffer(f"{kind}_{name}", tensor[0].detach().double().clone())

    def _outputs(self, kind: str, features: Tensor) -> Tensor:
        W1, b1, W2, b2, W3, b3 = (getattr(self, f"{kind}_{name}") for name in ("W1", "b1", "W2", "b2", "W3", "b3"))
        hidden = nn.functional.silu(nn.functional.linear(features, W1, b1))
        return nn.functional.linear(nn.functional.silu(nn.functional.linear(hidden, W2, b2)), W3, b3)

    def forward(self, F: Tensor) -> tuple[Tensor, Tensor]:
        elastic, plastic = self.laws
        trial = F.double()
        corrected = plastic.corrected_of(trial, self._outputs("plastic", plastic.features_of(trial)), plastic.scale)
        stress = elastic.stress_of(corrected, self._outputs("elastic", elastic.features_of(corrected)), elastic.scale)
        return corrected.type_as(F), stress.type_as(F)


def write_torchscript(source: Any, path: str | os.PathLike) -> Path:
    """Write a learned law as TorchScript, which `torch.jit.load` and LibTorch run without neuido.

    The module maps F (N, 3, 3), of any N, in float32 or float64 on the CPU, to the corrected F and the Kirchhoff stress [Pa]; it computes
    in float64 and is differentiable.

    Args:
        source: As for `learned_laws`.
        path: File ending in .pt.

    Raises:
        UserError: There is no learned law, or another ending.
    """
    target = Path(path).expanduser()
    if target.suffix != ".pt":
        raise UserError(f"path = {path}: a TorchScript file ends in .pt")
    module = LawModule(*learned_laws(source)).eval()
    generator = torch.Generator().manual_seed(0)
    example = torch.eye(3) + 0.1 * torch.randn(5, 3, 3, generator=generator)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch recommends torch.export, which LibTorch does not read
        traced = torch.jit.trace(module, example)
    with atomic_write(target) as hidden:
        traced.save(str(hidden))
    return target
