"""Law files: the effective networks of one material as safetensors, with its description beside it as JSON."""

import json
import math
import os
from collections.abc import Mapping
from datetime import date
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neuido.data.files.parsing import naming
from neuido.data.files.values import number
from neuido.data.files.writing import write_text
from neuido.errors import UserError
from neuido.models.operator.dynamics_operator import LAWS, IntrinsicDynamicsOperator
from neuido.models.video.flow_vae import read_weights, write_weights
from neuido.physics.laws.base import ElasticLaw, PlasticLaw

FORMAT = "neuido-law/1"
WEIGHTS = ("W1", "b1", "W2", "b2", "W3", "b3")


def save_law(path: str | os.PathLike, operator: IntrinsicDynamicsOperator, z: Tensor, card: Mapping[str, Any] | None = None) -> None:
    """Write the law of z (d,) as safetensors (effective networks, z and lambda), and a readable description next to it as JSON.

    Args:
        path: File to write, ending in .safetensors; the JSON file has the same stem.
        operator: The operator.
        z: Latent, (d,).
        card: Further entries of the JSON file, for example the origin of the law, or `strain_limit`, the largest logarithmic stretch that
            it was trained on.
    """
    with torch.no_grad():
        elastic, plastic = operator.laws(z)
        tensors = {f"elastic.{name}": t for name, t in zip(WEIGHTS, elastic.tensors())}
        tensors |= {f"plastic.{name}": t for name, t in zip(WEIGHTS, plastic.tensors())}
        lambdas = operator.coefficients(z[None])
        if elastic.viscosity is not None:
            tensors["viscosity"] = elastic.viscosity
        tensors |= {"z": z, "lambda_elastic": lambdas[0][0], "lambda_plastic": lambdas[1][0]}
        modulus = float(elastic.modulus()[0])
    config = {"trunk": operator.trunk, "elastic_scale": elastic.scale, "plastic_scale": plastic.scale}
    known = {} if elastic.viscosity is None else {"viscosity": float(elastic.viscosity[0])}
    card = {"date": date.today().isoformat(), "modulus": modulus, **known, **(card or {})}
    write_weights(path, FORMAT, config, {name: t.detach().cpu().contiguous().clone() for name, t in tensors.items()}, card)
    text = json.dumps({"format": FORMAT, **config, "unit": "Kirchhoff stress in Pa", **card}, indent=1)
    write_text(Path(path).with_suffix(".json"), text + "\n")


def load_law(path: str | os.PathLike) -> tuple[ElasticLaw, PlasticLaw]:
    """Read the elastic and plastic law from a file of `save_law`; the operator is not needed.

    Raises:
        UserError: There is no such file, or it is not a law file.
    """
    config, tensors, card = read_weights(path, (FORMAT,), "law")
    if not isinstance(config.get("trunk"), str) or config["trunk"] not in LAWS:
        raise UserError(f"law: {path} has the trunk {config.get('trunk')!r}; one of {', '.join(LAWS)}")
    elastic, plastic = LAWS[config["trunk"]]
    try:
        parts = [[tensors[f"{kind}.{name}"] for name in WEIGHTS] for kind in ("elastic", "plastic")]
    except KeyError as error:
        raise UserError(f"law: {path} lacks the tensor {error}") from error
    with naming(path, "is no whole law file"):
        scales = [number(config.get(f"{kind}_scale"), f"{kind}_scale", above=0.0) for kind in ("elastic", "plastic")]
        for kind, part in zip(("elastic", "plastic"), parts):
            if not all(t.is_floating_point() and bool(torch.isfinite(t).all()) for t in part):
                raise UserError(f"the tensors of {kind} must be finite numbers")
        laws = elastic(*parts[0], scale=scales[0]), plastic(*parts[1], scale=scales[1])
        if "viscosity" in tensors:
            laws[0].viscosity = _viscosity(tensors["viscosity"])
        if card.get("strain_limit") is not None:
            limit = number(card["strain_limit"], "strain_limit", above=0.0)
            for law in laws:
                law.strain_limit = limit
    return laws


def _viscosity(given: Tensor) -> Tensor:
    """Check the shear viscosity [Pa s] of a law file, (1,)."""
    if given.shape != (1,) or not given.is_floating_point() or not 0 <= float(given[0]) < math.inf:
        raise UserError(f"viscosity must be one number of zero or more, got {given.tolist()}")
    return given
