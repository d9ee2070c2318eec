"""Ways to fit the law of one scene to its images, behind one interface: ours (`low_rank`) and those of the peers (`baselines`).

`AdaptModule` trains any of them: it draws the motion of `Method.rollout`, compares images, and steps over the method's parameters.
"""

import copy
import json
import math
from pathlib import Path
from typing import Any, Self

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from neuido.data.files.storage import write
from neuido.data.files.writing import replacing
from neuido.errors import UserError
from neuido.models.inference.pipeline import rollout_laws
from neuido.models.inference.prepared_scene import Laws, PreparedScene
from neuido.models.video.encoder import DynamicsEncoder
from neuido.physics.effects.parameters import Effects
from neuido.types import ParticleState

FORMAT = "neuido-method/1"
PARAMETERS, CARD = "parameters.safetensors", "method.json"


class Method(nn.Module):
    """How a law is fitted to the images of a scene.

    What YAML constructs (`class_path`, and primitives as `init_args`) is a plan; `for_scene` makes a copy of it for one scene, with that
    scene's parameters. A subclass writes `build` and `laws`, and of the rest what differs; one that is no MPM law writes `roll`.

    Attributes:
        steps: Optimiser steps a scene takes unless told otherwise; 0: nothing is learned, the scene is only scored.
        lr: Rate of the one group of parameters of the default `parameter_groups`.
        encoder: What embeds a scene's flow (`PreparedScene.volume`); none: the method needs no flow.
    """

    steps: int = 100
    lr: float = 1e-3
    encoder: DynamicsEncoder | None = None

    def for_scene(self, scene: PreparedScene) -> Self:
        """Copy the method with parameters for one scene, on its device; the encoder is shared."""
        own = copy.deepcopy(self, {id(self.encoder): self.encoder})
        own.build(scene)
        own.to(scene.images.device)
        own._start = [p.detach().clone() for p in own.trainable().values()]
        return own

    def build(self, scene: PreparedScene) -> None:
        """Create the scene's parameters at their start values, the same ones at each call (seed what is random)."""

    def laws(self, scene: PreparedScene) -> Laws:
        """Return the elastic and the plastic law of the scene; their tensors are graph nodes of the parameters."""
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
        """Simulate the first `frames` frames, differentiably in parameters and `state`; other kinds of simulation override this.

        Args:
            scene: The scene; its step may be finer than that of `build` (`pipeline.rollout_with_retries`).
            frames: Number of frames K, the start included.
            state: Start, (P, ...); the scene's body where absent.
            effects: Effects that act on top of the laws.
            segment: As `pipeline.rollout_laws`, in frames.

        Returns:
            x (K, P, 3), v (K, P, 3), C (K, P, 3, 3), F (K, P, 3, 3).

        Raises:
            UserError: As `Simulator.rollout`.
        """
        return rollout_laws(scene, self.laws(scene), frames, segment=segment, state=state, effects=effects)

    def trainable(self) -> dict[str, nn.Parameter]:
        """Return the parameters that are fitted, by name."""
        return {name: p for name, p in self.named_parameters() if p.requires_grad}

    def parameter_groups(self) -> list[dict[str, Any]]:
        """Return groups for the optimiser, each with `params` and its rate `lr`."""
        return [{"params": list(self.trainable().values()), "lr": self.lr}] if self.trainable() else []

    def optimizer(self, groups: list[dict[str, Any]]) -> torch.optim.Optimizer:
        """Return the optimiser over the groups of all scenes."""
        return torch.optim.AdamW(groups, weight_decay=0.0)

    def rate(self, done: float) -> float:
        """Return the factor on the learning rates after the share `done` of a scene's steps: a cosine to zero."""
        return 0.5 * (1 + math.cos(math.pi * min(1.0, done)))

    def regulariser(self) -> Tensor | float:
        """Return the regularisation term of the loss."""
        return 0.0

    def recovery_loss(self) -> Tensor:
        """Return the loss of a step whose law could not run: the mean squared distance from the start."""
        parts = [(p - start.to(p)).square().sum() for p, start in zip(self.trainable().values(), self._start)]
        return torch.stack(parts).sum() / max(1, sum(start.numel() for start in self._start))

    def describe(self) -> dict[str, Any]:
        """Return what was identified, as numbers, words and lists of numbers: parameters in SI units, moduli, the latent."""
        return {}

    def save(self, folder: Path) -> None:
        """Write what was fitted to a folder: parameters as safetensors, `describe` as JSON."""
        tensors = {name: p.detach().cpu().contiguous().clone() for name, p in self.trainable().items()}
        write_tensors(folder / PARAMETERS, tensors)
        self.write_card(folder)

    def card(self) -> dict[str, Any]:
        """Return the content of `method.json`: the method's name and `describe`."""
        return {"format": FORMAT, "method": type(self).__name__, "found": self.describe()}

    def write_card(self, folder: Path) -> None:
        """Write `method.json`."""
        folder.mkdir(parents=True, exist_ok=True)
        write(folder / CARD, json.dumps(self.card(), indent=1) + "\n")

    def load(self, folder: Path) -> None:
        """Take what `save` wrote.

        Raises:
            UserError: A file that is missing or of another method, a tensor that is missing or of another shape.
        """
        self.check_card(folder)
        given = read_tensors(folder / PARAMETERS)
        for name, p in self.trainable().items():
            if name not in given or given[name].shape != p.shape:
                found = tuple(given[name].shape) if name in given else "missing"
                raise UserError(f"model.adapter: {folder / PARAMETERS}: {name} is {found}, needed {tuple(p.shape)}")
            with torch.no_grad():
                p.copy_(given[name])

    def check_card(self, folder: Path) -> dict[str, Any]:
        """Read `method.json` and check that it belongs to this method.

        Raises:
            UserError: It is missing, or another method wrote it.
        """
        path = folder / CARD
        try:
            content = json.loads(path.read_text())
        except (OSError, ValueError) as error:
            raise UserError(f"model.adapter: {path} is missing or no JSON: {error}") from error
        if not isinstance(content, dict) or content.get("format") != FORMAT or content.get("method") != type(self).__name__:
            found = content.get("method") if isinstance(content, dict) else None
            raise UserError(f"model.adapter: {path} is of method {found!r}, model.method is {type(self).__name__}")
        return content


def write_tensors(path: Path, tensors: dict[str, Tensor]) -> None:
    """Write a safetensors file, all at once."""
    with replacing(path) as hidden:
        save_file(tensors, hidden)


def read_tensors(path: Path) -> dict[str, Tensor]:
    """Read a safetensors file.

    Raises:
        UserError: It is missing or damaged.
    """
    if not path.is_file():
        raise UserError(f"model.adapter: {path} is missing")
    try:
        return load_file(path)
    except SafetensorError as error:
        raise UserError(f"model.adapter: {path} is not a safetensors file: {error}") from error


def scalars(found: dict[str, Any]) -> dict[str, Any]:
    """Select the entries of `describe` that fit into a table: numbers and words."""
    return {name: value for name, value in found.items() if isinstance(value, int | float | str)}


def require_positive(**values: float) -> None:
    """Refuse options of a method that are not positive numbers.

    Raises:
        UserError: Names the option and the value.
    """
    for name, value in values.items():
        if not 0 < value < math.inf:
            raise UserError(f"model.method.{name} = {value}: it must be positive")
