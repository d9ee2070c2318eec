"""Networks of peers, as laws for the rollout."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from neuido.errors import UserError
from neuido.physics import linalg
from neuido.physics.laws import AutogradElastic, AutogradPlastic

PLASTIC_SCALE = 1e-3
"""NCLaw: F_hat = F + 1e-3 R X."""


def nclaw(path: str | Path) -> tuple[AutogradElastic, AutogradPlastic]:
    """NCLaw's trained laws (Ma et al. 2023, `InvariantFullMeta`), in float32 or float64.

    Thirteen invariants [sigma - 1, F^T F - I, det F - 1] with descending singular values, two hidden layers of 64 with GELU and no
    bias, and nine outputs X, made symmetric: tau = R X F^T (Kirchhoff, Pa); F_hat = F + 1e-3 R X.

    Args:
        path: npz file with `elasticity.*` and `plasticity.*`, each `layers.0`, `layers.1` and `final`.

    Returns:
        (elastic law, plastic law) for one scene or shared by all; fixed weights, gradients with respect to F.

    Raises:
        UserError: the file is missing or holds other arrays.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"NCLaw's weights {path} are missing: give the path of an nclaw-*.npz file")
    with np.load(path, allow_pickle=False) as arrays:
        weights = {name: torch.from_numpy(arrays[name]) for name in arrays.files}
    elastic, plastic = (_network(weights, part, path) for part in ("elasticity", "plasticity"))

    def stress(F: Tensor) -> Tensor:
        R, X = elastic(F)
        return R @ X @ F.mT

    def correction(F: Tensor) -> Tensor:
        R, X = plastic(F)
        return F + PLASTIC_SCALE * R @ X

    return AutogradElastic(stress, modulus=_modulus(stress)), AutogradPlastic(correction)


def _network(weights: dict[str, Tensor], part: str, path: Path) -> Callable[[Tensor], tuple[Tensor, Tensor]]:
    """F (n, 3, 3) -> (R, symmetric X)."""
    layers = []
    for layer, shape in (("layers.0", (64, 13)), ("layers.1", (64, 64)), ("final_layer", (9, 64))):
        found = [w for name, w in weights.items() if name.startswith(f"{part}.{layer}")]
        if len(found) != 1 or tuple(found[0].shape) != shape:
            raise UserError(f"{path}: no array {part}.{layer} of shape {shape}; it has {', '.join(sorted(weights))}")
        layers.append(found[0])
    cache: dict[tuple[torch.dtype, torch.device], list[Tensor]] = {}

    def network(F: Tensor) -> tuple[Tensor, Tensor]:
        key = (F.dtype, F.device)
        if key not in cache:
            cache[key] = [w.to(F) for w in layers]
        first, second, last = cache[key]
        eye = torch.eye(3, dtype=F.dtype, device=F.device)
        U, sigma, V = linalg.svd(F, gap=0.0)
        R = U @ V.mT if not F.requires_grad else linalg.polar(F)[0]
        x = torch.cat([sigma - 1, (F.mT @ F - eye).flatten(1), torch.linalg.det(F)[:, None] - 1], dim=1)
        x = functional.gelu(functional.linear(functional.gelu(functional.linear(x, first)), second))
        X = functional.linear(x, last).unflatten(1, (3, 3))
        return R, 0.5 * (X + X.mT)

    return network


def _modulus(stress: Callable[[Tensor], Tensor]) -> Tensor:
    """d tau_11 / dF_11 at F = I [Pa], (1,), by a central difference over F_11 = 1 +- 1e-3 in float64."""
    F = torch.eye(3, dtype=torch.float64).repeat(2, 1, 1)
    F[0, 0, 0] += 1e-3
    F[1, 0, 0] -= 1e-3
    tau = stress(F)[:, 0, 0]
    return ((tau[0] - tau[1]) / 2e-3).float().reshape(1)
