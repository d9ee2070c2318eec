"""Particles of a rollout as files that other programs read: NumPy archive, PLY sequence, CSV table."""

import os
from pathlib import Path
from typing import Any

from neuido.errors import UserError

FORMATS = {".npz": "NumPy archive", ".ply": "PLY sequence", ".csv": "table"}


def export(frames: Any, path: str | os.PathLike, *, frame_interval: float | None = None) -> Path:
    """Write the frames of a rollout; the extension of the file selects the format (`Frames.save`).

    Args:
        frames: `Frames`, or another motion with positions x [m] and velocities v [m/s], (K, P, 3); C, F and times [s] are optional.
        path: `.npz`: one archive of all arrays. `.ply`: a sequence `NAME_0000.ply`, `NAME_0001.ply`, ... with x, y, z [m] and
            vx, vy, vz [m/s] of each particle. `.csv`: one row for each frame and particle.
        frame_interval: Time between two frames [s], for a motion without times.

    Returns:
        The file; for a sequence, its first file.

    Raises:
        UserError: An unknown extension, a wrong shape, or times that are missing or unevenly spaced.
    """
    from neuido.physics.runtime.frames import Frames

    target = Path(path).expanduser()
    if target.suffix.lower() not in FORMATS:
        raise UserError(f"path = {path}: its ending must be one of {', '.join(f'{end} ({what})' for end, what in FORMATS.items())}")
    if not isinstance(frames, Frames):
        frames = _as_frames(frames, target, frame_interval)
    return frames.save(target)[0]


def _as_frames(motion: Any, path: Path, frame_interval: float | None) -> Any:
    """Return a motion of any type as `Frames`."""
    import torch

    from neuido.physics.runtime.frames import Frames

    names = ("x", "v", "C", "F")
    parts = [None if getattr(motion, name, None) is None else torch.as_tensor(getattr(motion, name)) for name in names]
    for name, part in zip(names[:2], parts):
        if part is None or part.ndim != 3 or part.shape[-1] != 3:
            found = "absent" if part is None else f"of shape {tuple(part.shape)}"
            raise UserError(f"frames.{name} is {found}; a motion has positions x and velocities v of shape (K, P, 3)")
    times = getattr(motion, "times", None)
    if frame_interval is None and times is not None and len(times) > 1:
        steps = torch.as_tensor(times, dtype=torch.float64).diff()
        frame_interval = float(steps.mean())
        if not bool(((steps - frame_interval).abs() <= 1e-3 * abs(frame_interval)).all()):
            raise UserError(f"frames.times are {float(steps.min()):g} to {float(steps.max()):g} s apart; export needs even times")
    if frame_interval is None and path.suffix.lower() != ".ply" and len(parts[0]) > 1:  # type: ignore[arg-type]
        raise UserError("frames have no times: give export the frame_interval [s]")
    return Frames(*parts, dt=frame_interval or 0.0)  # type: ignore[arg-type]
