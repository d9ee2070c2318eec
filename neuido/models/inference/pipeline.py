"""From the video of a body to its law, and from the law to particles and images, for Stage II, zero-shot inference and scores.

images -> flow -> frozen VAE -> projector -> z -> laws -> rollout -> Gaussians -> images
"""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from neuido.errors import UserError
from neuido.models.inference.prepared_scene import Laws, PreparedScene
from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
from neuido.models.render.gaussians import deform
from neuido.models.render.splatting import render
from neuido.models.video.encoder import DynamicsEncoder
from neuido.physics.mpm.simulator import Simulator
from neuido.types import ParticleState


def rollout_laws(prepared: PreparedScene, laws: Laws, frames: int, *, segment: int = 0, **options: Any) -> ParticleState:
    """Simulate the first `frames` frames of a recording with an elastic and a plastic law.

    Args:
        prepared: The scene.
        laws: Elastic and plastic law for `Simulator.rollout`.
        frames: Number of frames K, including the initial one.
        segment: Gradient checkpointing: keep the state only every so many frames; 0: keep all.
        options: Further options of `Simulator.rollout`.

    Raises:
        UserError: As in `Simulator.rollout`: the law is too stiff for the time step, or a particle is lost.
    """
    steps, piece = prepared.substeps(frames), segment * prepared.stride
    if 0 < piece < steps:
        options["segment"], steps = piece, piece * -(-steps // piece)  # whole segments; the surplus frames are discarded
    motion = prepared.simulator.rollout(steps, *laws, every=prepared.every, **options)
    wanted = slice(frames) if prepared.recorded_frames is None else list(prepared.recorded_frames[:frames])
    return ParticleState(*(t[wanted] for t in motion))


def rollout_latent(
    prepared: PreparedScene, operator: IntrinsicDynamicsOperator, z: Tensor, frames: int | None = None, *, segment: int = 0
) -> ParticleState:
    """Simulate the first `frames` frames (all by default) with the laws of z (d,)."""
    return rollout_laws(prepared, operator.laws(z), frames or prepared.frames, segment=segment)


def rollout_with_retries(
    prepared: PreparedScene, run: Callable[[PreparedScene], ParticleState], halvings: int = 2
) -> tuple[ParticleState, int]:
    """Call `run`, and on failure retry with half the time step, up to `halvings` times.

    Returns:
        The motion, and how often the time step was halved.

    Raises:
        UserError: `run` fails with the smallest time step too.
    """
    for count in range(halvings + 1):
        try:
            return run(prepared if count == 0 else with_finer_steps(prepared, 2**count)), count
        except UserError:
            if count == halvings:
                raise
    raise AssertionError("unreachable")


def with_finer_steps(prepared: PreparedScene, times: int) -> PreparedScene:
    """Return the scene with its time step divided by `times`; its rollouts are not captured as CUDA graphs."""
    source = prepared.source
    finer = replace(source.scene, dt=source.scene.dt / times)
    simulator = Simulator(finer, source.body, density=source.density, device=prepared.simulator.device, graphs=False)
    return prepared._replace(simulator=simulator, every=prepared.every * times)


def render_motion(prepared: PreparedScene, motion: ParticleState, views: list[int]) -> tuple[Tensor, Tensor]:
    """Render a motion of K frames: images (K, V, H, W, 3) and alphas (K, V, H, W)."""
    moved = deform(prepared.gaussians, motion.F, motion.x, prepared.binding)
    return render(moved, prepared.views(views), background=prepared.background)


class Inference(NamedTuple):
    """Result of zero-shot inference."""

    z: Tensor
    """Latent, (d,)."""
    seconds: float
    """Time from the flow latents to the tensors of the laws [s], median of several passes."""


@torch.no_grad()
def infer_latent(encoder: DynamicsEncoder, operator: IntrinsicDynamicsOperator, prepared: PreparedScene, *, repeat: int = 5) -> Inference:
    """Infer the latent of a scene in one pass of the encoder, and measure the time until its laws are available."""
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


def carry_points(rest: Tensor, points: Tensor, x: Tensor, nearest: int = 8) -> Tensor:
    """Advect points by a particle motion: each point moves with the weighted mean displacement of nearby particles.

    Args:
        rest: Particle positions at t = 0 [m], (P, 3).
        points: Points at t = 0 [m], (N, 3).
        x: Particle positions in K frames [m], (K, P, 3).
        nearest: Number of nearest particles, weighted by the inverse square of their distance.

    Returns:
        Positions of the points [m], (K, N, 3).
    """
    from scipy.spatial import KDTree

    distance, index = KDTree(rest.detach().cpu().numpy()).query(points.detach().cpu().numpy(), k=min(nearest, len(rest)), workers=-1)
    d = torch.as_tensor(distance, dtype=torch.float64).reshape(len(points), -1)
    weight = 1 / (d.square() + 1e-12)
    weight = (weight / weight.sum(1, keepdim=True)).to(x)
    index = torch.as_tensor(index).reshape(len(points), -1).to(x.device)
    moved = sum((x - rest)[:, index[:, j]] * weight[:, j, None] for j in range(index.shape[1]))
    return points.to(x) + moved
