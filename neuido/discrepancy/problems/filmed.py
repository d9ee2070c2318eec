"""Silhouettes of a filmed recording with their cameras, and a body reconstructed from them where the folder has none."""

from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from neuido.data.bodies.shapes import rigid_velocity
from neuido.data.cameras import project, select_frames
from neuido.data.measured.experiment import Experiment, Recording
from neuido.data.scenes.filmed_scene import RECONSTRUCTION, read_body, read_motion
from neuido.data.scenes.masks import masks_from_background
from neuido.data.scenes.multiview import SceneViews
from neuido.discrepancy.problems.silhouettes import LEVEL, usable
from neuido.errors import UserError
from neuido.models.reconstruct.filling import fill, visual_hull
from neuido.models.render.gaussians import bind, deform, load_gaussians
from neuido.models.render.splatting import rasterize
from neuido.types import Body, Cameras, ParticleState

SIDE = 128
"""Longest side of the silhouettes [px]. Larger ones are scaled down."""
MOST_VIEWS, MOST_FRAMES = 3, 24
"""Largest numbers of views and frames that are compared, evenly chosen where there are more."""
MARGIN = 0.3
"""Margin of a silhouette around the body, in longest sides of the body in the images."""
PARTICLES = 2000
"""Number of particles of a body that is reconstructed from silhouettes."""
VELOCITY_FRAMES = 7
"""Frames from which the initial velocity is estimated, by a parabola: a line would be late by half of them where air brakes the body."""
HULL_VIEWS = 12
"""Largest number of views from which a body is reconstructed."""
OPACITY = 0.9
"""Opacity of the Gaussians of a body."""
INSIDE, SPREAD = 0.2, 0.15
"""Offsets and standard deviation of the eight Gaussians of a particle, in edges of the cube with the particle's volume.

Where an edge spans several pixels, the drawn body is about as large as the true one. The remaining difference is the same in all frames and
is measured in the first one.
"""
BLUR = 0.1
"""Variance added to the covariance of the Gaussians in the image [px^2]."""
FINE = 1.5
"""Edge [px] below which a particle is drawn as one Gaussian."""


class Film(NamedTuple):
    """Silhouettes of a recording, cropped to the body."""

    masks: np.ndarray
    """Soft masks in 0..1, (T, V, H, W) float32 for T frames and V views."""
    cut: np.ndarray
    """Rectangle of the recorded image in the cropped image of each view [px]: left, top, right, bottom, (V, 4)."""
    cameras: Cameras
    """Cameras of the cropped images, fixed or with a pose for each of the T frames."""
    times: Tensor
    """Times of the frames [s], (T,) float64."""
    factor: float
    """Size of a pixel of the masks in recorded pixels."""
    views: tuple[str, ...]


class Look(NamedTuple):
    """The Gaussians by which a body of P particles is drawn, M of them for each particle."""

    offset: Tensor
    """Offsets of the Gaussians from their particle in the reference body [m], (P, M, 3)."""
    spread: Tensor
    """Standard deviation of the Gaussians of each particle [m], (P,)."""

    def draw(self, motion: ParticleState, cameras: Cameras) -> Tensor:
        """Draw the silhouettes of T frames in V views, (T, V, H, W)."""
        x, F = motion.x, motion.F
        means = (x.unsqueeze(2) + torch.einsum("tpij,pmj->tpmi", F, self.offset)).flatten(1, 2)
        covariances = (self.spread.square()[:, None, None] * (F @ F.mT)).repeat_interleave(self.offset.shape[1], dim=1)
        opacity = x.new_full((means.shape[1],), OPACITY)
        return rasterize(means, covariances, opacity, x.new_zeros(means.shape[1], 3), *cameras, eps2d=BLUR)[1]


class Splats:
    """The Gaussians of a 3DGS file, moved with the particles of a body and drawn like `Look`.

    Args:
        path: 3DGS PLY file of the body in the first frame.
        body: Body in the first frame.
        device: `cpu` or a CUDA device.
    """

    def __init__(self, path, body: Body, device: str) -> None:
        self.gaussians = load_gaussians(path, device=device)
        self.binding = bind(self.gaussians, body.x.to(device, torch.float32))
        self.back = None if body.F is None else torch.linalg.inv(body.F.to(device, torch.float32))

    def draw(self, motion: ParticleState, cameras: Cameras) -> Tensor:
        """Draw the silhouettes of T frames in V views, (T, V, H, W)."""
        F = motion.F if self.back is None else motion.F @ self.back
        moved = deform(self.gaussians._replace(harmonics=self.gaussians.harmonics[:, :1]), F, motion.x, self.binding)
        tint = motion.x.new_zeros(moved.means.shape[-2], 3)
        return rasterize(moved.means, moved.covariances, moved.opacities, tint, *cameras, eps2d=BLUR)[1]


def look_of(body: Body, film: Film, device: str) -> Look:
    """Return Gaussians for the particles of a body: eight for each, or one where a particle is smaller than `FINE`."""
    volume = body.volume.double() if body.F is None else body.volume.double() / torch.linalg.det(body.F.double())
    edge = volume.pow(1 / 3).float()
    _, depth = project(body.x.float(), film.cameras.at(0))
    pixels = float(edge.mean() * film.cameras.Ks[:, 0, 0].max() / depth.mean(dim=1).clamp(min=1e-6).min())
    corners = torch.tensor([[0.0] * 3]) if pixels < FINE else INSIDE * torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3)
    spread = (0.45 if pixels < FINE else SPREAD) * edge
    return Look((edge[:, None, None] * corners).to(device), spread.to(device))


def read_film(experiment: Experiment, recording: Recording) -> Film:
    """Read the silhouettes of a recording from alpha channels, masks, or the difference from a plain background.

    Raises:
        UserError: No video, fewer than four frames, images that show no object, or unreadable images.
    """
    if recording.video is None:
        raise UserError(f"recording {recording.name} has no transforms.json: without tracked points its images are what is compared")
    found = recording.video
    kept = [v for v in range(len(found.views)) if v not in found.held_out] or list(range(len(found.views)))
    kept = [kept[i] for i in _evenly(len(kept), MOST_VIEWS)]
    views = SceneViews(found, views=[found.views[v] for v in kept], find_masks=True, cache=False)
    frames = _evenly(len(views.frames), MOST_FRAMES)
    if len(frames) < 4:
        raise UserError(f"recording {recording.name} has {len(frames)} frames; a diagnosis needs at least 4")
    masks = np.stack([_masks(views, v, frames) for v in range(len(kept))], axis=1)
    if not any(usable(mask) for mask in masks[0]):
        raise UserError(f"recording {recording.name}: its first frame shows no object: give an alpha channel, masks or a plain background")
    cut, boxes, factor, size = _boxes(masks)
    times = views.times[frames]
    cameras = _cameras(select_frames(views.cameras, frames), boxes, size)
    return Film(_cut_out(masks, boxes, size), cut, cameras, times, factor, tuple(views.views))


def _evenly(count: int, most: int) -> list[int]:
    return sorted({round(i) for i in np.linspace(0, count - 1, min(count, most))})


def _masks(views: SceneViews, v: int, frames: list[int]) -> np.ndarray:
    """Return the masks of view v at the given frames, (T, H, W)."""
    images, masks = views.load([v], frames)
    if bool((masks == 1).all()):
        _, masks = masks_from_background(images)
    return masks[0].numpy()


def _boxes(masks: np.ndarray) -> tuple[np.ndarray, np.ndarray, float, tuple[int, int]]:
    """Choose the crops of masks (T, V, H, W) around the body.

    Returns:
        The rectangle of the recorded image in each crop [px], (V, 4); corners of each crop in the recorded image [px], (V, 2, 2); size of
        a new pixel in recorded pixels; width and height of the crops [px].
    """
    height, width = masks.shape[2:]
    low, high = [], []
    for v in range(masks.shape[1]):
        seen = (masks[:, v] >= LEVEL).any(axis=0)
        y, x = np.nonzero(seen) if seen.any() else (np.array([0, height - 1]), np.array([0, width - 1]))
        low.append((x.min(), y.min()))
        high.append((x.max() + 1, y.max() + 1))
    low, high = np.array(low, float), np.array(high, float)
    side = (high - low).max(axis=0) + 2 * max(MARGIN * (high - low).max(), 6.0)
    factor = max(side.max() / SIDE, 1.0)
    size = tuple(int(n) for n in np.ceil(side / factor))
    first = 0.5 * (low + high) - 0.5 * factor * np.array(size)
    boxes = np.stack([first, first + factor * np.array(size)], axis=1)
    cut = np.concatenate([-first, np.array([width, height]) - first], axis=1) / factor
    return cut, boxes, float(factor), size  # type: ignore[return-value]


def _cut_out(masks: np.ndarray, boxes: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Crop masks (T, V, H, W) to boxes and scale them to `size` (width, height) [px], averaging over each new pixel."""
    out = np.zeros((*masks.shape[:2], size[1], size[0]), np.float32)
    for v, (low, high) in enumerate(boxes):
        factor = (high - low) / np.array(size)
        finer = int(np.ceil(factor.max()))  # samples per new pixel along each axis, of which the mean is taken
        at = [low[a] + factor[a] * (np.arange(finer * size[a]) + 0.5) / finer - 0.5 for a in range(2)]
        x, y = np.meshgrid(*(a.astype(np.float32) for a in at))
        for t in range(len(masks)):
            fine = cv2.remap(masks[t, v], x, y, cv2.INTER_LINEAR, borderValue=0.0)
            out[t, v] = fine.reshape(size[1], finer, size[0], finer).mean(axis=(1, 3))
    return out


def _cameras(cameras: Cameras, boxes: np.ndarray, size: tuple[int, int]) -> Cameras:
    Ks = cameras.Ks.double().clone()
    for v, (low, high) in enumerate(boxes):
        Ks[v, :2, 2] -= torch.from_numpy(low)
        Ks[v, :2] *= torch.from_numpy(np.array(size) / (high - low))[:, None]
    return Cameras(cameras.viewmats.float(), Ks.float(), *size)


# The body, where the folder gives none.


def body_of(experiment: Experiment, recording: Recording) -> tuple[Body, bool]:
    """Return the body at t = 0, and whether its velocity is known.

    The particles come from particles.npz or body.npz, else from `neuido reconstruct`, else they fill the visual hull of the first frame.
    The velocity of a body without particles.npz comes from motion.yaml, body.npz or the reconstruction. Where these give none, it is
    estimated from the centroids of the silhouettes in the first frames, and counts as not known.

    Raises:
        UserError: There is one view alone, or the silhouettes have no common visual hull.
    """
    if recording.body is not None and (recording.x is not None or bool(recording.body.v.any())):
        return recording.body, True
    own = experiment.folder / RECONSTRUCTION / "body.npz"
    filmed = [r for r in experiment.recordings if r.video is not None]
    body = recording.body
    if body is None and own.is_file() and len(filmed) == 1:
        body = read_body(own)
    found = recording.video
    chosen = [found.views[i] for i in _evenly(len(found.views), HULL_VIEWS)]
    if body is None and len(chosen) < 2:
        raise UserError(
            f"recording {recording.name} has one view and neither particles.npz nor body.npz: a body cannot be made of one silhouette; "
            "give x0, v0 and volume"
        )
    views = SceneViews(found, views=chosen, find_masks=True, cache=False)
    first = min(VELOCITY_FRAMES, len(views.frames))
    masks = np.stack([_masks(views, v, list(range(first))) for v in range(len(chosen))], axis=1)
    if body is None:
        lower, upper = recording.scene.lower, recording.scene.upper
        try:
            x, volume = fill(visual_hull(torch.from_numpy(masks[0]), views.cameras, lower, upper, resolution=48), count=PARTICLES)
        except UserError as error:
            raise UserError(f"recording {recording.name}: {error}") from error
        body = Body(x, torch.zeros_like(x), volume)
    motion = read_motion(experiment.folder)
    centre = tuple(body.x.mean(dim=0).tolist())
    if motion is not None:
        v = rigid_velocity(body.x, centre=motion.centre or centre, velocity=motion.velocity, angular_velocity=motion.angular_velocity)
        return body._replace(v=v), True
    if bool(body.v.any()):
        return body, True
    velocity = _velocity(masks, views.cameras, views.times[:first].numpy(), np.array(recording.scene.gravity))
    return body._replace(v=torch.tensor(velocity).to(body.x).expand_as(body.x).contiguous()), False


def _velocity(masks: np.ndarray, cameras: Cameras, times: np.ndarray, gravity: np.ndarray) -> np.ndarray:
    """Estimate the velocity at t = 0 [m/s], (3,), of a body in free flight, by the rays through the centroids of its silhouettes."""
    path = []
    for t, frame in enumerate(masks):
        viewmats = cameras.at(t).viewmats
        rotation, shift = viewmats[:, :3, :3].double().numpy(), viewmats[:, :3, 3].double().numpy()
        eyes = -np.einsum("vba,vb->va", rotation, shift)
        normal, right = np.zeros((3, 3)), np.zeros(3)
        for mask, K, R, eye in zip(frame, cameras.Ks.double().numpy(), rotation, eyes, strict=True):
            if usable(mask):
                y, x = np.indices(mask.shape) + 0.5
                pixel = np.array([np.average(x, weights=mask), np.average(y, weights=mask), 1.0])
                ray = R.T @ np.linalg.solve(K, pixel)
                across = np.eye(3) - np.outer(ray, ray) / (ray @ ray)
                normal, right = normal + across, right + across @ eye
        path.append(np.linalg.solve(normal + 1e-9 * np.eye(3), right))
    fallen = np.array(path) - 0.5 * times[:, None] ** 2 * gravity
    return np.polyfit(times, fallen, 2 if len(times) >= VELOCITY_FRAMES else 1)[-2]


def looks(recording: Recording, experiment: Experiment, body: Body, film: Film, device: str) -> "Look | Splats":
    """Return what is drawn of a body: the Gaussians of the folder where it has a matching file, else those of `look_of`."""
    ply = recording.gaussians
    if ply is None and recording.body is None and len(experiment.recordings) == 1:
        ply = experiment.folder / RECONSTRUCTION / "gaussians.ply"
    return Splats(ply, body, device) if ply is not None and ply.is_file() else look_of(body, film, device)
