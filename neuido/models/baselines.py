"""Networks of peers, as laws for the rollout."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from neuido.errors import UserError
from neuido.physics.invariants import InvariantElastic, InvariantPlastic

LAYERS = (("layers.0", (64, 13)), ("layers.1", (64, 64)), ("final_layer", (9, 64)))
PARTS = ("elasticity", "plasticity")


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
    with np.load(path, allow_pickle=False) as arrays:
        weights = {name: torch.from_numpy(arrays[name]) for name in arrays.files}
    return tuple([_layer(weights, f"{part}.{name}", shape, path) for name, shape in LAYERS] for part in PARTS)  # type: ignore[return-value]


def _layer(weights: dict[str, Tensor], name: str, shape: tuple[int, int], path: Path) -> Tensor:
    found = [w for key, w in weights.items() if key.startswith(name)]
    if len(found) != 1 or tuple(found[0].shape) != shape:
        raise UserError(f"{path}: no array {name} of shape {shape}; it has {', '.join(sorted(weights))}")
    return found[0]
