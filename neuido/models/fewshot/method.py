"""Common interface of the methods that fit the law of one scene to its images: ours (`low_rank`) and the `baselines`.

`AdaptModule` trains any of them: it renders the motion of `Method.rollout`, compares the images, and optimises the parameters.
"""

import copy
import math
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor, nn

from neuido.data.files.parsing import read_json
from neuido.data.files.values import with_prefix
from neuido.data.files.writing import write_json
from neuido.data.weight_files import read_safetensors, write_safetensors
from neuido.errors import UserError
from neuido.models.inference.pipeline import rollout_laws
from neuido.models.inference.prepared_scene import Laws, PreparedScene
from neuido.models.video.encoder import DynamicsEncoder
from neuido.physics.effects.parameters import Effects
from neuido.types import ParticleState

FORMAT = "neuido-method/1"
PARAMETERS, CARD = "parameters.safetensors", "method.json"
PASCALS = ("modulus", "young", "yield_stress")
"""Names of quantities in Pa."""
UNITS = {"friction_angle": " degrees", "viscosity": " Pa s"}


class Method(nn.Module):
    """Base class of methods that fit a law to the images of a scene.

    A configuration constructs a template (`class_path`, and primitives as `init_args`); `for_scene` copies it and adds the parameters of
    one scene. A subclass implements `build` and `laws`; a method that is not an MPM law overrides `rollout` instead.

    Attributes:
        steps: Default number of optimiser steps for a scene; 0: nothing is learned and the scene is only scored.
        lr: Learning rate in the default `parameter_groups`.
        encoder: Encoder that embeds the flow of a scene (`PreparedScene.volume`), if the method needs flow.
    """

    steps: int = 100
    lr: float = 1e-3
    encoder: DynamicsEncoder | None = None
    _start: list[Tensor]

    def for_scene(self, scene: PreparedScene) -> Self:
        """Return a copy with parameters for one scene, on the device of the scene; the encoder is shared."""
        own = copy.deepcopy(self, {id(self.encoder): self.encoder})
        own.build(scene)
        own.to(scene.images.device)
        own._start = [p.detach().clone() for p in own.trainable().values()]
        return own

    def build(self, scene: PreparedScene) -> None:
        """Create the parameters of the scene at their initial values, reproducibly: seed what is random."""

    def laws(self, scene: PreparedScene) -> Laws:
        """Return the elastic and the plastic law of the scene, differentiable in the parameters."""
        raise NotImplementedError

    def rollout(
        self,
        scene: PreparedScene,
        frames: int,
        *,
        state: ParticleState | None = None,
        effects: Effects | None = None,
        segment: int = 0,
    ) -> ParticleState:
        """Simulate the first `frames` frames, differentiably in the parameters and `state`.

        Args:
            scene: The scene; its time step may be smaller than that of `build` (`pipeline.rollout_with_retries`).
            frames: Number of frames K, including the initial one.
            state: Initial state, (P, ...); that of the scene where absent.
            effects: Effects that act in addition to the laws.
            segment: As in `pipeline.rollout_laws`, in frames.

        Returns:
            x (K, P, 3), v (K, P, 3), C (K, P, 3, 3), F (K, P, 3, 3).

        Raises:
            UserError: As in `Simulator.rollout`.
        """
        return rollout_laws(scene, self.laws(scene), frames, segment=segment, state=state, effects=effects)

    def trainable(self) -> dict[str, nn.Parameter]:
        """Return the trainable parameters by name."""
        return {name: p for name, p in self.named_parameters() if p.requires_grad}

    def parameter_groups(self) -> list[dict[str, Any]]:
        """Return parameter groups for the optimiser, each with `params` and a learning rate `lr`."""
        return [{"params": list(self.trainable().values()), "lr": self.lr}] if self.trainable() else []

    def optimizer(self, groups: list[dict[str, Any]]) -> torch.optim.Optimizer:
        """Return the optimiser of the parameter groups of all scenes."""
        return torch.optim.AdamW(groups, weight_decay=0.0)

    def rate(self, done: float) -> float:
        """Return the factor on the learning rates after a fraction `done` of the steps: a cosine to zero."""
        return 0.5 * (1 + math.cos(math.pi * min(1.0, done)))

    def regulariser(self) -> Tensor | float:
        """Return the regularisation term of the loss."""
        return 0.0

    def recovery_loss(self) -> Tensor:
        """Return the loss of a step whose simulation failed: the mean squared distance of the parameters from their initial values."""
        parts = [(p - start.to(p)).square().sum() for p, start in zip(self.trainable().values(), self._start)]
        return torch.stack(parts).sum() / max(1, sum(start.numel() for start in self._start))

    def describe(self) -> dict[str, Any]:
        """Return the identified quantities as numbers, strings and lists: parameters in SI units, moduli, the latent."""
        return {}

    def summary(self) -> str:
        """Return the law that was found in one line, with units."""
        parts = []
        for name, value in self.describe().items():
            if isinstance(value, str):
                parts.append(value if name in ("elasticity", "plasticity", "base") else f"{name} = {value}")
            elif isinstance(value, int | float):
                figure = with_prefix(value, "Pa") if name in PASCALS else f"{value:.4g}{UNITS.get(name, '')}"
                parts.append(f"{name} = {figure}")
        return ", ".join(parts)

    def save(self, folder: Path) -> None:
        """Write the fit to a folder: the parameters as safetensors, and `describe` as JSON."""
        tensors = {name: p.detach().cpu().contiguous().clone() for name, p in self.trainable().items()}
        write_tensors(folder / PARAMETERS, tensors)
        self.write_card(folder)

    def card(self) -> dict[str, Any]:
        """Return the content of `method.json`: the method's name and `describe`."""
        return {"format": FORMAT, "method": type(self).__name__, "found": self.describe()}

    def write_card(self, folder: Path) -> None:
        """Write `method.json`."""
        folder.mkdir(parents=True, exist_ok=True)
        write_json(folder / CARD, self.card())

    def load(self, folder: Path) -> None:
        """Load what `save` wrote.

        Raises:
            UserError: A file is missing or belongs to another method, or a tensor is missing or has another shape.
        """
        self.check_card(folder)
        given = read_tensors(folder / PARAMETERS)
        for name, p in self.trainable().items():
            if name not in given or given[name].shape != p.shape:
                found = tuple(given[name].shape) if name in given else "missing"
                raise UserError(f"model.adapter: {folder / PARAMETERS}: {name} is {found}, expected {tuple(p.shape)}")
            with torch.no_grad():
                p.copy_(given[name])

    def check_card(self, folder: Path) -> dict[str, Any]:
        """Read `method.json` and check that it belongs to this method.

        Raises:
            UserError: The file is missing, or another method wrote it.
        """
        path = folder / CARD
        try:
            content = read_json(path)
        except UserError as error:
            raise UserError(f"model.adapter: {error}") from error
        if not isinstance(content, dict) or content.get("format") != FORMAT or content.get("method") != type(self).__name__:
            found = content.get("method") if isinstance(content, dict) else None
            raise UserError(f"model.adapter: {path} is of the method {found!r}, but model.method is {type(self).__name__}")
        return content


def write_tensors(path: Path, tensors: dict[str, Tensor]) -> None:
    """Write a safetensors file atomically."""
    write_safetensors(path, tensors)


def read_tensors(path: Path) -> dict[str, Tensor]:
    """Read a safetensors file.

    Raises:
        UserError: The file is missing or damaged.
    """
    try:
        return read_safetensors(path)[0]
    except UserError as error:
        raise UserError(f"model.adapter: {error}") from error


def scalars(found: dict[str, Any]) -> dict[str, Any]:
    """Select the entries of `describe` that fit into a table: numbers and strings."""
    return {name: value for name, value in found.items() if isinstance(value, int | float | str)}


def require_positive(**values: float) -> None:
    """Check that options of a method are positive and finite.

    Raises:
        UserError: An option is not; the message names it and its value.
    """
    for name, value in values.items():
        if not 0 < value < math.inf:
            raise UserError(f"model.method.{name} = {value}: it must be positive")
