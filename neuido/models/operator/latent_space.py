"""Structure of the latent space of Stage I: silhouettes, t-SNE, and the directions that matter (paper, "Representation Analysis").

Silhouettes and t-SNE use scikit-learn, which is not a dependency of the package.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuido.errors import UserError
from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
from neuido.models.operator.law_properties import p_wave_modulus

DIRECTIONS_AT = 96
"""Most latents at which the directions are measured, half a second each on one core; of more, evenly through all families."""
SPACES = {
    "raw": "z of Stage I, Euclidean distance",
    "cosine": "z, cosine distance",
    "standardised": "z, each component with unit variance",
    "pca": "z on its first two principal components",
    "elastic coefficients": "lambda of the elastic head",
    "plastic coefficients": "lambda of the plastic head",
    "laws": "response of the laws to fixed deformations: direction of the stress, and plastic correction",
    "t-sne": "t-SNE plane, whose distances are not meaningful",
}


def require_sklearn(what: str) -> Any:
    """Import scikit-learn.

    Raises:
        UserError: scikit-learn is not installed.
    """
    try:
        import sklearn
    except ImportError as error:
        raise UserError(f"{what} needs scikit-learn: pip install scikit-learn") from error
    return sklearn


def strains(count: int = 48, *, seed: int = 0) -> Tensor:
    """Return deformation gradients (n, 3, 3) for comparing laws: I plus normal noise of 0.02 to 0.2, restricted to det F > 0.3."""
    generator = torch.Generator().manual_seed(seed)
    spread = torch.tensor([0.02, 0.05, 0.1, 0.2]).repeat_interleave(-(-count // 4))[:, None, None]
    F = torch.eye(3) + spread * torch.randn(len(spread), 3, 3, generator=generator)
    return F[torch.linalg.det(F) > 0.3]


@torch.no_grad()
def law_responses(operator: IntrinsicDynamicsOperator, z: Tensor) -> Tensor:
    """Return the responses of the laws of z (S, d) to the n deformations of `strains`, (S, 18 n).

    A response consists of the normalised stress, and the plastic correction relative to the largest norm among the training trajectories.
    """
    stress, plastic = _evaluate_laws(operator, z)
    scale = _evaluate_laws(operator, operator.latents.to(z))[1].norm(dim=1).max().clamp(min=1e-12)
    return torch.cat([stress / stress.norm(dim=1, keepdim=True), plastic / scale], 1)


def _evaluate_laws(operator: IntrinsicDynamicsOperator, z: Tensor) -> tuple[Tensor, Tensor]:
    F = strains().to(z)
    F = F.expand(len(z), *F.shape)
    return operator.elastic(z, F).flatten(1), (operator.plastic(z, F) - F).flatten(1)


@torch.no_grad()
def latent_spaces(operator: IntrinsicDynamicsOperator) -> dict[str, np.ndarray]:
    """Return the latents of an operator in each space of `SPACES` except t-SNE, (M, ...)."""
    from sklearn.decomposition import PCA

    z = operator.latents.to(operator.elastic_trunk.fc1.weight)
    raw = z.double().cpu().numpy()
    elastic, plastic = (c.double().cpu().numpy() for c in operator.coefficients(z))
    return {
        "raw": raw,
        "cosine": raw,
        "standardised": (raw - raw.mean(0)) / raw.std(0).clip(1e-12),
        "pca": PCA(2).fit_transform(raw),
        "elastic coefficients": elastic,
        "plastic coefficients": plastic,
        "laws": law_responses(operator, z).double().cpu().numpy(),
    }


def silhouettes(operator: IntrinsicDynamicsOperator, plane: np.ndarray | None = None) -> list[dict[str, Any]]:
    """Compute the mean silhouette with respect to the families in each space, over all latents and over each family.

    The first row is z itself. `neighbours` is the fraction of latents whose nearest neighbour belongs to the same family.

    Args:
        operator: The operator.
        plane: Coordinates of the latents in the t-SNE plane, (M, 2), which add a row.

    Raises:
        UserError: scikit-learn is not installed, or the latents have fewer than two families.
    """
    require_sklearn("a silhouette")
    from sklearn.metrics import pairwise_distances, silhouette_samples

    families = _families(operator)
    rows = []
    for name, points in {**latent_spaces(operator), **({} if plane is None else {"t-sne": plane})}.items():
        distances = pairwise_distances(points, metric="cosine" if name == "cosine" else "euclidean")
        np.fill_diagonal(distances, 0.0)
        own = silhouette_samples(distances, families, metric="precomputed")
        each = {family: float(own[families == family].mean()) for family in dict.fromkeys(families.tolist())}
        nearest = (distances + np.diag(np.full(len(families), np.inf))).argmin(1)
        neighbours = float((families[nearest] == families).mean())
        rows.append({"space": name, "silhouette": float(own.mean()), **each, "neighbours": neighbours, "meaning": SPACES[name]})
    return rows


def _families(operator: IntrinsicDynamicsOperator) -> np.ndarray:
    families = np.array(operator.latent_families)
    if len(set(operator.latent_families)) < 2:
        raise UserError(f"operator: its latents have {len(set(operator.latent_families))} families; a silhouette needs two or more")
    return families


def tsne(operator: IntrinsicDynamicsOperator, *, perplexity: float = 10.0, seed: int = 0) -> list[dict[str, Any]]:
    """Embed the latents in the plane by t-SNE; return rows with name, family, x, y, and small-strain P-wave modulus [Pa].

    Raises:
        UserError: scikit-learn is not installed, or the perplexity is not below the number of latents.
    """
    require_sklearn("t-SNE")
    from sklearn.manifold import TSNE

    z = operator.latents.to(operator.elastic_trunk.fc1.weight)
    if not 0 < perplexity < len(z):
        raise UserError(f"perplexity = {perplexity:g}: it must be positive and below the number of latents, {len(z)}")
    x = TSNE(2, perplexity=perplexity, random_state=seed, init="pca").fit_transform(z.double().cpu().numpy())
    with torch.no_grad():
        moduli = p_wave_modulus(operator, z).tolist()
    names = zip(operator.latent_names, operator.latent_families, x.tolist(), moduli)
    return [{"name": name, "family": family, "x": at[0], "y": at[1], "modulus": modulus} for name, family, at, modulus in names]


def active_directions(operator: IntrinsicDynamicsOperator, *, kept: Sequence[int] = (2, 5, 10, 20, 40)) -> list[dict[str, Any]]:
    """Measure how many directions of the latent space the laws depend on; the others keep the random initial values of Stage I.

    The directions along which the responses of the laws change most are the leading eigenvectors of the mean of J^T J. J is the Jacobian of
    `law_responses` with respect to z, computed by central differences at each latent, or at `DIRECTIONS_AT` of many.

    Args:
        operator: The operator.
        kept: Numbers of directions to keep.

    Returns:
        A row for each number: the fraction of the variance of the latents along these directions, the silhouette on them alone, and the
        median relative change of the responses of a law when the other components of z are replaced by their mean.
    """
    require_sklearn("a silhouette")
    from sklearn.metrics import silhouette_score

    families, z = _families(operator), operator.latents.to(operator.elastic_trunk.fc1.weight)
    V = _sensitive_directions(operator, z)
    centred = (z - z.mean(0)) @ V
    variance, before = centred.var(0), law_responses(operator, z)
    rows = []
    for count in (k for k in kept if k < z.shape[1]):
        after = law_responses(operator, z.mean(0) + centred[:, :count] @ V[:, :count].T)
        rows.append(
            {
                "directions": count,
                "variance": float(variance[:count].sum() / variance.sum()),
                "silhouette": float(silhouette_score(centred[:, :count].double().cpu().numpy(), families)),
                "law changes": float(((after - before).norm(dim=1) / before.norm(dim=1)).median()),
            }
        )
    return rows


def _sensitive_directions(operator: IntrinsicDynamicsOperator, z: Tensor, step: float = 0.05) -> Tensor:
    """Return orthonormal directions (d, d) as columns, in descending order of their influence on the laws."""
    steps = step * torch.eye(z.shape[1]).to(z)
    gram = torch.zeros(z.shape[1], z.shape[1], dtype=torch.float64)
    for own in z[:: math.ceil(len(z) / DIRECTIONS_AT)]:
        J = ((law_responses(operator, own + steps) - law_responses(operator, own - steps)) / (2 * step)).double().cpu()  # transposed
        gram += J @ J.T
    return torch.linalg.eigh(gram).eigenvectors.flip(1).to(z)
