"""Lightning data module of multi-view recordings; a sample is one scene, whose images are loaded on access."""

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
from neuido.data.scenes.readers import read_recording
from neuido.errors import UserError, suggest
from neuido.types import Cameras, MultiViewBatch, Vector

BACKGROUNDS = {"white": 1.0, "black": 0.0}
UP = {
    "y": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "-y": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "z": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "-z": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
}
"""Rotation to +y of the axis that points upwards in a recording, by its name."""


class SceneViews:
    """Selected views and frames of a recording, resized, masked and undistorted on access.

    Args:
        found: The recording.
        views: Names of the views to use; None: all.
        held_out_views: Names of the views for scoring only; None: those that the files hold out.
        frame_start: First frame.
        frame_step: Use every n-th frame; 5 in the paper.
        frame_count: Number of frames; None: all.
        width: Width of the images [px]; the height follows from the aspect ratio. None: as recorded.
        background: Colour behind the object if a mask is known, `white` or `black`.
        masked: False: keep the recorded background.
        scale, shift [m], up: Transformation x -> scale R x + shift from recording to simulation coordinates. R rotates the axis `up` (y,
            -y, z or -z) to +y.
        cache: Keep loaded images in memory (four bytes per pixel).
        find_masks: Compute the mask of an image without one from its difference from a plain background, before undistortion.

    Raises:
        UserError: A view is unknown, too few frames remain, or a view lacks a selected frame.
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
            raise UserError(f"background = {background!r} must be one of {', '.join(BACKGROUNDS)}, and up = {up!r} one of {', '.join(UP)}")
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
                f"{found.name} has {len(found.times)} frames: frame_start = {frame_start} and frame_step = {frame_step} leave "
                f"{len(self.frames)}, fewer than frame_count = {frame_count or 1}"
            )
        for v in self.chosen:
            for t in self.frames:
                if found.images[v][t] is None:
                    raise UserError(f"{found.name}: view {found.views[v]} has no image at {float(found.times[t]):g} s: select other views")
        self.times = found.times[self.frames] - found.times[self.frames[0]]
        size = (width or found.cameras.width, round(found.cameras.height * (width or found.cameras.width) / found.cameras.width))
        moved = convert.move(found.cameras, scale=scale, rotation=torch.tensor(UP[up]).double(), shift=shift)
        self.cameras = convert.select(convert.select_frames(convert.resize(moved, *size), self.frames), self.chosen)
        self._kept: dict[tuple[int, int], np.ndarray] = {}

    @property
    def name(self) -> str:
        return self.found.name

    @property
    def views(self) -> list[str]:
        """Names of the views."""
        return [self.found.views[v] for v in self.chosen]

    def load(self, views: Sequence[int], frames: Sequence[int] | None = None) -> tuple[Tensor, Tensor]:
        """Load images (V, T, H, W, 3) and masks (V, T, H, W), float32 in [0, 1].

        Args:
            views: Positions in the selected views.
            frames: Positions in the selected frames; None: all.

        Raises:
            UserError: A file is not an image, or has another aspect ratio than its camera.
        """
        frames = range(len(self.frames)) if frames is None else frames
        shape = (len(views), len(frames), self.cameras.height, self.cameras.width)
        images, masks = np.empty((*shape, 3), np.float32), np.empty(shape, np.float32)
        for i, v in enumerate(views):
            for k, t in enumerate(frames):
                rgba = self._image(self.chosen[v], self.frames[t])
                rgb = rgba[..., :3] if rgba.dtype != np.uint8 else cv2.cvtColor(rgba, cv2.COLOR_RGBA2RGB)  # dense: divided faster
                np.divide(rgb, np.float32(255), out=images[i, k])
                np.divide(rgba[..., 3], np.float32(255), out=masks[i, k])
        return torch.from_numpy(images), torch.from_numpy(masks)

    @cached_property
    def plain_background(self) -> np.ndarray | None:
        """Colour (3,) of the borders of the first frames without a mask; None if all have one, or if `find_masks` is off.

        Raises:
            UserError: The border pixels do not have one colour.
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
        """Whether no first frame has a mask; images then keep their background, whose colour is `plain_background`."""
        return self.find_masks and not any(self._recorded(v, self.frames[0])[1] for v in self.chosen)

    @property
    def background_colour(self) -> np.ndarray:
        """Colour (3,) behind the object, in [0, 1]."""
        if self.unmasked and self.plain_background is not None:
            return self.plain_background
        return np.full(3, BACKGROUNDS[self.background], np.float32)

    def _recorded(self, v: int, t: int, raw: np.ndarray | None = None) -> tuple[np.ndarray, bool]:
        """Load an image as recorded, with its mask as alpha channel, (H, W, 4); return also whether its mask is known.

        `raw` is the content of the file, if it was read before.
        """
        found = self.found
        path, mask = found.images[v][t], found.masks[v][t] if found.masks else None
        rgba = _read(path, found.cameras, raw=raw)
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

        The array is uint8, or float32 for a computed mask, which is not rounded to eight bits, because the rounding changes which pixels of
        an outline count as the object.
        """
        if (v, t) in self._kept:
            return self._kept[v, t]
        path = self.found.images[v][t]
        raw = None if path is None else read_image(path)
        done = None if raw is None else self._eight_bit(v, t, raw)
        if done is None:
            done = self._composed(v, t, raw)
        if self.cache:
            self._kept[v, t] = done
        return done

    def _eight_bit(self, v: int, t: int, raw: np.ndarray) -> np.ndarray | None:
        """Return what `_composed` does, in a fifth of the time, of an image with a mask of its own that is neither resized nor undistorted.

        Only the pixels of an outline need arithmetic. Returns None for other images.
        """
        found, size = self.found, (self.cameras.width, self.cameras.height)
        other = found.distortion is not None or (found.masks and found.masks[v][t] is not None) or not self.masked
        if other or size != (found.cameras.width, found.cameras.height) or raw.shape != (size[1], size[0], 4) or raw.dtype != np.uint8:
            return None
        alpha = raw[..., 3]
        if int(alpha.min()) == 255:
            return None
        done = cv2.cvtColor(raw, cv2.COLOR_BGRA2RGBA)
        behind = self.background_colour
        empty = np.append(np.rint(255 * behind), 0).astype(np.uint8).view(np.uint32)  # a pixel as one number
        np.copyto(done.view(np.uint32)[..., 0], empty[0], where=alpha == 0)
        outline = np.flatnonzero((alpha > 0) & (alpha < 255))
        part = done.reshape(-1, 4)[outline].astype(np.float32) / 255
        colour = part[:, :3] * part[:, 3:] + behind * (1 - part[:, 3:])
        done.reshape(-1, 4)[outline, :3] = np.rint(255 * np.clip(colour, 0, 1)).astype(np.uint8)
        return done

    def _composed(self, v: int, t: int, raw: np.ndarray | None) -> np.ndarray:
        """Return RGB over the background, and the mask, (H, W, 4) in 0..255, of any image; `raw` is the content of its file."""
        found = self.found
        rgba, masked = self._recorded(v, t, raw)
        if not masked and self.find_masks:
            colour = self.plain_background
            if colour is None:  # the first frames have masks, but this image has none
                colour = rim_colour(np.concatenate([rgba[0, :, :3], rgba[-1, :, :3], rgba[:, 0, :3], rgba[:, -1, :3]]))
            rgba[..., 3] = mask_on_plain_background(rgba[..., :3], colour)
        keeps = not self.masked or (not masked and (self.unmasked or not self.find_masks))
        shown = np.ones_like(rgba[..., 3:]) if keeps else rgba[..., 3:]
        # premultiplied, so that averaging pixels mixes in no colour from outside the mask
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
        return done.astype(np.float32 if self.find_masks else np.uint8)


class MultiViewDataset(Dataset):
    """Dataset of scenes; a sample is a `MultiViewBatch`.

    Args:
        scenes: The scenes.
        part: Views to load: `train` (not held out), `held_out` (the training views if a scene has none), or `all`.
        first: Index of the first scene in `MultiViewBatch.scene`.
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
    """Lightning data module of multi-view recordings for Stage II, adaptation and scoring; a batch is one scene (`MultiViewBatch`).

    Training uses the training views of `scenes`. Validation uses their held-out views, or the training views of a scene without any. Test
    and predict use all views of `scenes` and `unseen`; scene numbers of `unseen` follow those of `scenes`. Several processes share the
    scenes.

    Args:
        scenes: Folders in any format of `read_recording`, or mappings with `path` and options: `format`, `recording`, `frame_interval` of
            `read_recording`; `views`, `held_out_views`, `scale`, `shift`, `up` of `SceneViews`.
        unseen: Scenes that training does not use.
        frame_start, frame_step, frame_count: Frames to use: the first, every n-th, and their number.
        width: Width of the images [px].
        background: Colour behind the object if a mask is known, `white` or `black`.
        masked: Whether to replace the recorded background if a mask is known.
        cache: Keep loaded images in memory.
        num_workers: Number of worker processes that read.
        seed: Seed of the order of the scenes, which differs between epochs.
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
        """Scenes that training uses."""
        return [self._open(given, f"scenes[{i}]") for i, given in enumerate(self.given)]

    @cached_property
    def unseen(self) -> list[SceneViews]:
        """Scenes that training does not use."""
        return [self._open(given, f"unseen[{i}]") for i, given in enumerate(self.given_unseen)]

    def setup(self, stage: str | None = None) -> None:
        for scene in self.scenes:
            if all(scene.held_out):
                raise UserError(f"{scene.name} has no training view: all its views ({', '.join(scene.views)}) are held out")
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
            return SceneViews(read_recording(reading.pop("path"), reading.pop("format", "auto"), **reading), **self.options, **options)
        except UserError as error:
            raise UserError(f"{where}: {error}") from error


def _only(samples: list[MultiViewBatch]) -> MultiViewBatch:
    return samples[0]


def _indices(found: MultiView, names: Sequence[Any], option: str) -> list[int]:
    names = [str(name) for name in names]
    for name in names:
        if name not in found.views:
            raise UserError(f"{option} has the unknown view {name!r}: {found.name} has {', '.join(found.views[:20])}")
    if len(set(names)) < len(names):
        raise UserError(f"{option} lists a view twice: {', '.join(names)}")
    return [found.views.index(name) for name in names]


def _read(path: Path | None, cameras: Cameras, *, channel: bool = False, raw: np.ndarray | None = None) -> np.ndarray:
    """Load an image as RGBA (H, W, 4), or a mask (H, W) if `channel`, float32 in [0, 1], resized to the image size of the cameras.

    `raw` is the content of the image file, if it was read before.
    """
    if path is None:
        raise UserError("an image is missing")
    image = mask_channel(path) if channel else _rgba(read_image(path) if raw is None else raw)
    height, width = image.shape[:2]
    if (width, height) != (cameras.width, cameras.height):
        if abs(width * cameras.height / (height * cameras.width) - 1) > SAME_SHAPE:
            raise UserError(
                f"{path} has {width} x {height} pixels, but its camera has {cameras.width} x {cameras.height}, another aspect ratio"
            )
        image = cv2.resize(image, (cameras.width, cameras.height), interpolation=cv2.INTER_AREA)
    return image


def _rgba(raw: np.ndarray) -> np.ndarray:
    image = raw.astype(np.float32) / np.iinfo(raw.dtype).max
    if image.ndim == 2 or image.shape[2] == 1:
        return cv2.cvtColor(image, cv2.COLOR_GRAY2RGBA)
    if image.shape[2] == 2:  # grey and alpha
        return np.concatenate([image[..., :1].repeat(3, axis=2), image[..., 1:]], axis=2)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGBA if image.shape[2] == 3 else cv2.COLOR_BGRA2RGBA)


def _resize(layers: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Resize layers (H, W, C), each on its own: at fractional ratios, OpenCV averages areas of at most four channels."""
    method = cv2.INTER_AREA if size[0] < layers.shape[1] else cv2.INTER_LINEAR
    parts = [cv2.resize(np.ascontiguousarray(layers[..., c : c + 1]), size, interpolation=method) for c in range(layers.shape[2])]
    return np.stack(parts, axis=2)


def _undistort(layers: np.ndarray, K: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    """Undistort layers (H, W, C) to a pinhole with the same K; for OpenCV, pixel centres lie at whole numbers."""
    K = K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    parts = [cv2.undistort(np.ascontiguousarray(layers[..., c]), K, distortion) for c in range(layers.shape[2])]
    return np.stack(parts, axis=2)
