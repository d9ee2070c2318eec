"""Multi-view recordings as data: a scene is one sample, its images read when they are wanted."""

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from lightning.pytorch import LightningDataModule
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, DistributedSampler

from neuido.data import cameras as convert
from neuido.data.files.parsing import read_image
from neuido.data.files.values import number
from neuido.data.formats.layout import SAME_SHAPE, MultiView, read_matrix
from neuido.data.scenes.masks import mask_channel, mask_from_empty, mask_on_plain_background, rim_colour
from neuido.data.scenes.readers import read
from neuido.errors import UserError, suggest
from neuido.types import Cameras, MultiViewBatch, Vector

BACKGROUNDS = {"white": 1.0, "black": 0.0}
UP = {
    "y": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "-y": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "z": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "-z": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
}
"""Rotations that carry the axis which points upwards in a recording to +y."""


class SceneViews:
    """The chosen frames of a recording, at the chosen size.

    Args:
        found: The recording.
        views: Names of the views to use; none: all.
        held_out_views: Names of the views for scoring only; none: those that the format holds out.
        frame_start: First frame.
        frame_step: Take each n-th frame (the paper takes one of five).
        frame_count: Number of frames; none: all there are.
        width: Width of the images [px]; their height follows. None: as recorded.
        background: `white` or `black`, behind the object where a mask is known.
        masked: False leaves the recorded background in, whatever the mask.
        scale, shift [m], up: The similarity x -> scale R x + shift from the recording's world to the simulation's domain, where R turns
            the axis `up` (y, -y, z, -z) upwards.
        cache: Keep images in memory once they are read (four bytes a pixel).
        find_masks: Find the mask of an image that has none by its difference from a plain background, before any undistortion.

    Raises:
        UserError: An unknown view, no frame left, a view that lacks a chosen frame.
    """

    def __init__(
        self,
        found: MultiView,
        *,
        views: Sequence[str] | None = None,
        held_out_views: Sequence[str] | None = None,
        frame_start: int = 0,
        frame_step: int = 1,
        frame_count: int | None = None,
        width: int | None = None,
        background: str = "white",
        masked: bool = True,
        scale: float = 1.0,
        shift: Vector = (0.0, 0.0, 0.0),
        up: str = "y",
        cache: bool = True,
        find_masks: bool = False,
    ) -> None:
        self.find_masks = find_masks
        if background not in BACKGROUNDS or up not in UP:
            raise UserError(f"background = {background!r} must be one of {', '.join(BACKGROUNDS)}, and up = {up!r} of {', '.join(UP)}")
        counts = (
            ("frame_start", frame_start, 0),
            ("frame_step", frame_step, 1),
            ("frame_count", 1 if frame_count is None else frame_count, 1),
        )
        for name, value, least in counts:
            if value < least:
                raise UserError(f"{name} must be at least {least}, got {value}")
        if width is not None and width < 1:
            raise UserError(f"width must be at least 1 pixel, got {width}")
        number(scale, "scale", above=0.0)
        read_matrix(shift, "shift", (3,))
        self.found, self.background, self.masked, self.cache = found, background, masked, cache
        self.chosen = _indices(found, views, "views") if views is not None else list(range(len(found.views)))
        kept = set(_indices(found, held_out_views, "held_out_views") if held_out_views is not None else found.held_out)
        self.held_out = [v in kept for v in self.chosen]
        self.frames = list(range(frame_start, len(found.times), frame_step))[:frame_count]
        if len(self.frames) < (frame_count or 1):
            raise UserError(
                f"{found.name} has {len(found.times)} frames: from frame_start {frame_start} by frame_step {frame_step} there are "
                f"{len(self.frames)}, not frame_count {frame_count or 1}"
            )
        for v in self.chosen:
            for t in self.frames:
                if found.images[v][t] is None:
                    raise UserError(f"{found.name}: view {found.views[v]} has no image at {float(found.times[t]):g} s; choose other views")
        self.times = found.times[self.frames] - found.times[self.frames[0]]
        size = (width or found.cameras.width, round(found.cameras.height * (width or found.cameras.width) / found.cameras.width))
        moved = convert.move(found.cameras, scale=scale, rotation=torch.tensor(UP[up]).double(), shift=shift)
        self.cameras = convert.select(convert.resize(moved, *size), self.chosen)
        self._kept: dict[tuple[int, int], np.ndarray] = {}

    @property
    def name(self) -> str:
        return self.found.name

    @property
    def views(self) -> list[str]:
        """Names of the views."""
        return [self.found.views[v] for v in self.chosen]

    def load(self, views: Sequence[int], frames: Sequence[int] | None = None) -> tuple[Tensor, Tensor]:
        """Load images (V, T, H, W, 3) and masks (V, T, H, W), float32 in [0, 1], of chosen views and frames by position.

        Raises:
            UserError: A file that is no image, or one of another shape than its camera's.
        """
        frames = range(len(self.frames)) if frames is None else frames
        shape = (len(views), len(frames), self.cameras.height, self.cameras.width, 4)
        out = np.empty(shape, dtype=np.float32 if self.find_masks else np.uint8)
        for i, v in enumerate(views):
            for k, t in enumerate(frames):
                out[i, k] = self._image(self.chosen[v], self.frames[t])
        rgba = torch.from_numpy(out).float().div_(255)
        return rgba[..., :3].contiguous(), rgba[..., 3].contiguous()

    @cached_property
    def plain_background(self) -> np.ndarray | None:
        """The colour (3,) of the first frames' rims where an image there has no mask; none where all have one, or none is sought.

        Raises:
            UserError: The rims have no one colour.
        """
        if not self.find_masks:
            return None
        rims = []
        for v in self.chosen:
            rgba, masked = self._recorded(v, self.frames[0])
            if not masked:
                rims += [rgba[0, :, :3], rgba[-1, :, :3], rgba[:, 0, :3], rgba[:, -1, :3]]
        return rim_colour(np.concatenate(rims)) if rims else None

    @cached_property
    def unmasked(self) -> bool:
        """Whether no first frame has a mask: then images keep their background, whose colour is `plain_background`."""
        return self.find_masks and not any(self._recorded(v, self.frames[0])[1] for v in self.chosen)

    @property
    def background_colour(self) -> np.ndarray:
        """The colour (3,) behind the object."""
        if self.unmasked and self.plain_background is not None:
            return self.plain_background
        return np.full(3, BACKGROUNDS[self.background], np.float32)

    def _recorded(self, v: int, t: int) -> tuple[np.ndarray, bool]:
        """Return an image as recorded with its mask as alpha, (H, W, 4), and whether anything says what the mask is."""
        found = self.found
        path, mask = found.images[v][t], found.masks[v][t] if found.masks else None
        rgba = _read(path, found.cameras)
        if mask is not None:
            rgba[..., 3] = _read(mask, found.cameras, channel=True)
            return rgba, True
        if bool((rgba[..., 3] < 1).any()):
            return rgba, True
        if found.backgrounds and found.backgrounds[v] is not None:
            rgba[..., 3] = mask_from_empty(rgba[..., :3], _read(found.backgrounds[v], found.cameras)[..., :3])
            return rgba, True
        return rgba, False

    def _image(self, v: int, t: int) -> np.ndarray:
        """Return RGB over the background, and the mask, (H, W, 4) in 0..255.

        The array is uint8; where masks are sought it is float32, and a mask that was found keeps its digits: half a step of eight bits
        changes which pixels of an outline count as the body's.
        """
        if (v, t) in self._kept:
            return self._kept[v, t]
        found = self.found
        rgba, masked = self._recorded(v, t)
        if not masked and self.find_masks:
            colour = self.plain_background
            if colour is None:  # the first frames have masks, this one has none
                colour = rim_colour(np.concatenate([rgba[0, :, :3], rgba[-1, :, :3], rgba[:, 0, :3], rgba[:, -1, :3]]))
            rgba[..., 3] = mask_on_plain_background(rgba[..., :3], colour)
        keeps = not self.masked or (not masked and (self.unmasked or not self.find_masks))
        shown = np.ones_like(rgba[..., 3:]) if keeps else rgba[..., 3:]
        # premultiplied, so that no colour from outside the mask bleeds in when pixels are averaged
        layers = np.concatenate([rgba[..., :3] * shown, rgba[..., 3:], shown], axis=2)
        if found.distortion is not None:
            layers = _undistort(layers, found.cameras.Ks[v].double().numpy(), found.distortion[v].numpy())
        size = (self.cameras.width, self.cameras.height)
        if size != (found.cameras.width, found.cameras.height):
            layers = _resize(layers, size)
        image = layers[..., :3] + self.background_colour * (1 - layers[..., 4:])
        done = 255 * np.clip(np.concatenate([image, layers[..., 3:4]], axis=2), 0, 1)
        rounded = slice(3) if self.find_masks and not masked else slice(4)
        done[..., rounded] = np.rint(done[..., rounded])
        done = done.astype(np.float32 if self.find_masks else np.uint8)
        if self.cache:
            self._kept[v, t] = done
        return done


class MultiViewDataset(Dataset):
    """Scenes as samples of type `MultiViewBatch`.

    Args:
        scenes: The scenes.
        part: Which views: `train` (those not held out), `held_out` (in a scene without any: its training views), or `all`.
        first: Index of the first scene.
    """

    def __init__(self, scenes: Sequence[SceneViews], part: str = "all", *, first: int = 0) -> None:
        self.scenes, self.part, self.first = list(scenes), part, first

    def __len__(self) -> int:
        return len(self.scenes)

    def __getitem__(self, index: int) -> MultiViewBatch:
        scene = self.scenes[index]
        views = self._views(scene)
        images, masks = scene.load(views)
        return MultiViewBatch(
            scene=self.first + index,
            name=scene.name,
            images=images,
            masks=masks,
            cameras=convert.select(scene.cameras, views),
            times=scene.times,
            held_out=torch.tensor([scene.held_out[v] for v in views]),
            background=torch.full((3,), BACKGROUNDS[scene.background]),
        )

    def _views(self, scene: SceneViews) -> list[int]:
        if self.part == "all" or (self.part == "held_out" and not any(scene.held_out)):
            return list(range(len(scene.chosen)))
        return [v for v, held_out in enumerate(scene.held_out) if held_out == (self.part == "held_out")]


class MultiViewDataModule(LightningDataModule):
    """Multi-view scenes for Stage II, adaptation and scoring; a batch is one scene (`MultiViewBatch`).

    Training takes the training views of `scenes`, validation their held-out views (their training views in a scene that holds none
    out), test and predict all views of `scenes` and `unseen`, which are numbered on. Under several processes each takes its own scenes.

    Args:
        scenes: Folders in any format of `data.formats`, or mappings with `path` and any of `format`, `recording`, `frame_interval`
            (as `readers.read` takes them), `views`, `held_out_views`, `scale`, `shift`, `up` (as `SceneViews` takes them).
        unseen: Scenes that training never sees.
        frame_start, frame_step, frame_count: Which frames.
        width: Width of the images [px].
        background: `white` or `black`.
        masked: Whether the recorded background is replaced where a mask is known.
        cache: Keep images in memory once they are read.
        num_workers: Worker processes that read.
        seed: Seed of the order of the scenes, which is another one in each epoch.
    """

    def __init__(
        self,
        scenes: list[str | dict[str, Any]],
        *,
        unseen: list[str | dict[str, Any]] | None = None,
        frame_start: int = 0,
        frame_step: int = 1,
        frame_count: int | None = None,
        width: int | None = None,
        background: str = "white",
        masked: bool = True,
        cache: bool = True,
        num_workers: int = 0,
        seed: int = 0,
    ) -> None:
        super().__init__()
        if not scenes:
            raise UserError("scenes is empty: name at least one folder")
        self.given, self.given_unseen, self.num_workers, self.seed = list(scenes), list(unseen or []), num_workers, seed
        self.options: dict[str, Any] = {
            "frame_start": frame_start,
            "frame_step": frame_step,
            "frame_count": frame_count,
            "width": width,
            "background": background,
            "masked": masked,
            "cache": cache,
        }

    @cached_property
    def scenes(self) -> list[SceneViews]:
        """The scenes that training sees."""
        return [self._open(given, f"scenes[{i}]") for i, given in enumerate(self.given)]

    @cached_property
    def unseen(self) -> list[SceneViews]:
        """The scenes that it does not see."""
        return [self._open(given, f"unseen[{i}]") for i, given in enumerate(self.given_unseen)]

    def setup(self, stage: str | None = None) -> None:
        for scene in self.scenes:
            if all(scene.held_out):
                raise UserError(f"{scene.name} has no training view: all of {', '.join(scene.views)} are held out")
        _ = self.unseen

    def train_dataloader(self) -> DataLoader:
        trainer = self.trainer
        ranks, rank = (trainer.world_size, trainer.global_rank) if trainer is not None else (1, 0)
        dataset = MultiViewDataset(self.scenes, "train")
        # a function of seed and epoch alone, so that a resumed run goes on as the interrupted one would have
        sampler = DistributedSampler(dataset, num_replicas=ranks, rank=rank, shuffle=True, seed=self.seed)
        return self._loader(dataset, sampler)

    def val_dataloader(self) -> DataLoader:
        return self._loader(MultiViewDataset(self.scenes, "held_out"))

    def test_dataloader(self) -> DataLoader:
        return self._loader(MultiViewDataset([*self.scenes, *self.unseen], "all"))

    def predict_dataloader(self) -> DataLoader:
        return self.test_dataloader()

    def _loader(self, dataset: Dataset, sampler: DistributedSampler | None = None) -> DataLoader:
        return DataLoader(dataset, batch_size=1, sampler=sampler, num_workers=self.num_workers, collate_fn=_only)

    def _open(self, given: str | dict[str, Any], where: str) -> SceneViews:
        options: dict[str, Any] = dict(given) if isinstance(given, dict) else {"path": given}
        if "path" not in options:
            raise UserError(f"{where} lacks the key 'path'")
        known = ("path", "format", "recording", "frame_interval", "views", "held_out_views", "scale", "shift", "up")
        for key in options:
            if key not in known:
                raise UserError(f"unknown key {key!r} in {where}{suggest(str(key), known) or ';'} it takes {', '.join(known)}")
        reading = {key: options.pop(key) for key in known[:4] if key in options}
        try:
            return SceneViews(read(reading.pop("path"), reading.pop("format", "auto"), **reading), **self.options, **options)
        except UserError as error:
            raise UserError(f"{where}: {error}") from error


def _only(samples: list[MultiViewBatch]) -> MultiViewBatch:
    return samples[0]


def _indices(found: MultiView, names: Sequence[Any], option: str) -> list[int]:
    names = [str(name) for name in names]
    for name in names:
        if name not in found.views:
            raise UserError(f"{option} has {name!r}, which {found.name} lacks; it has {', '.join(found.views[:20])}")
    if len(set(names)) < len(names):
        raise UserError(f"{option} names a view twice: {', '.join(names)}")
    return [found.views.index(name) for name in names]


def _read(path: Path | None, cameras: Cameras, *, channel: bool = False) -> np.ndarray:
    """Return an image as RGBA (H, W, 4), or as one channel (H, W), float32 in [0, 1], in the size of the cameras."""
    if path is None:
        raise UserError("an image is missing")
    image = mask_channel(path) if channel else _rgba(path)
    height, width = image.shape[:2]
    if (width, height) != (cameras.width, cameras.height):
        if abs(width * cameras.height / (height * cameras.width) - 1) > SAME_SHAPE:
            raise UserError(f"{path} has {width} x {height} pixels, its camera {cameras.width} x {cameras.height}")
        image = cv2.resize(image, (cameras.width, cameras.height), interpolation=cv2.INTER_AREA)
    return image


def _rgba(path: Path) -> np.ndarray:
    raw = read_image(path)
    image = raw.astype(np.float32) / np.iinfo(raw.dtype).max
    if image.ndim == 2 or image.shape[2] == 1:
        return cv2.cvtColor(image, cv2.COLOR_GRAY2RGBA)
    if image.shape[2] == 2:  # grey and alpha
        return np.concatenate([image[..., :1].repeat(3, axis=2), image[..., 1:]], axis=2)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGBA if image.shape[2] == 3 else cv2.COLOR_BGRA2RGBA)


def _resize(layers: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return layers (H, W, C) in another size; OpenCV averages areas of four channels at most at ratios that are no whole numbers."""
    method = cv2.INTER_AREA if size[0] < layers.shape[1] else cv2.INTER_LINEAR
    parts = [cv2.resize(np.ascontiguousarray(layers[..., c : c + 1]), size, interpolation=method) for c in range(layers.shape[2])]
    return np.stack(parts, axis=2)


def _undistort(layers: np.ndarray, K: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    """Return layers (H, W, C) as a pinhole with the same K sees them; OpenCV has pixel centres at whole numbers."""
    K = K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    parts = [cv2.undistort(np.ascontiguousarray(layers[..., c]), K, distortion) for c in range(layers.shape[2])]
    return np.stack(parts, axis=2)
