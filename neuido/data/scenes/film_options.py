"""Options for filming synthetic scenes. This module does not load torch, so that `--help` stays fast."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Film:
    """Cameras, frames and images of a synthetic film.

    Args:
        views: Number of cameras, spaced evenly around the target.
        held_out: Views that are used for scoring only.
        width: Width of the images, px.
        height: Height of the images, px.
        frames: Number of frames, the first at t = 0.
        substeps: Substeps between frames; 5 in the paper.
        radius: Distance of the cameras from the target, m.
        target: Point that the cameras look at, m.
        elevations: Elevation angles of the cameras above the horizon, degrees, used in turn.
        angle: Horizontal angle of view, degrees.
        density: Gaussians per particle that are rendered; models do not see them.
        compression: Compression level of the PNG files, 0 to 9.
    """

    views: int = 10
    held_out: tuple[int, ...] = (3, 8)
    width: int = 400
    height: int = 400
    frames: int = 80
    substeps: int = 5
    radius: float = 2.2
    target: tuple[float, float, float] = (0.5, 0.35, 0.5)
    elevations: tuple[float, ...] = (12.0, 32.0)
    angle: float = 36.0
    density: int = 4
    compression: int = 1
