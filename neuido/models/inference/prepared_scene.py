"""A recorded scene on one device, with everything that stays constant while its law is inferred or fitted."""

import math
import os
import time
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from neuido.data.scenes.filmed_scene import VisualScene
from neuido.errors import UserError
from neuido.models.render.gaussians import Binding, attach_gaussians, bind, load_gaussians
from neuido.models.video.encoder import DynamicsEncoder
from neuido.models.video.flow import as_bytes, frame_interval_of
from neuido.physics.effects.parameters import Effects
from neuido.physics.laws.base import ElasticLaw, PlasticLaw
from neuido.physics.mpm.simulator import Simulator
from neuido.physics.runtime.device import choose_device
from neuido.types import Cameras, Gaussians

STEPS_PER_INTERVAL = 50
"""Rollout frames per mean frame interval of a recording at uneven times."""

Laws = tuple[ElasticLaw, PlasticLaw | None]


class PreparedScene(NamedTuple):
    """A scene on one device, with everything that stays constant during training."""

    source: VisualScene
    simulator: Simulator
    gaussians: Gaussians
    binding: Binding | None
    """Weights of the Gaussians on the particles; None: Gaussian i is particle i."""
    every: int
    """Substeps between two frames of a rollout."""
    images: Tensor
    """Recorded images, (V, T, H, W, 3) uint8."""
    masks: Tensor
    """Recorded masks, (V, T, H, W) uint8."""
    cameras: Cameras
    background: Tensor
    training_views: list[int]
    """Indices of the views that are not held out."""
    volume: Tensor | None
    """Flow latents of the encoder views, (V', channels, T', h, w); None without an encoder."""
    conditions: Tensor | None
    """Conditions of the encoder views, (V', 2); None without an encoder."""
    recorded_frames: tuple[int, ...] | None = None
    """Indices of the rollout frames that correspond to the recording, for uneven times; None: all frames."""
    flow_seconds: float = 0.0
    """Measured time from the images to the flow latents [s]; short where the flow was cached."""

    def __repr__(self) -> str:
        views, frames, height, width = self.images.shape[:4]
        seen = f"{views} views ({len(self.training_views)} for training), {frames} frames, {width} x {height} px"
        return f"PreparedScene({self.source.name!r}, {len(self.source.body.x)} particles, {seen}, {self.images.device})"

    @property
    def frames(self) -> int:
        """Number of recorded frames T."""
        return self.images.shape[1]

    @property
    def stride(self) -> int:
        """Approximate number of substeps in the mean frame interval of the recording."""
        return self.every if self.recorded_frames is None else self.every * STEPS_PER_INTERVAL

    def substeps(self, frames: int) -> int:
        """Return the number of substeps from the first to the last of `frames` frames."""
        return self.every * (frames - 1 if self.recorded_frames is None else self.recorded_frames[frames - 1])

    def times(self, frames: int) -> Tensor:
        """Return the times since the first frame of the first `frames` recorded frames [s], (frames,) float64."""
        return self.source.scene.dt * torch.tensor([self.substeps(k + 1) for k in range(frames)], dtype=torch.float64)

    @property
    def scoring_views(self) -> list[int]:
        """Indices of the held-out views, or of all views if none is held out."""
        held = self.source.batch.held_out.nonzero()[:, 0].tolist()
        return held or list(range(len(self.images)))

    def views(self, views: list[int]) -> Cameras:
        """Return the cameras of the given views."""
        viewmats, Ks = (torch.stack([t[v] for v in views]) for t in (self.cameras.viewmats, self.cameras.Ks))
        return self.cameras._replace(viewmats=viewmats, Ks=Ks)

    def recorded(self, views: list[int], frames: int | None = None) -> Tensor:
        """Return the recorded images of the given views in [0, 1], (T, V, H, W, 3)."""
        return torch.stack([self.images[v, :frames] for v in views], 1).float().div_(255)  # an index list would stop the host

    def silhouettes(self, views: list[int], frames: int | None = None) -> Tensor:
        """Return the recorded masks of the given views in [0, 1], (T, V, H, W)."""
        return torch.stack([self.masks[v, :frames] for v in views], 1).float().div_(255)


def as_device(device: str | torch.device) -> torch.device:
    """Return the device of a name; `auto` is CUDA where available.

    Raises:
        UserError: `cuda` is not available.
    """
    return choose_device(device) if isinstance(device, str) and device in ("auto", "cpu", "cuda") else torch.device(device)


def prepare(
    scene: VisualScene,
    encoder: DynamicsEncoder | None,
    *,
    device: str | torch.device = "auto",
    encoder_views: int = 0,
    cache: str | os.PathLike | None = None,
    flow_method: str = "opencv",
    graphs: bool = True,
) -> PreparedScene:
    """Prepare a scene on a device: bind its Gaussians to the particles and embed its flow.

    Args:
        scene: The scene.
        encoder: Encoder whose frozen VAE embeds the flow; None if flow latents are not needed.
        device: `auto` (CUDA where available), `cpu`, `cuda`, or a torch device.
        encoder_views: Number of training views for the encoder, starting with the first; 0: all.
        cache: Folder for cached optical flow.
        flow_method: `opencv`, or `parallel` on the device of the encoder (`flow.optical_flow`).
        graphs: As of `Simulator`; the graphs of hundreds of scenes take more memory than a GPU has.

    Raises:
        UserError: Two frames have the same time, there is no training view, or as in `Simulator` and `DynamicsEncoder.measure_flow`.
    """
    batch, device = scene.batch, as_device(device)
    dt = fitting_step(batch.times, scene.scene.dt)
    if dt != scene.scene.dt:
        scene = scene._replace(scene=replace(scene.scene, dt=dt))
    every, recorded_frames = frame_substeps(batch.times, dt, scene.name)
    training = (~batch.held_out).nonzero()[:, 0].tolist()
    if not training:
        raise UserError(f"{scene.name} has no training view: all {len(batch.held_out)} are held out")
    volume = conditions = None
    begun = time.perf_counter()
    if encoder is not None:
        with torch.no_grad():
            views = training[: encoder_views or None]
            velocities = encoder.measure_flow(batch, views, scene.body.x.mean(0), cache=cache, method=flow_method)
            volume, conditions = (t.to(device) for t in encoder.embed(velocities))
    flow_seconds = time.perf_counter() - begun
    simulator = Simulator(scene.scene, scene.body, density=scene.density, device=device, graphs=graphs)
    if scene.gaussians is None:
        rest = simulator.volume / torch.linalg.det(simulator.state.F)  # a body may start deformed
        gaussians, binding = attach_gaussians(simulator.state.x, rest), None
    elif isinstance(scene.gaussians, Gaussians):
        gaussians, binding = Gaussians(*(None if t is None else t.to(device) for t in scene.gaussians)), None
    else:
        gaussians = load_gaussians(scene.gaussians, device=device)
        binding = bind(gaussians, simulator.state.x)
    return PreparedScene(
        source=scene,
        simulator=simulator,
        gaussians=gaussians,
        binding=binding,
        every=every,
        images=as_bytes(batch.images).to(device),
        masks=as_bytes(batch.masks).to(device),
        cameras=batch.cameras._replace(viewmats=batch.cameras.viewmats.to(device), Ks=batch.cameras.Ks.to(device)),
        background=batch.background.to(device),
        training_views=training,
        volume=volume,
        conditions=conditions,
        recorded_frames=recorded_frames,
        flow_seconds=flow_seconds,
    )


def fitting_step(times: Tensor, dt: float) -> float:
    """Return the largest time step [s] up to `dt` that divides the frame interval; `dt` for uneven times.

    `dt` is kept if it divides the interval to within 0.1 %.
    """
    steps = torch.as_tensor(times, dtype=torch.float64).diff()
    if not len(steps) or not float(steps.min()) > 0 or float((steps - steps.mean()).abs().max()) > 0.01 * float(steps.mean()):
        return dt
    interval = float(steps.mean())
    every = round(interval / dt)
    if every >= 1 and abs(every * dt - interval) <= 1e-3 * interval:
        return dt
    return interval / max(1, math.ceil(interval / dt))


def frame_substeps(times: Tensor, dt: float, name: str) -> tuple[int, tuple[int, ...] | None]:
    """Return the number of substeps between rollout frames, and the indices of the recorded frames (None for times even to 1 %).

    Uneven times are rounded to a fiftieth of the mean interval.

    Raises:
        UserError: The interval of even times is not a whole number of substeps, or two frames have the same time.
    """
    steps = torch.as_tensor(times, dtype=torch.float64).diff()
    if len(steps) and float((steps - steps.mean()).abs().max()) > 0.01 * float(steps.mean()) > 0:
        every = max(1, int(float(steps.mean()) / (STEPS_PER_INTERVAL * dt)))
        recorded_frames = tuple(((times - times[0]) / (every * dt)).round().long().tolist())
        if any(b <= a for a, b in zip(recorded_frames, recorded_frames[1:])):
            raise UserError(f"{name}: two frames are {float(steps.min()):g} s apart; leave one out (frame_step, frame_count)")
        return every, recorded_frames
    interval = frame_interval_of(times)
    every = round(interval / dt)
    if every < 1 or abs(every * dt - interval) > 1e-3 * interval:
        raise UserError(f"{name}: frames are {interval:g} s apart, not a whole number of substeps of {dt:g} s; change dt or frame_step")
    return every, None


class EffectSource:
    """Source of known effects that act in addition to the law of a scene; a configuration names a subclass by `class_path`."""

    def of(self, scene: PreparedScene) -> Effects:
        """Return the effects for a rollout of the scene, whose time step may be smaller than that of the recording."""
        raise NotImplementedError
