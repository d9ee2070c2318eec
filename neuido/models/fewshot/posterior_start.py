"""The start of an adaptation from the posterior of the law: what the encoder read, weighed by the images themselves (not in the paper).

One pass of an encoder leaves the modulus uncertain by a factor of a few, and says little of a yield stress or a friction angle. A fit from
its estimate alone may end in a minimum nearby, where a wrong law and a wrong filling of the body make up for each other. So laws that the
estimate leaves possible are simulated, and the fit starts from the one whose images are nearest.
"""

import torch
from torch import Tensor
from torch.nn import functional

from neuido.errors import UserError
from neuido.models.inference.pipeline import render_motion, rollout_latent
from neuido.models.inference.prepared_scene import PreparedScene
from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
from neuido.models.operator.law_properties import p_wave_modulus

TRUE_OVER_READ = (0.30, 11.5)
"""90 % interval of the true P-wave modulus over the one that `pretrained` reads (58 films of unseen shapes, research/log/video.md)."""

VIEWS = 2
"""Most training views that the images are compared on; as many as a step of a fit sees."""


def possible_latents(operator: IntrinsicDynamicsOperator, z: Tensor, count: int, seed: int = 0) -> Tensor:
    """Draw latents (n, d), n <= count, that an estimate z (d,) leaves possible; the first one is z.

    The others lie between two materials of Stage I of one family, at a random share, and have a P-wave modulus within `TRUE_OVER_READ` of
    that of z.
    """
    generator = torch.Generator().manual_seed(seed)
    pairs = pairs_of_a_family(operator.latent_families)
    if count < 2 or not len(pairs):
        return z[None]
    a, b = pairs[torch.randint(len(pairs), (8 * count,), generator=generator)].unbind(1)
    share = torch.rand(8 * count, 1, generator=generator)
    latents = operator.latents.cpu()
    drawn = torch.lerp(latents[a], latents[b], share).to(z)
    ratio = p_wave_modulus(operator, drawn) / p_wave_modulus(operator, z[None])
    possible = drawn[(ratio > TRUE_OVER_READ[0]) & (ratio < TRUE_OVER_READ[1])]
    return torch.cat([z[None], possible[: count - 1]])


def pairs_of_a_family(families: list[str]) -> Tensor:
    """Return the indices of all pairs of different materials of one family, (n, 2)."""
    pairs = [(i, j) for i, a in enumerate(families) for j, b in enumerate(families) if i < j and a == b]
    return torch.tensor(pairs, dtype=torch.long).reshape(-1, 2)


@torch.no_grad()
def most_probable(scene: PreparedScene, operator: IntrinsicDynamicsOperator, latents: Tensor) -> tuple[Tensor, Tensor]:
    """Simulate a scene with each latent (n, d); return the one whose images are nearest, and the squared errors of all, (n,).

    A law that cannot be simulated has an infinite error. If none can, the first latent is returned.
    """
    views = scene.training_views[:: -(-len(scene.training_views) // VIEWS)]
    recorded = scene.recorded(views)
    errors = torch.full((len(latents),), float("inf"))
    for i, z in enumerate(latents):
        try:
            images, _ = render_motion(scene, rollout_latent(scene, operator, z), views)
        except UserError:
            continue
        errors[i] = functional.mse_loss(images, recorded)
    return latents[int(errors.nan_to_num(float("inf")).argmin())], errors
