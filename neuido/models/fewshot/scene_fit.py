"""What is fitted of one scene: a method's parameters and, where they are estimated, the start of the motion and the body's filling."""

from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from neuido.errors import UserError
from neuido.models.fewshot.method import Method, read_tensors, write_tensors
from neuido.models.fewshot.relative_density import RelativeDensity
from neuido.models.inference.prepared_scene import PreparedScene
from neuido.physics.effects.parameters import Effects
from neuido.physics.mpm.simulator import Simulator
from neuido.types import ParticleState

START, DENSITY = "start.safetensors", "density.safetensors"


class EffectSource:
    """Where effects come from that act on top of a scene's law, known and not fitted; YAML gives a subclass by `class_path`."""

    def of(self, scene: PreparedScene) -> Effects:
        """Return the effects for a rollout of the scene, whose step may be finer than the recording's."""
        raise NotImplementedError


class SceneFit(nn.Module):
    """One scene's method and, where they are estimated, what its initial velocity lacks and how densely its body is filled.

    Args:
        method: Of `Method.for_scene`.
        estimate_velocity: Whether a rigid motion is added to the body's known velocity.
        effects: What else acts on the body; none: nothing.
        density: The body's relative density; none: it is filled evenly.
    """

    def __init__(
        self,
        method: Method,
        estimate_velocity: bool = False,
        effects: EffectSource | None = None,
        density: RelativeDensity | None = None,
    ):
        super().__init__()
        self.density = density
        self.method, self.effects = method, effects
        self.twist = nn.Parameter(torch.zeros(2, 3)) if estimate_velocity else None
        """Velocity of the centre [m/s] and angular velocity about it [rad/s]."""

    def rollout(self, scene: PreparedScene, frames: int, segment: int = 0) -> ParticleState:
        """Simulate with `Method.rollout` from the start state of this fit."""
        effects = None if self.effects is None else self.effects.of(scene)
        if self.density is not None:
            effects, own = Effects() if effects is None else effects, self.density()
            given = effects.relative_density
            effects = effects._replace(relative_density=own if given is None else given * own)
        return self.method.rollout(scene, frames, state=self.start(scene.simulator), effects=effects, segment=segment)

    def start(self, simulator: Simulator) -> ParticleState | None:
        """Return the state at t = 0; None where it is the body's own."""
        if self.twist is None:
            return None
        linear, angular = self.twist.to(simulator.dtype)
        x, v, C, F = simulator.state
        centre = (simulator.mass[:, None] * x).sum(0) / simulator.mass.sum()
        zero = angular.new_zeros(())
        a, b, c = angular
        spin = torch.stack([zero, -c, b, c, zero, -a, -b, a, zero]).view(3, 3)
        return ParticleState(x, v + linear + (x - centre) @ spin.T, C + spin, F)

    def regulariser(self, density_weight: float = 0.0) -> Tensor | float:
        """Return `Method.regulariser` plus the relative density's prior times `density_weight`."""
        total = self.method.regulariser()
        return total if self.density is None else total + density_weight * self.density.prior()

    def save(self, folder: Path) -> None:
        """Write the method, the correction of the velocity, and the relative density."""
        self.method.save(folder)
        if self.density is not None:
            self.density.save(folder / DENSITY)
        if self.twist is not None:
            write_tensors(folder / START, {"twist": self.twist.detach().cpu().clone()})

    def load(self, folder: Path) -> None:
        """Take what `save` wrote.

        Raises:
            UserError: As `Method.load` and `RelativeDensity.load`; a file without `twist`.
        """
        self.method.load(folder)
        if self.density is not None and (folder / DENSITY).is_file():
            self.density.load(folder / DENSITY)
        if (folder / START).is_file():
            found = read_tensors(folder / START).get("twist")
            if found is None or found.shape != (2, 3):
                raise UserError(f"model.adapter: {folder / START} holds no twist of shape (2, 3)")
            self.twist = nn.Parameter(found.to(next(self.buffers(), found).device))

    def describe(self) -> dict[str, Any]:
        """Return what was identified, with the correction of the velocity and the spread of the density's logarithm."""
        found = self.method.describe()
        if self.density is not None:
            found = found | {"density_spread": float(self.density.prior().detach().sqrt())}
        if self.twist is None:
            return found
        linear, angular = self.twist.detach().tolist()
        return found | {"velocity_added": linear, "angular_velocity_added": angular}
