"""Spring-Gaus (Zhong et al. 2024): a mass-spring body whose stiffness is fitted to images, as a `Method`."""

import math
from typing import Any, Literal

import torch
from torch import Tensor, nn

from neuido.data.files.renamed_options import renamed_options
from neuido.errors import UserError
from neuido.models.fewshot.method import Method, require_positive
from neuido.models.inference.prepared_scene import Laws, PreparedScene
from neuido.physics.effects.parameters import Effects
from neuido.physics.springs.mass_spring import MassSpring, connect
from neuido.types import ParticleState


@renamed_options(per="stiffness_per", firm="full_stiffness_neighbours")
class SpringMass(Method):
    """Fit a mass-spring network: anchor particles carry the mass, springs connect them, and the other particles follow nearby anchors.

    The parameters are those of Spring-Gaus. The stiffness of a spring of rest length L is k = 10^a / L, with a per anchor (a spring has the
    mean of its two ends), per spring, or for the whole body. Springs beyond the `full_stiffness_neighbours` nearest ones of a mass weaken
    with their rank by a learned amount. The damping is 10^b m / L. The last parameter is the share of the tangential velocity that remains
    after contact with the ground. Gaussians move with the particles and keep their shape.

    Differences from Spring-Gaus: springs act on both ends, the initial stiffness follows from a modulus, and particles follow
    the displacement of their anchors, so the first frame is exact.

    Args:
        anchors: Number of masses, selected among the particles by farthest-point sampling; at most the number of particles.
        neighbours: Number of springs from each anchor.
        binding: Number of anchors that a particle follows, weighted by the inverse square root of the distance.
        stiffness_per: Granularity of the stiffness: `anchor`, `spring`, or `body`.
        full_stiffness_neighbours: Number of nearest neighbours whose springs do not weaken.
        power: Exponent p of the force (`spring_kernels`).
        young: Initial Young's modulus [Pa] of the body (`modulus`).
        damping: Initial 10^b for the mass m of one anchor [m/s]; 0: no damping.
        fit_damping: Whether to fit b.
        stiffness_rate, other_rate: Learning rates of a, and of all other parameters.

    Raises:
        UserError: A size is below one, or a number is not positive.
    """

    steps = 300

    def __init__(
        self,
        anchors: int = 2048,
        neighbours: int = 256,
        binding: int = 16,
        stiffness_per: Literal["anchor", "spring", "body"] = "anchor",
        full_stiffness_neighbours: int = 16,
        power: float = 0.5,
        young: float = 1e5,
        damping: float = 0.1,
        fit_damping: bool = False,
        stiffness_rate: float = 0.01,
        other_rate: float = 0.01,
    ):
        super().__init__()
        sizes = {"anchors": anchors - 1, "neighbours": neighbours, "binding": binding}
        sizes["full_stiffness_neighbours"] = full_stiffness_neighbours
        for name, value in sizes.items():
            if value < 1:
                raise UserError(f"model.method.{name} = {value + (name == 'anchors')}: at least {1 + (name == 'anchors')} is needed")
        require_positive(
            young=young, stiffness_rate=stiffness_rate, other_rate=other_rate, **({} if damping == 0 else {"damping": damping})
        )
        self.count, self.neighbours, self.nearest = anchors, neighbours, binding
        self.stiffness_per, self.full_stiffness_neighbours = stiffness_per, full_stiffness_neighbours
        self.power, self.young, self.fit_damping = power, young, fit_damping
        self.damping_start, self.stiffness_rate, self.other_rate = damping, stiffness_rate, other_rate

    def build(self, scene: PreparedScene) -> None:
        simulator = scene.simulator
        x = simulator.state.x
        self.index = farthest_points(x, self.count)
        self.network = connect(x[self.index], self.neighbours)
        mass = (simulator.mass.sum() / len(self.index)).expand(len(self.index))
        self.body = MassSpring(scene.source.scene, self.network, mass, power=self.power)
        self.follow = following(x, x[self.index], self.nearest)
        self.volume = float(simulator.volume.sum())
        device, one = x.device, torch.ones(1, device=x.device)
        size = {"anchor": len(self.index), "spring": len(self.network.rest), "body": 1}[self.stiffness_per]
        start = math.log10(self.damping_start) if self.damping_start else 0.0
        self.soft, self.slide = nn.Parameter(0.0 * one), nn.Parameter(-one)
        self.damping = nn.Parameter(start * one, requires_grad=self.fit_damping and self.damping_start > 0)
        self.stiffness = nn.Parameter(torch.zeros(size, device=device))
        with torch.no_grad():  # the modulus is proportional to the stiffness
            self.stiffness += math.log10(self.young / float(self.modulus(self.springs()[0])))

    def springs(self) -> tuple[Tensor, Tensor]:
        """Return the stiffness [N/m] and damping [N s/m] of each spring, (N,) each."""
        level = self.stiffness
        if self.stiffness_per == "anchor":
            level = level[self.network.pairs].mean(1)
        rest = self.body.rest
        weakened = max(1, self.neighbours - self.full_stiffness_neighbours)
        rank = ((self.network.rank - self.full_stiffness_neighbours).clamp(min=0) / weakened).to(rest)
        weak = (2 - nn.functional.softplus(self.soft).exp() ** rank).clamp(0, 1)
        damping = 10**self.damping * self.body.mass[0] / rest if self.damping_start else torch.zeros_like(rest)
        return 10**level * weak / rest, damping

    def modulus(self, stiffness: Tensor) -> Tensor:
        """Return Young's modulus [Pa] of isotropically oriented springs, E = sum k L^2 / (6 V); Poisson's ratio is 1/4 (Cauchy), ()."""
        return (stiffness * self.body.rest.square()).sum() / (6 * self.volume)

    def tangential_retention(self) -> Tensor:
        """Return the share of the tangential velocity that remains after a step in contact (Spring-Gaus, `fric_k`), (1,)."""
        return (1.2 * self.slide.sigmoid() - 0.1).clamp(0, 1)

    def laws(self, scene: PreparedScene) -> Laws:
        raise UserError("model.method = SpringMass has no law of F: do not use condition_files")

    def rollout(
        self,
        scene: PreparedScene,
        frames: int,
        *,
        state: ParticleState | None = None,
        effects: Effects | None = None,
        segment: int = 0,
    ) -> ParticleState:
        """Simulate as `Method.rollout`; F stays the identity, and `segment` is ignored because the state is small.

        Raises:
            UserError: Effects are given, or the motion is not finite.
        """
        if effects is not None and effects != Effects():
            raise UserError("model.effects, estimate_density: SpringMass takes no effects and no density, which act on an MPM law")
        state = scene.simulator.state if state is None else state
        stiffness, damping = self.springs()
        dt = scene.simulator.scenes[0].dt
        parts = self.body.substeps(stiffness, damping, dt)
        start = (state.x[self.index], state.v[self.index])
        every = scene.every * parts
        parameters = stiffness, damping, self.tangential_retention()
        x, v = self.body.rollout(scene.substeps(frames) * parts, dt / parts, *start, *parameters, every=every)
        wanted = slice(frames) if scene.recorded_frames is None else list(scene.recorded_frames[:frames])
        x, v = x[wanted], v[wanted]
        both = torch.cat([x - x[:1], v - v[:1]], -1).transpose(0, 1)  # (A, K, 6)
        moved = torch.sparse.mm(self.follow, both.flatten(1)).view(len(state.x), frames, 6).transpose(0, 1)
        eye = torch.eye(3, device=x.device, dtype=x.dtype).expand(frames, len(state.x), 3, 3)
        return ParticleState(state.x + moved[..., :3], state.v + moved[..., 3:], torch.zeros_like(eye), eye)

    def parameter_groups(self) -> list[dict[str, Any]]:
        others = [p for p in (self.soft, self.slide, self.damping) if p.requires_grad]
        return [{"params": [self.stiffness], "lr": self.stiffness_rate}, {"params": others, "lr": self.other_rate}]

    def describe(self) -> dict[str, Any]:
        with torch.no_grad():
            stiffness, _ = self.springs()
            found = {"young": self.modulus(stiffness), "tangential_retention": self.tangential_retention()[0]}
            found |= {"damping": 10 ** self.damping[0], "soft": self.soft[0]}
        found["damping"] = found["damping"] if self.damping_start else torch.zeros(())
        return {"anchors": len(self.index), "springs": len(stiffness), **{name: float(value) for name, value in found.items()}}


def farthest_points(x: Tensor, count: int) -> Tensor:
    """Return indices (min(count, P),) of points (P, 3) by farthest-point sampling, starting at the point nearest to the mean."""
    count = min(count, len(x))
    distance = (x - x.mean(0)).square().sum(1)
    found = torch.empty(count, dtype=torch.int64, device=x.device)
    found[0] = distance.argmin()
    distance = torch.full_like(distance, torch.inf)
    for n in range(count):
        if n:
            found[n] = distance.argmax()
        distance = torch.minimum(distance, (x - x[found[n]]).square().sum(1))
    return found


def following(x: Tensor, anchors: Tensor, nearest: int) -> Tensor:
    """Return the sparse weights (P, A) by which points (P, 3) follow anchors (A, 3): inverse square root of the distance (Spring-Gaus)."""
    from scipy.spatial import cKDTree

    nearest = min(nearest, len(anchors))
    distance, index = cKDTree(anchors.detach().double().cpu().numpy()).query(x.detach().double().cpu().numpy(), k=nearest)
    distance, index = (torch.as_tensor(part).reshape(len(x), nearest) for part in (distance, index))
    weight = 1 / (distance.sqrt() + 1e-14)
    weight = (weight / weight.sum(1, keepdim=True)).to(x)
    rows = torch.arange(len(x)).repeat_interleave(nearest)
    place = torch.stack([rows, index.flatten()]).to(x.device)
    return torch.sparse_coo_tensor(place, weight.flatten(), (len(x), len(anchors)), check_invariants=True).coalesce()
