"""The start of an adaptation from the posterior of the law: what the encoder read, weighed by the images themselves (not in the paper).

One pass of an encoder leaves the modulus uncertain by a factor of a few, and says little of a yield stress or a friction angle. A fit from
its estimate alone may end in a minimum nearby: a law that does not yield has no gradient towards one that does, so that a wrong law and a
wrong filling of the body make up for each other. So laws that the estimate leaves possible are simulated, those of each family on their
own, first materials of Stage I and then laws about the best of them, and the fit starts from the law whose images are nearest.
"""

from typing import NamedTuple

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
ROUNDS = 3
"""Rounds of draws about the best law of each family; each has half the spread of the one before."""


class Posterior(NamedTuple):
    """Laws that were simulated, in the order of their draws; the first is the estimate."""

    latents: Tensor
    """(n, d)."""
    errors: Tensor
    """Squared error of the images, (n,); infinite for a law that cannot be simulated."""
    families: list[str]
    """Family of each draw, (n,); empty for the estimate."""

    @property
    def best(self) -> Tensor:
        """Latent (d,) whose images are nearest; the estimate if no law can be simulated."""
        return self.latents[int(self.errors.argmin())]


class Draws:
    """Draws of latents from the materials of one family of Stage I.

    Args:
        operator: The operator, with its latents.
        z: Estimate of the encoder, (d,).
        seed: Seed of the draws.
    """

    def __init__(self, operator: IntrinsicDynamicsOperator, z: Tensor, seed: int):
        self.operator, self.generator = operator, torch.Generator().manual_seed(seed)
        self.limits = tuple(factor * float(p_wave_modulus(operator, z[None])[0]) for factor in TRUE_OVER_READ)
        names = operator.latent_families
        latents = operator.latents.to(z)
        own = {name: latents[[i for i, each in enumerate(names) if each == name]] for name in dict.fromkeys(names)}
        self.members = {name: members for name, members in own.items() if len(members) > 1}

    def first(self, family: str, count: int) -> Tensor:
        """Draw at most `count` different materials whose P-wave modulus the estimate leaves possible."""
        members = self.members[family]
        modulus = p_wave_modulus(self.operator, members)
        possible = members[(modulus > self.limits[0]) & (modulus < self.limits[1])]
        return possible[torch.randperm(len(possible), generator=self.generator)[:count].to(possible.device)]

    def about(self, latent: Tensor, family: str, count: int, spread: float) -> Tensor:
        """Draw latents (count, d) on the lines from a latent to materials of its family, up to a share `spread` of the way or back."""
        members = self.members[family]
        others = members[torch.randint(len(members), (count,), generator=self.generator)]
        share = spread * (2 * torch.rand(count, 1, generator=self.generator) - 1)
        return torch.lerp(latent.expand(count, -1), others, share.to(latent))


@torch.no_grad()
def explore(scene: PreparedScene, operator: IntrinsicDynamicsOperator, z: Tensor, count: int, seed: int = 0) -> Posterior:
    """Simulate an estimate z (d,) and about `count` laws that it leaves possible: materials of Stage I, and laws about the best of them."""
    draws = Draws(operator, z, seed)
    found = [(z, image_error(scene, operator, z), "")]
    each = max(1, count // (2 * max(1, len(draws.members))))
    for turn in range(ROUNDS + 1):
        for family in draws.members:
            own = [row for row in found if row[2] == family]
            if turn == 0:
                latents = draws.first(family, each)
            elif own:
                best = min(own, key=lambda row: row[1])[0]
                latents = draws.about(best, family, -(-each // ROUNDS), 0.5**turn)
            else:
                continue
            found += [(latent, image_error(scene, operator, latent), family) for latent in latents]
    latents, errors, families = zip(*found)
    return Posterior(torch.stack(latents), torch.tensor(errors), list(families))


@torch.no_grad()
def image_error(scene: PreparedScene, operator: IntrinsicDynamicsOperator, z: Tensor) -> float:
    """Simulate a scene with the law of z (d,); return the squared error of its images, infinite if it cannot be simulated."""
    views = scene.training_views[:: -(-len(scene.training_views) // VIEWS)]
    try:
        images, _ = render_motion(scene, rollout_latent(scene, operator, z), views)
    except UserError:
        return float("inf")
    return float(functional.mse_loss(images, scene.recorded(views)))
