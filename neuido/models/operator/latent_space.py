"""How the latents of Stage I lie, and what lies between two of them (paper, "Representation Analysis").

Silhouettes and t-SNE come from scikit-learn, which is no dependency of the package.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from neuido.data.bodies.shapes import ball
from neuido.errors import UserError
from neuido.models.operator.branch import small_strain_modulus
from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
from neuido.physics.mpm.simulator import Simulator
from neuido.types import Scene, Walls

CELLS, DT, EVERY, FRAMES = 16, 5e-4, 4, 151
"""The drop test: 0.3 s, a frame each 2 ms."""
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


def need_sklearn(what: str) -> Any:
    """scikit-learn.

    Raises:
        UserError: It is not installed.
    """
    try:
        import sklearn
    except ImportError as error:
        raise UserError(f"{what} needs scikit-learn: pip install scikit-learn") from error
    return sklearn


def strains(count: int = 48, *, seed: int = 0) -> Tensor:
    """Deformation gradients (n, 3, 3) on which laws are compared: I plus normal noise of 0.02 to 0.2, those with a sound volume."""
    generator = torch.Generator().manual_seed(seed)
    spread = torch.tensor([0.02, 0.05, 0.1, 0.2]).repeat_interleave(-(-count // 4))[:, None, None]
    F = torch.eye(3) + spread * torch.randn(len(spread), 3, 3, generator=generator)
    return F[torch.linalg.det(F) > 0.3]


@torch.no_grad()
def answers(operator: IntrinsicDynamicsOperator, z: Tensor) -> Tensor:
    """What the laws of z (S, d) say on `strains`, (S, 18 n): stress over its norm, and plastic correction over the largest norm of a
    training trajectory's.
    """
    stress, plastic = _said(operator, z)
    scale = _said(operator, operator.latents.to(z))[1].norm(dim=1).max().clamp(min=1e-12)
    return torch.cat([stress / stress.norm(dim=1, keepdim=True), plastic / scale], 1)


def _said(operator: IntrinsicDynamicsOperator, z: Tensor) -> tuple[Tensor, Tensor]:
    F = strains().to(z)
    F = F.expand(len(z), *F.shape)
    return operator.elastic(z, F).flatten(1), (operator.plastic(z, F) - F).flatten(1)


@torch.no_grad()
def spaces(operator: IntrinsicDynamicsOperator) -> dict[str, np.ndarray]:
    """The latents of an operator in each of `SPACES`, (M, ...)."""
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
        "laws": answers(operator, z).double().cpu().numpy(),
    }


def silhouettes(operator: IntrinsicDynamicsOperator, plane: np.ndarray | None = None) -> list[dict[str, Any]]:
    """The mean silhouette by family in each space, over all latents and over each family's own; the first row is the latents' own.

    `neighbours` is the share of the latents whose nearest other one is of their family.

    Args:
        operator: The operator.
        plane: The latents in the plane of t-SNE, (M, 2), for a row of their own.

    Raises:
        UserError: No scikit-learn, or latents of fewer than two families.
    """
    need_sklearn("a silhouette")
    from sklearn.metrics import pairwise_distances, silhouette_samples

    families = _families(operator)
    rows = []
    for name, points in {**spaces(operator), **({} if plane is None else {"t-sne": plane})}.items():
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


def embed(operator: IntrinsicDynamicsOperator, *, perplexity: float = 10.0, seed: int = 0) -> list[dict[str, Any]]:
    """t-SNE of the latents as they are, a row a latent: name, family, x, y, and the small-strain modulus [Pa] of its law.

    Raises:
        UserError: No scikit-learn, or a perplexity that is not below the number of latents.
    """
    need_sklearn("t-SNE")
    from sklearn.manifold import TSNE

    z = operator.latents.to(operator.elastic_trunk.fc1.weight)
    if not 0 < perplexity < len(z):
        raise UserError(f"perplexity = {perplexity:g}: it must be positive and below the number of latents, {len(z)}")
    x = TSNE(2, perplexity=perplexity, random_state=seed, init="pca").fit_transform(z.double().cpu().numpy())
    with torch.no_grad():
        moduli = small_strain_modulus(operator, z).tolist()
    names = zip(operator.latent_names, operator.latent_families, x.tolist(), moduli)
    return [{"name": name, "family": family, "x": at[0], "y": at[1], "modulus": modulus} for name, family, at, modulus in names]


def idle(operator: IntrinsicDynamicsOperator, *, kept: Sequence[int] = (2, 5, 10, 20, 40)) -> list[dict[str, Any]]:
    """How few directions of the latents the laws feel: the rest is what the start of Stage I left, and widens the families.

    The directions are those along which the answers of the laws change most: the leading eigenvectors of the mean of J^T J, J the
    derivative of `answers` by z, by central differences at each latent.

    Args:
        operator: The operator.
        kept: Numbers of directions.

    Returns:
        A row for each number: share of the latents' variance along these directions, silhouette on them alone, and the median change
        of a law's answers (relative norm) when the rest of z is replaced by its mean.
    """
    need_sklearn("a silhouette")
    from sklearn.metrics import silhouette_score

    families, z = _families(operator), operator.latents.to(operator.elastic_trunk.fc1.weight)
    V = _felt(operator, z)
    centred = (z - z.mean(0)) @ V
    variance, before = centred.var(0), answers(operator, z)
    rows = []
    for count in (k for k in kept if k < z.shape[1]):
        after = answers(operator, z.mean(0) + centred[:, :count] @ V[:, :count].T)
        rows.append(
            {
                "directions": count,
                "variance": float(variance[:count].sum() / variance.sum()),
                "silhouette": float(silhouette_score(centred[:, :count].double().cpu().numpy(), families)),
                "law changes": float(((after - before).norm(dim=1) / before.norm(dim=1)).median()),
            }
        )
    return rows


def _felt(operator: IntrinsicDynamicsOperator, z: Tensor, step: float = 0.05) -> Tensor:
    """Orthonormal directions (d, d), those that the laws feel most first."""
    steps = step * torch.eye(z.shape[1]).to(z)
    gram = torch.zeros(z.shape[1], z.shape[1], dtype=torch.float64)
    for own in z:
        J = ((answers(operator, own + steps) - answers(operator, own - steps)) / (2 * step)).double().cpu()  # transposed
        gram += J @ J.T
    return torch.linalg.eigh(gram).eigenvectors.flip(1).to(z)


class Interpolation(NamedTuple):
    """Laws between two latents, rolled out."""

    names: tuple[str, str]
    shares: Tensor
    """Of the second latent, (N,)."""
    rows: list[dict[str, float]]
    """share, modulus [Pa], compression [-], contact time [s] of each."""
    motion: Tensor
    """Positions of the drop test [m], (K, N, P, 3)."""


def interpolate(
    operator: IntrinsicDynamicsOperator, ends: tuple[str, str], *, count: int = 9, height: float = 0.3, device: str = "cpu"
) -> Interpolation:
    """Roll out the laws of latents on the line between two, all in one launch.

    The drop test: a ball of 0.24 m falls with 2 m/s onto a frictionless floor. `compression` is the largest loss of its height over the
    height at the start; `contact` how long the floor carries more than half of its weight.

    Args:
        operator: The operator.
        ends: Names of two latents.
        count: Latents, the ends included.
        height: Of the ball's centre at the start [m].
        device: Where to simulate.

    Raises:
        UserError: A name that there is not, fewer than three latents, a law that cannot run.
    """
    if count < 3:
        raise UserError(f"count = {count}: at least 3 latents, the ends included, are needed")
    operator = operator.to(device)
    a, b = (operator.latent(name) for name in ends)
    shares = torch.linspace(0, 1, count, device=a.device)
    z = torch.lerp(a, b, shares[:, None])
    body = ball(centre=(0.5, height, 0.5), radius=0.12, spacing=0.03, velocity=(0.0, -2.0, 0.0))
    scene = Scene(cells=CELLS, dt=DT, walls=Walls(inset=2.0))
    simulator = Simulator([scene] * count, [body] * count, device=device)
    with torch.no_grad():
        moduli = small_strain_modulus(operator, z).tolist()
        motion = simulator.rollout((FRAMES - 1) * EVERY, *operator.laws(z), every=EVERY)
    x, v = (t.view(FRAMES, count, -1, 3).cpu() for t in (motion.x, motion.v))
    tall = x[..., 1].amax(2) - x[..., 1].amin(2)
    compression = (1 - tall.amin(0) / tall[0]).tolist()
    pushes = v[..., 1].mean(2).diff(dim=0) / (EVERY * DT) > 0.5 * scene.gravity[1]
    contact = (pushes.sum(0) * EVERY * DT).tolist()
    rows = [dict(zip(("share", "modulus", "compression", "contact"), row)) for row in zip(shares.tolist(), moduli, compression, contact)]
    return Interpolation(ends, shares.cpu(), rows, x)


def softest_and_stiffest(operator: IntrinsicDynamicsOperator, family: str = "elastic") -> tuple[str, str]:
    """The names of a family's latents with the smallest and the largest small-strain modulus.

    Raises:
        UserError: A family of fewer than two latents.
    """
    own = [i for i, each in enumerate(operator.latent_families) if each == family]
    if len(own) < 2:
        known = ", ".join(dict.fromkeys(operator.latent_families)) or "none"
        raise UserError(f"family = {family!r} has {len(own)} latents, two are needed; there are {known}")
    with torch.no_grad():
        moduli = small_strain_modulus(operator, operator.latents[own].to(operator.elastic_trunk.fc1.weight))
    return operator.latent_names[own[int(moduli.argmin())]], operator.latent_names[own[int(moduli.argmax())]]


def monotonicity(values: Sequence[float]) -> dict[str, float]:
    """How steadily values go from the first to the last one.

    Returns:
        `steps`: the share of steps that go the way of the ends; `spearman`: the rank correlation with the order, its sign that of the ends
        (one for a monotone row); `back`: the largest step back over the whole way.
    """
    from scipy.stats import spearmanr

    v = np.asarray(values, float)
    way = v[-1] - v[0]
    steps = np.diff(v) * np.sign(way)
    with np.errstate(invalid="ignore"):
        rank = float(spearmanr(np.arange(len(v)), v).statistic) * float(np.sign(way)) if way else 0.0
    return {"steps": float((steps > 0).mean()), "spearman": rank, "back": float(max(0.0, -steps.min()) / abs(way)) if way else 1.0}


@torch.no_grad()
def all_pairs(operator: IntrinsicDynamicsOperator, family: str, *, count: int = 9) -> dict[str, float]:
    """Monotonicity of the small-strain modulus between any two latents of a family.

    Returns:
        `pairs`; `monotone`: the share of pairs that are monotone in every step; `steps` and `spearman`: means over the pairs. Pairs whose
        moduli differ by less than a tenth have no way to go and are left out.
    """
    z = operator.latents[[i for i, each in enumerate(operator.latent_families) if each == family]].to(operator.elastic_trunk.fc1.weight)
    first, second = torch.triu_indices(len(z), len(z), 1)
    line = torch.lerp(z[first, None], z[second, None], torch.linspace(0, 1, count, device=z.device)[:, None])
    moduli = small_strain_modulus(operator, line.flatten(0, 1)).view(len(first), count)
    apart = (moduli[:, -1] / moduli[:, 0]).log().abs() > 0.1
    found = [monotonicity(row) for row in moduli[apart].tolist()]
    mean = {key: float(np.mean([each[key] for each in found])) for key in ("steps", "spearman")} if found else {}
    return {"pairs": float(len(found)), "monotone": float(np.mean([each["steps"] == 1 for each in found])) if found else 0.0, **mean}
