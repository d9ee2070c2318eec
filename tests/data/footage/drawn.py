"""Videos that tests draw: a ball in flight before a textured background, with a known motion."""

from collections.abc import Callable, Iterable
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import pytest

av = pytest.importorskip("av")
SIZE = 320, 240
SCALE = 0.01
"""Metres per pixel."""
RADIUS = 7.3  # px


def flight(t: np.ndarray, *, drag: float = 0.0, v0=(2.5, 4.5), x0=(0.2, 0.6)) -> np.ndarray:
    """Positions [m] (T, 2) of a ball with quadratic drag `drag` [1/m], by the explicit midpoint rule with fine steps."""
    x, v, out, now = np.array(x0, float), np.array(v0, float), [], 0.0

    def acceleration(v):
        return np.array([0.0, -9.81]) - drag * np.linalg.norm(v) * v

    for time in t:
        steps = max(int(np.ceil((time - now) / 1e-3)), 1)
        dt = (time - now) / steps
        for _ in range(steps):
            middle = v + 0.5 * dt * acceleration(v)
            x, v = x + dt * middle, v + dt * acceleration(middle)
        now = time
        out.append(x)
    return np.array(out)


def scenery(seed: int = 0, size=SIZE) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return cv2.GaussianBlur(rng.uniform(60, 190, (size[1], size[0], 3)).astype(np.float32), (0, 0), 3)


def ball(background: np.ndarray, centre, radius: float = RADIUS, colour=(240, 235, 20)) -> np.ndarray:
    """Draw a disc with smooth edges at a centre [px], (H, W, 3) float32."""
    i, j = np.mgrid[: background.shape[0], : background.shape[1]]
    inside = np.clip(radius - np.hypot(j + 0.5 - centre[0], i + 0.5 - centre[1]) + 0.5, 0, 1)[..., None]
    return background * (1 - inside) + np.array(colour, np.float32) * inside


def film(path: Path, images: Iterable[np.ndarray], *, rate: int = 60, times=None, sound: np.ndarray | None = None) -> Path:
    """Write RGB images (H, W, 3) as an mp4 with the times [s] of its frames, or a constant rate; `sound` is mono at 16 kHz."""
    rng = np.random.default_rng(1)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=rate, options={"crf": "14", "preset": "ultrafast"})
        voice = container.add_stream("aac", rate=16000, layout="mono") if sound is not None else None
        stream.pix_fmt, stream.codec_context.time_base = "yuv420p", Fraction(1, 90000)
        for i, image in enumerate(images):
            noisy = np.clip(np.rint(image + rng.normal(0, 1.5, image.shape)), 0, 255).astype(np.uint8)
            if i == 0:
                stream.height, stream.width = noisy.shape[:2]
            frame = av.VideoFrame.from_ndarray(noisy, format="rgb24")
            frame.time_base = stream.codec_context.time_base
            frame.pts = round((times[i] if times is not None else i / rate) / frame.time_base)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
        if voice is not None and sound is not None:
            frame = av.AudioFrame.from_ndarray(sound.astype(np.float32)[None], format="fltp", layout="mono")
            frame.sample_rate, frame.pts = 16000, 0
            container.mux(voice.encode(frame))
            container.mux(voice.encode(None))
    return path


def pixels(x: np.ndarray, size=SIZE, scale: float = SCALE) -> np.ndarray:
    """Convert positions [m] with y up from the lower left corner to pixels."""
    return np.stack([x[:, 0] / scale, size[1] - x[:, 1] / scale], 1)


def throw(
    path: Path, *, count: int = 50, rate: int = 60, seed: int = 0, change: Callable = lambda i, image: image, size=SIZE, **motion
) -> np.ndarray:
    """Film a throw; return the true positions [m] (T, 2). In a small picture the ball has the same share of the width."""
    x = flight(np.arange(count) / rate, **motion)
    background, ratio = scenery(seed, size), size[0] / SIZE[0]
    centres = ratio * pixels(x)
    film(path, (change(i, ball(background, centre, max(ratio * RADIUS, 4.0))) for i, centre in enumerate(centres)), rate=rate)
    return x


BOARD = "5x4 60 mm 45 mm 4X4_50"
STAGE = 480, 360
"""Size of the images of several cameras [px]."""


def board_texture(dots: int = 500) -> np.ndarray:
    """Draw the board, (H, W, 3) float32; its width is `dots`."""
    from neuido.data.footage.board_cameras import parse_board

    board = parse_board(BOARD)
    image = board.opencv().generateImage((dots, dots * board.rows // board.columns), marginSize=0)
    return image[..., None].repeat(3, axis=2).astype(np.float32)


def staged(cameras, x: np.ndarray, radius: float = 0.02):
    """Yield for each camera the images of a ball with centres x (T, 3) [m] above a board that lies on the floor.

    The board lies in the plane y = 0, from the origin to (0.3, 0, 0.24) m, seen from above with its first corner at the origin.
    """
    texture = board_texture()
    high, wide = texture.shape[:2]
    to_floor = np.array([[0.3 / wide, 0, 0], [0, 0, 0], [0, 0.24 / high, 0], [0, 0, 1]])  # dots of the texture to points of the floor
    for v in range(len(cameras.viewmats)):
        P = (cameras.Ks[v].double() @ cameras.viewmats[v].double()[:3]).numpy()
        H = np.diag([4.0, 4, 1]) @ (P @ to_floor)  # finer, then averaged
        size = 4 * cameras.width, 4 * cameras.height
        floor = cv2.warpPerspective(texture, H, size, flags=cv2.INTER_AREA, borderValue=(120.0,) * 3, borderMode=cv2.BORDER_CONSTANT)
        floor = cv2.resize(floor, (cameras.width, cameras.height), interpolation=cv2.INTER_AREA)
        images = []
        for point in x:
            h = P @ [*point, 1.0]
            images.append(ball(floor, h[:2] / h[2], radius * float(cameras.Ks[v, 0, 0]) / h[2], (230, 40, 40)))
        yield images


def corner_of_a_room(cameras):
    """Yield an image for each camera of a floor and two walls, painted with discs, that fill the unit square of each plane."""
    rng = np.random.default_rng(0)
    planes = []
    for to_space in ([[1, 0, 0], [0, 0, 0], [0, 1, 0]], [[1, 0, 0], [0, 1, 0], [0, 0, 0]], [[0, 0, 0], [0, 1, 0], [1, 0, 0]]):
        paint = np.full((600, 600, 3), 120, np.float32)
        for _ in range(700):
            centre, colour = rng.integers(0, 600, 2), rng.uniform(0, 255, 3)
            cv2.circle(paint, (int(centre[0]), int(centre[1])), int(rng.integers(4, 22)), tuple(float(c) for c in colour), cv2.FILLED)
        planes.append((paint, np.vstack([np.array(to_space) / [600, 600, 1], [0, 0, 1]])))
    size = (cameras.width, cameras.height)
    for K, viewmat in zip(cameras.Ks.double(), cameras.viewmats.double()):
        P, image = (K @ viewmat[:3]).numpy(), np.full((*size[::-1], 3), 120, np.float32)
        for paint, to_space in planes:
            fine = cv2.warpPerspective(paint, np.diag([2.0, 2, 1]) @ P @ to_space, (2 * size[0], 2 * size[1]), borderValue=(-1e4,) * 3)
            part = cv2.resize(fine, size, interpolation=cv2.INTER_AREA)
            image = np.where(part > -50, part, image)
        yield image
