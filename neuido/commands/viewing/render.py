"""The `render` command: pictures and videos of a motion, without a display. `--help` loads no torch."""

from pathlib import Path

import numpy as np

from neuido.data.progress import Progress
from neuido.errors import UserError, suggest

FRAME_RATE = 24.0
"""Frames a second of a video by default: that of films."""


def render_path(
    path: str,
    *,
    out: str,
    recording: str | None = None,
    colour: str | None = None,
    eye: list[float] | None = None,
    look_at: list[float] | None = None,
    fov: float = 35.0,
    camera: str | None = None,
    width: int = 800,
    height: int = 600,
    frame: int | None = None,
    every: int = 1,
    frame_rate: float = FRAME_RATE,
    legend: bool = True,
    progress: bool = True,
) -> None:
    """Draw a motion to a video or pictures: `neuido render PATH --out clip.mp4`.

    Args:
        path: What `neuido view` opens: a rollout (.npz), a folder of `simulate`, `predict` or `diagnose`, an experiment, a recording, or
            PLY files of particles or Gaussians.
        out: File to write. `.mp4`: H.264. `.webm`: VP9. `.png`: one picture of a single frame, else numbered pictures.
        recording: Name of the recording, body or scene to draw, where there are several; the first where absent.
        colour: Quantity by which particles are coloured: speed, "von Mises stress", strain, "plastic strain", "volume ratio", displacement,
            residual or body; the first that the motion has where absent.
        eye: Position of the camera, three numbers, m; where everything is in the picture where absent.
        look_at: Point in the middle of the picture, three numbers, m; the middle of the motion where absent.
        fov: Vertical field of view, degrees.
        camera: Name of a camera of the recording, in place of eye.
        width: Width, px.
        height: Height, px.
        frame: Number of the one frame to draw, from 0; negative: from the end.
        every: Draw every so many frames.
        frame_rate: Pictures a second of the video.
        legend: Whether to write the legend and the time.
        progress: Show progress on stderr.

    Raises:
        UserError: Nothing to draw, an impossible option, a missing extra.
    """
    from neuido.viewer.picture import Painter, View
    from neuido.viewer.recorder import check_output, write_pngs, write_video
    from neuido.viewer.sources import is_scene, read_content

    target = Path(out).expanduser()
    check_output(target, frame_rate)
    if every < 1:
        raise UserError(f"every is {every}; it must be a positive whole number")
    moving = target.suffix.lower() != ".png"
    if moving and (width % 2 or height % 2):
        raise UserError(f"width and height are {width} and {height}; a video needs even numbers")
    if is_scene(path):
        raise UserError(f"{path} is a scene: `neuido simulate {path} --out FOLDER` makes its motion, and render draws FOLDER")
    content = read_content(path, recording)
    names = content.quantities()
    if colour is not None and colour not in names:
        raise UserError(f"colour = {colour!r} is not known of {path}{suggest(colour, names) or ';'} it has {', '.join(names)}")
    chosen = _frames(content.frames, frame, every)
    view = View(_point(eye, "eye"), _point(look_at, "look_at"), fov, width, height, camera)
    painter = Painter(content, colour or names[0], view, legend=legend)
    with Progress(f"drawing {content.title}", len(chosen), unit="pictures", shown=progress) as bar:

        def pictures():
            for k in chosen:
                yield painter.picture(int(k))
                bar.update()

        if moving:
            write_video(target, pictures(), frame_rate)
            written = [target]
        else:
            written = write_pngs(target, pictures(), len(chosen))
    print(f"{content.title}: {len(chosen)} frame{'' if len(chosen) == 1 else 's'} of {width} x {height} px, coloured by {painter.quantity}")
    if moving and content.timed and len(chosen) > 1:
        pace = float(content.times[chosen[1]] - content.times[chosen[0]]) * frame_rate
        print(f"it plays {len(chosen) / frame_rate:.3g} s, at {pace:.3g} times the speed of the motion")
    size = sum(each.stat().st_size for each in written) / 1e6
    print(f"results in {written[0]}{f' to {written[-1].name}' if len(written) > 1 else ''}: {size:.3g} MB")


def _frames(count: int, frame: int | None, every: int) -> np.ndarray:
    """Return the indices of the frames to draw."""
    if frame is None:
        return np.arange(0, count, every)
    if not -count <= frame < count:
        raise UserError(f"frame is {frame}; the motion has {count} frames, 0 to {count - 1}")
    return np.array([frame % count])


def _point(given: list[float] | None, option: str) -> tuple[float, float, float] | None:
    if given is None:
        return None
    if len(given) != 3 or not np.isfinite(given).all():
        raise UserError(f"{option} = {given} must be three numbers, such as [1.2, 0.6, 1.4]")
    return tuple(given)  # type: ignore[return-value]
