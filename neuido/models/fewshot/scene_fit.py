"""The fit of one scene: the parameters of a method and, optionally, an initial velocity and a relative density."""

from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from neuido.errors import UserError
from neuido.models.fewshot.method import Method, read_tensors, write_tensors
from neuido.models.fewshot.relative_density import RelativeDensity
from neuido.models.inference.prepared_scene import EffectSource, PreparedScene
from neuido.physics.effects.parameters import Effects
from neuido.physics.mpm.simulator import Simulator
from neuido.types import ParticleState

START, DENSITY = "start.safetensors", "density.safetensors"


class SceneFit(nn.Module):
    """Method of one scene and, optionally, a correction of its initial velocity and a relative density.

    Args:
        method: A method returned by `Method.for_scene`.
        estimate_velocity: Whether to add a fitted rigid velocity to the known initial velocity.
        effects: Source of further effects on the body.
        density: Relative density of the body; evenly filled where absent.
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
        """Velocity of the centre of mass [m/s] and angular velocity about it [rad/s], (2, 3)."""

    def rollout(self, scene: PreparedScene, frames: int, segment: int = 0) -> ParticleState:
        """Simulate with `Method.rollout` from the initial state of this fit."""
        effects = None if self.effects is None else self.effects.of(scene)
        if self.density is not None:
            effects, own = Effects() if effects is None else effects, self.density()
            given = effects.relative_density
            effects = effects._replace(relative_density=own if given is None else given * own)
        return self.method.rollout(scene, frames, state=self.start(scene.simulator), effects=effects, segment=segment)

    def start(self, simulator: Simulator) -> ParticleState | None:
        """Return the state at t = 0, or None if the velocity of the body is not corrected."""
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
        """Return `Method.regulariser` plus `density_weight` times the prior of the relative density."""
        total = self.method.regulariser()
        return total if self.density is None else total + density_weight * self.density.prior()

    def save(self, folder: Path) -> None:
        """Write the fit of the method, the velocity correction and the relative density."""
        self.method.save(folder)
        if self.density is not None:
            self.density.save(folder / DENSITY)
        if self.twist is not None:
            write_tensors(folder / START, {"twist": self.twist.detach().cpu().clone()})

    def load(self, folder: Path) -> None:
        """Load what `save` wrote.

        Raises:
            UserError: As in `Method.load` and `RelativeDensity.load`, or a file without `twist`.
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
        """Return `Method.describe` with the velocity correction and the standard deviation of the log density."""
        found = self.method.describe()
        if self.density is not None:
            found = found | {"density_spread": float(self.density.prior().detach().sqrt())}
        if self.twist is None:
            return found
        linear, angular = self.twist.detach().tolist()
        return found | {"velocity_added": linear, "angular_velocity_added": angular}
