"""How the latents of Stage I lie, and what lies between two of them (paper, "Representation Analysis").

Silhouettes and t-SNE come from scikit-learn, which is no dependency of the package.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuido.errors import UserError
from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
from neuido.models.operator.law_properties import p_wave_modulus

SPACES = {
    "raw": "z as Stage I left it, Euclidean",
    "cosine": "z, cosine distance",
    "standardised": "z, each component with unit variance",
    "pca": "z on its first two principal components",
    "elastic coefficients": "lambda of the elastic head",
    "plastic coefficients": "lambda of the plastic head",
    "laws": "what the laws answer to fixed deformations: direction of the stress, and plastic correction",
    "t-sne": "the plane of t-SNE, which is no metric space",
}


def require_sklearn(what: str) -> Any:
    """Import scikit-learn.

    Raises:
        UserError: It is not installed.
    """
    try:
        import sklearn
    except ImportError as error:
        raise UserError(f"{what} needs scikit-learn: pip install scikit-learn") from error
    return sklearn


def strains(count: int = 48, *, seed: int = 0) -> Tensor:
    """Return deformation gradients (n, 3, 3) on which laws are compared: I plus normal noise of 0.02 to 0.2, those with a sound volume."""
    generator = torch.Generator().manual_seed(seed)
    spread = torch.tensor([0.02, 0.05, 0.1, 0.2]).repeat_interleave(-(-count // 4))[:, None, None]
    F = torch.eye(3) + spread * torch.randn(len(spread), 3, 3, generator=generator)
    return F[torch.linalg.det(F) > 0.3]


@torch.no_grad()
def law_responses(operator: IntrinsicDynamicsOperator, z: Tensor) -> Tensor:
    """Return the response of the laws of z (S, d) on `strains`, (S, 18 n): normalised stress, and plastic correction over the largest
    norm of a training trajectory's.
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
    """Return the latents of an operator in each of `SPACES`, (M, ...)."""
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
    """Compute the mean silhouette by family in each space, over all latents and over each family's own; the first row is of z itself.

    `neighbours` is the share of the latents whose nearest other one is of their family.

    Args:
        operator: The operator.
        plane: The latents in the plane of t-SNE, (M, 2), for a row of their own.

    Raises:
        UserError: No scikit-learn, or latents of fewer than two families.
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
    """Embed the latents in the plane by t-SNE: a row each with name, family, x, y, and the small-strain P-wave modulus [Pa].

    Raises:
        UserError: No scikit-learn, or a perplexity that is not below the number of latents.
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
    """Measure how few directions of the latent space the laws depend on; the others keep the random start of Stage I.

    The directions are those along which the answers of the laws change most: the leading eigenvectors of the mean of J^T J, J the
    derivative of `law_responses` by z, by central differences at each latent.

    Args:
        operator: The operator.
        kept: Numbers of directions.

    Returns:
        A row for each number: share of the latents' variance along these directions, silhouette on them alone, and the median change
        of a law's answers (relative norm) when the rest of z is replaced by its mean.
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
    """Return orthonormal directions (d, d), ordered by how much the laws depend on them, most first."""
    steps = step * torch.eye(z.shape[1]).to(z)
    gram = torch.zeros(z.shape[1], z.shape[1], dtype=torch.float64)
    for own in z:
        J = ((law_responses(operator, own + steps) - law_responses(operator, own - steps)) / (2 * step)).double().cpu()  # transposed
        gram += J @ J.T
    return torch.linalg.eigh(gram).eigenvectors.flip(1).to(z)
