"""Zero-shot inference of a law from a video in one pass of the encoder, for `read_law` and `neuido predict`."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neuido.data.scenes.filmed_scene import VisualScene, load_visual_scene
from neuido.models.inference.law_file import save_law
from neuido.models.inference.pipeline import infer_latent, rollout_latent, rollout_with_retries
from neuido.models.inference.prepared_scene import Laws, PreparedScene, as_device, prepare
from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
from neuido.models.operator.law_properties import Moduli, small_strain_moduli
from neuido.models.video.encoder import DynamicsEncoder
from neuido.models.video.reader import Readings
from neuido.types import ParticleState


class VideoLaw:
    """The law of one recorded body: a latent, and the elastic and plastic laws that the operator makes of it.

    Args:
        operator: The operator.
        latent: z, (d,).
        scene: Name of the recorded scene.
        views: Number of views that the encoder used.
        frames: Number of recorded frames.
        seconds: Measured time from the flow latents to the law [s].
        prepared: The scene, which `rollout` needs.
        readings: Family and properties of the material with their uncertainty; None of an encoder without a reader.
    """

    def __init__(
        self,
        operator: IntrinsicDynamicsOperator,
        latent: Tensor,
        *,
        scene: str = "",
        views: int = 0,
        frames: int = 0,
        seconds: float | None = None,
        prepared: PreparedScene | None = None,
        readings: Readings | None = None,
    ):
        self.operator, self.latent, self.prepared, self.readings = operator, latent.detach(), prepared, readings
        self.scene, self.views, self.frames, self.seconds = scene, views, frames, seconds
        with torch.no_grad():
            young, poisson = small_strain_moduli(operator, self.latent[None])
        self.moduli = Moduli(float(young[0]), float(poisson[0]))
        """Young's modulus [Pa] and Poisson's ratio [-] at small strains."""

    @classmethod
    def infer(
        cls, encoder: DynamicsEncoder, operator: IntrinsicDynamicsOperator, prepared: PreparedScene, *, repeat: int = 5
    ) -> "VideoLaw":
        """Infer the law of a prepared scene.

        Args:
            encoder: Encoder on the device of the scene.
            operator: Operator on the device of the scene.
            prepared: Result of `prepare` with this encoder.
            repeat: Number of passes to time; `seconds` is their median.
        """
        found = infer_latent(encoder, operator, prepared, repeat=repeat)
        views = 0 if prepared.volume is None else len(prepared.volume)
        readings = None if prepared.volume is None or prepared.conditions is None else encoder.read(prepared.volume, prepared.conditions)
        known = {"scene": prepared.source.name, "views": views, "frames": prepared.frames, "seconds": found.seconds}
        return cls(operator, found.z, **known, prepared=prepared, readings=readings)

    def law(self) -> Laws:
        """Return the elastic and the plastic law for `Simulator.rollout`."""
        return self.operator.laws(self.latent)

    def rollout(self, frames: int | None = None) -> tuple[ParticleState, int]:
        """Simulate the recorded body with this law.

        Args:
            frames: Number of frames K, including the initial one; all recorded frames where absent.

        Returns:
            The motion, (K, P, ...), and how often the time step was halved because the law is too stiff for that of the scene.

        Raises:
            UserError: The simulation fails even with a quarter of the time step of the scene.
            ValueError: The law has no scene.
        """
        if self.prepared is None:
            raise ValueError("this law has no scene: simulate it with Simulator(scene, body).rollout(steps, *law.law())")
        with torch.no_grad():
            return rollout_with_retries(self.prepared, lambda scene: rollout_latent(scene, self.operator, self.latent, frames))

    def save(self, path: str | os.PathLike) -> None:
        """Write the law to a .safetensors file, and a readable description to a .json file next to it.

        `neuido.models.load_law` reads the file; it does not need the operator.
        """
        card: dict[str, Any] = {"scene": self.scene, "views": self.views, "frames": self.frames, "seconds": self.seconds}
        if self.readings is not None:
            card["readings"] = self.readings.as_dict()
        save_law(Path(path), self.operator, self.latent, card | {"young": self.moduli.young, "poisson": self.moduli.poisson})

    def summary(self) -> str:
        """Return the moduli of the law with their units and the inference time in one line."""
        if self.seconds is None:
            return str(self.moduli)
        whole = "" if self.prepared is None else f", {self.seconds + self.prepared.flow_seconds:.2g} s from the images"
        return f"{self.moduli}; law read in {1e3 * self.seconds:.1f} ms{whole}"

    def report(self) -> list[str]:
        """Return the lines that `neuido predict` prints: the readings of the material, if there are any, and the summary of the law."""
        readings = [] if self.readings is None else self.readings.lines()
        return [*readings, self.summary() if self.readings is None else f"law: {self.summary()}"]

    def __repr__(self) -> str:
        name = f"{self.scene!r}, " if self.scene else ""
        read = "" if self.readings is None else f"{self.readings.family} ({100 * self.readings.families[self.readings.family]:.0f} %), "
        return f"VideoLaw({name}{read}{self.moduli}, latent of {len(self.latent)}, {self.views} views, {self.frames} frames)"


def read_law(
    recording: str | os.PathLike | VisualScene,
    *,
    operator: str | os.PathLike | IntrinsicDynamicsOperator = "pretrained",
    encoder: str | os.PathLike | DynamicsEncoder = "pretrained",
    reconstruction: str | os.PathLike | None = None,
    recording_name: str | None = None,
    views: Sequence[str] | None = None,
    frame_step: int = 1,
    frame_count: int | None = None,
    encoder_views: int = 0,
    cache: str | os.PathLike | None = None,
    device: str | torch.device = "auto",
) -> VideoLaw:
    """Infer a material law from the video of a moving body, zero-shot, as `neuido predict` does.

    Args:
        recording: Folder of a multi-view recording that `neuido reconstruct` has prepared, or a scene of `load_visual_scene`.
        operator: File of the operator, `pretrained`, or an operator.
        encoder: File of the encoder, `pretrained`, `pretrained-small` (few, coarse frames), or an encoder.
        reconstruction: Output folder of `neuido reconstruct`; `<recording>/reconstruction` where absent.
        recording_name: Name of the recording, for an experiment with several.
        views: Names of the views to read; all where absent.
        frame_step: Use every n-th frame.
        frame_count: Number of frames; all where absent.
        encoder_views: Number of training views for the encoder, starting with the first; 0: all.
        cache: Folder for cached optical flow; no cache where absent.
        device: `auto` (CUDA where available), `cpu`, or `cuda`.

    Returns:
        The law: `.law()` for `Simulator.rollout`, `.readings`, `.moduli`, `.latent`, `.save(path)`, `.rollout()`.

    Raises:
        UserError: A file is missing or malformed, the frames are uneven, there is no training view, or the latents differ in length.
    """
    chosen = as_device(device)
    if isinstance(recording, VisualScene):
        scene = recording
    else:
        options: dict[str, Any] = {"recording": recording_name, "views": views, "frame_step": frame_step, "frame_count": frame_count}
        scene = load_visual_scene(recording, reconstruction=reconstruction, **options)
    own_operator = operator if isinstance(operator, IntrinsicDynamicsOperator) else IntrinsicDynamicsOperator.load(operator)
    own_encoder = encoder if isinstance(encoder, DynamicsEncoder) else DynamicsEncoder.load(encoder)
    own_encoder.check_operator(own_operator, f"encoder = {encoder}" if isinstance(encoder, str) else "encoder")
    own_operator, own_encoder = own_operator.to(chosen).eval(), own_encoder.to(chosen).eval()
    prepared = prepare(scene, own_encoder, device=chosen, encoder_views=encoder_views, cache=cache)
    return VideoLaw.infer(own_encoder, own_operator, prepared, repeat=1)
