"""The film of a recording as a diagnosis sees it: silhouettes cut to the body, their cameras, and a body where none is given."""

from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from neuido.data.bodies.shapes import rigid_velocity
from neuido.data.cameras import project
from neuido.data.measured.experiment import Experiment, Recording
from neuido.data.scenes.filmed_scene import RECONSTRUCTION, read_body, read_motion
from neuido.data.scenes.masks import masks_from_background
from neuido.data.scenes.multiview import SceneViews
from neuido.discrepancy.problems.silhouettes import LEVEL, usable
from neuido.errors import UserError
from neuido.models.reconstruct.filling import fill, visual_hull
from neuido.models.render.gaussians import bind, deform, load_ply
from neuido.models.render.splatting import rasterize
from neuido.types import Body, Cameras, ParticleState

SIDE = 128
"""Longest side of the silhouettes [px]; larger ones are made smaller."""
MOST_VIEWS, MOST_FRAMES = 3, 24
"""Evenly taken where there are more."""
MARGIN = 0.3
"""Around the body, of its longest side in the images."""
PARTICLES = 2000
"""Of a body that is made from silhouettes."""
HULL_VIEWS = 12
OPACITY = 0.9
INSIDE, SPREAD = 0.2, 0.15
"""Eight Gaussians stand for a particle: their places and standard deviation, in edges of its share of the body. What is drawn is about as
large as the body where an edge is several pixels; what is left of it is the same in all frames, and the first one tells it."""
BLUR = 0.1
"""Added to their covariance in the image [px^2]."""
FINE = 1.5
"""Edges of fewer pixels get one Gaussian."""


class Film(NamedTuple):
    """Silhouettes of one recording."""

    masks: np.ndarray
    """In 0..1, (T, V, H, W) float32."""
    cut: np.ndarray
    """Where the recorded image lies in each view's cut-out [px]: left, top, right, bottom, (V, 4)."""
    cameras: Cameras
    """Of the cut-outs."""
    times: Tensor
    """[s], (T,) float64."""
    factor: float
    """Recorded pixels a pixel."""
    views: tuple[str, ...]


class Look(NamedTuple):
    """What the renderer draws of a body."""

    offset: Tensor
    """Gaussians about each particle in the reference body [m], (P, M, 3)."""
    spread: Tensor
    """Their standard deviation [m], (P,)."""

    def draw(self, motion: ParticleState, cameras: Cameras) -> Tensor:
        """Silhouettes (T, V, H, W) of T frames."""
        x, F = motion.x, motion.F
        means = (x.unsqueeze(2) + torch.einsum("tpij,pmj->tpmi", F, self.offset)).flatten(1, 2)
        covariances = (self.spread.square()[:, None, None] * (F @ F.mT)).repeat_interleave(self.offset.shape[1], dim=1)
        opacity = x.new_full((means.shape[1],), OPACITY)
        return rasterize(means, covariances, opacity, x.new_zeros(means.shape[1], 3), *cameras, eps2d=BLUR)[1]


class Splats:
    """The recorded first frame as Gaussians that the particles carry, drawn as `Look` draws particles."""

    def __init__(self, path, body: Body, device: str) -> None:
        self.gaussians = load_ply(path, device=device)
        self.binding = bind(self.gaussians, body.x.to(device, torch.float32))
        self.back = None if body.F is None else torch.linalg.inv(body.F.to(device, torch.float32))

    def draw(self, motion: ParticleState, cameras: Cameras) -> Tensor:
        """Silhouettes (T, V, H, W) of T frames."""
        F = motion.F if self.back is None else motion.F @ self.back
        moved = deform(self.gaussians._replace(harmonics=self.gaussians.harmonics[:, :1]), F, motion.x, self.binding)
        tint = motion.x.new_zeros(moved.means.shape[-2], 3)
        return rasterize(moved.means, moved.covariances, moved.opacities, tint, *cameras, eps2d=BLUR)[1]


def look_of(body: Body, film: Film, device: str) -> Look:
    """Gaussians for the particles of a body."""
    volume = body.volume.double() if body.F is None else body.volume.double() / torch.linalg.det(body.F.double())
    edge = volume.pow(1 / 3).float()
    _, depth = project(body.x.float(), film.cameras)
    pixels = float(edge.mean() * film.cameras.Ks[:, 0, 0].max() / depth.mean(dim=1).clamp(min=1e-6).min())
    corners = torch.tensor([[0.0] * 3]) if pixels < FINE else INSIDE * torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3)
    spread = (0.45 if pixels < FINE else SPREAD) * edge
    return Look((edge[:, None, None] * corners).to(device), spread.to(device))


def read_film(experiment: Experiment, recording: Recording) -> Film:
    """The silhouettes of a recording: alpha channels, masks, or what differs from a plain background.

    Raises:
        UserError: No video, fewer than four frames, images that show no object, what the reader of images refuses.
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
    cameras = _cameras(views.cameras, boxes, size)
    return Film(_cut_out(masks, boxes, size), cut, cameras, times, factor, tuple(views.views))


def _evenly(count: int, most: int) -> list[int]:
    return sorted({round(i) for i in np.linspace(0, count - 1, min(count, most))})


def _masks(views: SceneViews, v: int, frames: list[int]) -> np.ndarray:
    """(T, H, W)"""
    images, masks = views.load([v], frames)
    if bool((masks == 1).all()):
        _, masks = masks_from_background(images)
    return masks[0].numpy()


def _boxes(masks: np.ndarray) -> tuple[np.ndarray, np.ndarray, float, tuple[int, int]]:
    """Where the images lie in the cut-outs, the cut-outs in the images [px] (V, 2 corners), recorded pixels a pixel, and (W, H)."""
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
    """The parts of the masks in the boxes, averaged over each new pixel."""
    out = np.zeros((*masks.shape[:2], size[1], size[0]), np.float32)
    for v, (low, high) in enumerate(boxes):
        factor = (high - low) / np.array(size)
        finer = int(np.ceil(factor.max()))  # samples a pixel and axis, then their mean
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
    """The particles at t = 0, and whether their velocity is known.

    Those of particles.npz, else of `neuido reconstruct`, else the visual hull of the first frame, filled. The velocity of a hull is that of
    motion.yaml, else estimated from the path of the silhouettes' centroids in the first frames.

    Raises:
        UserError: One view alone, or silhouettes that do not meet in one body.
    """
    if recording.body is not None:
        return recording.body, True
    own = experiment.folder / RECONSTRUCTION / "body.npz"
    filmed = [r for r in experiment.recordings if r.video is not None]
    body = read_body(own) if own.is_file() and len(filmed) == 1 else None
    found = recording.video
    chosen = [found.views[i] for i in _evenly(len(found.views), HULL_VIEWS)]
    if body is None and len(chosen) < 2:
        raise UserError(
            f"recording {recording.name} has one view and no particles.npz: a body cannot be made of one silhouette; give x0, v0 and volume"
        )
    views = SceneViews(found, views=chosen, find_masks=True, cache=False)
    first = min(4, len(views.frames))
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
    """Velocity at t = 0 [m/s] of a body in free flight whose silhouettes' centroids these are, by the rays through them."""
    path = []
    rotation, shift = cameras.viewmats[:, :3, :3].double().numpy(), cameras.viewmats[:, :3, 3].double().numpy()
    eyes = -np.einsum("vba,vb->va", rotation, shift)
    for frame in masks:
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
    return np.polyfit(times, fallen, 1)[0]


def looks(recording: Recording, experiment: Experiment, body: Body, film: Film, device: str) -> "Look | Splats":
    """Gaussians of the folder where it has them and a body of its own, else eight for each particle."""
    ply = recording.gaussians
    if ply is None and recording.body is None and len(experiment.recordings) == 1:
        ply = experiment.folder / RECONSTRUCTION / "gaussians.ply"
    return Splats(ply, body, device) if ply is not None and ply.is_file() else look_of(body, film, device)
