"""From the video of a body to its law, and from the law to particles and images: what Stage II, zero-shot inference and scores share.

images -> flow -> frozen VAE -> projector -> z -> laws -> rollout -> Gaussians -> images
"""

import os
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from neuido.data.files.score_tables import folder_of as folder_of
from neuido.data.scenes.filmed_scene import VisualScene
from neuido.errors import UserError
from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
from neuido.models.render.gaussians import Binding, bind, deform, dress, load_ply
from neuido.models.render.splatting import render
from neuido.models.video.encoder import DynamicsEncoder
from neuido.models.video.flow import as_bytes, frame_interval_of
from neuido.physics.laws.base import ElasticLaw, PlasticLaw
from neuido.physics.mpm.simulator import Simulator
from neuido.types import Cameras, Gaussians, ParticleState

UNEVEN = 50
"""Frames of a rollout between two of a recording at uneven times."""

Laws = tuple[ElasticLaw, PlasticLaw | None]


class Prepared(NamedTuple):
    """A scene with everything that does not change while the projector learns, on one device."""

    source: VisualScene
    simulator: Simulator
    gaussians: Gaussians
    binding: Binding | None
    """None: Gaussian i is particle i."""
    every: int
    """Substeps from one frame of a rollout to the next."""
    images: Tensor
    """(V, T, H, W, 3) uint8."""
    masks: Tensor
    """(V, T, H, W) uint8."""
    cameras: Cameras
    background: Tensor
    training: list[int]
    """Views that are not held out."""
    volume: Tensor | None
    """Flow latents of the views that the encoder sees, (V', channels, T', h, w); none without an encoder."""
    conditions: Tensor | None
    """(V', 2)"""
    picks: tuple[int, ...] | None = None
    """Which frames of a rollout are the recording's, of T recorded at uneven times; none: all."""

    @property
    def frames(self) -> int:
        """T."""
        return self.images.shape[1]

    @property
    def stride(self) -> int:
        """Substeps of the recording's mean frame interval, about."""
        return self.every if self.picks is None else self.every * UNEVEN

    def substeps(self, frames: int) -> int:
        """Substeps of a rollout from the first to the last of so many frames."""
        return self.every * (frames - 1 if self.picks is None else self.picks[frames - 1])

    @property
    def scoring(self) -> list[int]:
        """The held-out views; all views of a scene that holds none out."""
        held = self.source.batch.held_out.nonzero()[:, 0].tolist()
        return held or list(range(len(self.images)))

    def views(self, views: list[int]) -> Cameras:
        """The cameras of some views."""
        return self.cameras._replace(viewmats=self.cameras.viewmats[views], Ks=self.cameras.Ks[views])

    def recorded(self, views: list[int], frames: int | None = None) -> Tensor:
        """Recorded images in [0, 1], (T, V, H, W, 3)."""
        return self.images[views, :frames].transpose(0, 1).float().div_(255)

    def silhouettes(self, views: list[int], frames: int | None = None) -> Tensor:
        """Recorded masks in [0, 1], (T, V, H, W)."""
        return self.masks[views, :frames].transpose(0, 1).float().div_(255)


def prepare(
    scene: VisualScene,
    encoder: DynamicsEncoder | None,
    *,
    device: str | torch.device = "cpu",
    encoder_views: int = 0,
    cache: str | os.PathLike | None = None,
) -> Prepared:
    """Bring a scene to a device, bind its Gaussians and embed its flow.

    Args:
        scene: The scene.
        encoder: Its frozen VAE makes the flow latents; none: they are not needed.
        device: Where it will run.
        encoder_views: How many of the training views the encoder sees, the first ones; 0: all.
        cache: Folder in which flows are kept.

    Raises:
        UserError: Frames that are no whole number of substeps apart, no training view; what `Simulator` and `DynamicsEncoder.watch` refuse.
    """
    batch = scene.batch
    every, picks = clock(batch.times, scene.scene.dt, scene.name)
    training = (~batch.held_out).nonzero()[:, 0].tolist()
    if not training:
        raise UserError(f"{scene.name} has no training view: all {len(batch.held_out)} are held out")
    volume = conditions = None
    if encoder is not None:
        with torch.no_grad():
            velocities = encoder.watch(batch, training[: encoder_views or None], scene.body.x.mean(0), cache=cache)
            volume, conditions = (t.to(device) for t in encoder.embed(velocities))
    simulator = Simulator(scene.scene, scene.body, density=scene.density, device=device)
    if scene.gaussians is None:
        rest = simulator.volume / torch.linalg.det(simulator.state.F)  # a body may start deformed
        gaussians, binding = dress(simulator.state.x, rest), None
    else:
        gaussians = load_ply(scene.gaussians, device=device)
        binding = bind(gaussians, simulator.state.x)
    return Prepared(
        source=scene,
        simulator=simulator,
        gaussians=gaussians,
        binding=binding,
        every=every,
        images=as_bytes(batch.images).to(device),
        masks=as_bytes(batch.masks).to(device),
        cameras=batch.cameras._replace(viewmats=batch.cameras.viewmats.to(device), Ks=batch.cameras.Ks.to(device)),
        background=batch.background.to(device),
        training=training,
        volume=volume,
        conditions=conditions,
        picks=picks,
    )


def clock(times: Tensor, dt: float, name: str) -> tuple[int, tuple[int, ...] | None]:
    """Substeps from one frame of a rollout to the next, and which frames are the recording's, none where its times are even (to 1 %).

    Uneven times are rounded to a fiftieth of the mean interval.

    Raises:
        UserError: Even times that are no whole number of substeps apart, two frames at one time.
    """
    steps = torch.as_tensor(times, dtype=torch.float64).diff()
    if len(steps) and float((steps - steps.mean()).abs().max()) > 0.01 * float(steps.mean()) > 0:
        every = max(1, int(float(steps.mean()) / (UNEVEN * dt)))
        picks = tuple(((times - times[0]) / (every * dt)).round().long().tolist())
        if any(b <= a for a, b in zip(picks, picks[1:])):
            raise UserError(f"{name}: two frames are {float(steps.min()):g} s apart; leave one out (frame_step, frame_count)")
        return every, picks
    interval = frame_interval_of(times)
    every = round(interval / dt)
    if every < 1 or abs(every * dt - interval) > 1e-3 * interval:
        raise UserError(f"{name}: frames are {interval:g} s apart, no whole number of substeps of {dt:g} s; change dt or frame_step")
    return every, None


def roll_laws(prepared: Prepared, laws: Laws, frames: int, *, segment: int = 0, **options: Any) -> ParticleState:
    """The motion under an elastic and a plastic law: the first `frames` frames of the recording's.

    Args:
        prepared: The scene.
        laws: As `Simulator.rollout` takes them.
        frames: Number of frames K, the start included.
        segment: Keep the state of a rollout with gradients every so many frames only; 0: of all.
        options: Of `Simulator.rollout`.

    Raises:
        UserError: As `Simulator.rollout`: a law too stiff for the step, a particle lost.
    """
    steps, piece = prepared.substeps(frames), segment * prepared.stride
    if 0 < piece < steps:
        options["segment"], steps = piece, piece * -(-steps // piece)  # whole pieces; the frames beyond are dropped
    motion = prepared.simulator.rollout(steps, *laws, every=prepared.every, **options)
    wanted = slice(frames) if prepared.picks is None else list(prepared.picks[:frames])
    return ParticleState(*(t[wanted] for t in motion))


def roll(
    prepared: Prepared, operator: IntrinsicDynamicsOperator, z: Tensor, frames: int | None = None, *, segment: int = 0
) -> ParticleState:
    """`roll_laws` of the laws of z (d,), over the first `frames` frames or all."""
    return roll_laws(prepared, operator.laws(z), frames or prepared.frames, segment=segment)


def roll_surely(prepared: Prepared, run: Callable[[Prepared], ParticleState], halvings: int = 2) -> tuple[ParticleState, int]:
    """The frames of `run`, and how often the substep was halved, at most `halvings` times, because it had failed.

    Raises:
        UserError: As `run`, with the smallest substep too.
    """
    for count in range(halvings + 1):
        try:
            return run(prepared if count == 0 else refine(prepared, 2**count)), count
        except UserError:
            if count == halvings:
                raise
    raise AssertionError("unreachable")


def refine(prepared: Prepared, times: int) -> Prepared:
    """The same scene with a substep that is so many times smaller; its rollouts are not captured as graphs."""
    source = prepared.source
    finer = replace(source.scene, dt=source.scene.dt / times)
    simulator = Simulator(finer, source.body, density=source.density, device=prepared.simulator.device, graphs=False)
    return prepared._replace(simulator=simulator, every=prepared.every * times)


def draw(prepared: Prepared, motion: ParticleState, views: list[int]) -> tuple[Tensor, Tensor]:
    """Images (K, V, H, W, 3) and alphas (K, V, H, W) of a motion of K frames."""
    moved = deform(prepared.gaussians, motion.F, motion.x, prepared.binding)
    return render(moved, prepared.views(views), background=prepared.background)


class Inference(NamedTuple):
    """What zero-shot inference gives."""

    z: Tensor
    """(d,)"""
    seconds: float
    """From the flow latents to the laws' tensors [s], the median of several passes."""


@torch.no_grad()
def infer(encoder: DynamicsEncoder, operator: IntrinsicDynamicsOperator, prepared: Prepared, *, repeat: int = 5) -> Inference:
    """One pass of the encoder, and the time it takes to a law that can run."""
    was_training = encoder.training
    encoder.eval()
    times = []
    for _ in range(max(1, repeat)):
        _wait(prepared.volume)
        start = time.perf_counter()
        z = encoder(prepared.volume, prepared.conditions)
        for law in operator.laws(z):
            law.tensors()
        _wait(z)
        times.append(time.perf_counter() - start)
    encoder.train(was_training)
    return Inference(z, sorted(times)[len(times) // 2])


def _wait(t: Tensor) -> None:
    if t.is_cuda:
        torch.cuda.synchronize(t.device)


def track(rest: Tensor, points: Tensor, x: Tensor, nearest: int = 8) -> Tensor:
    """Where material points go that are no particles: each with the weighted mean displacement of the particles about it.

    Args:
        rest: Particles at t = 0 [m], (P, 3).
        points: Points at t = 0 [m], (N, 3).
        x: Particles in K frames [m], (K, P, 3).
        nearest: Particles that carry a point, weighted by the inverse square of their distance.

    Returns:
        (K, N, 3).
    """
    from scipy.spatial import cKDTree

    distance, index = cKDTree(rest.detach().cpu().numpy()).query(points.detach().cpu().numpy(), k=min(nearest, len(rest)))
    d = torch.as_tensor(distance, dtype=torch.float64).reshape(len(points), -1)
    weight = 1 / (d.square() + 1e-12)
    weight = (weight / weight.sum(1, keepdim=True)).to(x)
    index = torch.as_tensor(index).reshape(len(points), -1).to(x.device)
    moved = sum((x - rest)[:, index[:, j]] * weight[:, j, None] for j in range(index.shape[1]))
    return points.to(x) + moved
