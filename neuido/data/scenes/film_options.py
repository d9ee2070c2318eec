"""The options of a synthetic film, without torch: the help of `neuido simulate` reads them."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Film:
    """How scenes are filmed.

    Args:
        views: Cameras, evenly around the middle of the scene.
        held_out: Which of them are for scoring only.
        width: Width of the images, px.
        height: Height of the images, px.
        frames: Frames, the first at t = 0.
        substeps: Substeps from one frame to the next; the paper takes one frame of five.
        radius: Distance of the cameras from the point they look at, m.
        target: The point they look at, m.
        elevations: Heights of the cameras above the horizon, degrees, taken in turn.
        angle: Horizontal angle of view, degrees.
        density: Gaussians for each particle; the images come from these, and no model is given them.
        compression: Of the PNG files, 0 to 9.
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
