"""Export of motion to files that other programs read. The package itself is callable: `neuido.export(frames, path)`."""

import os
import sys
from pathlib import Path
from types import ModuleType
from typing import Any


class _Export(ModuleType):
    def __call__(self, frames: Any, path: str | os.PathLike, *, frame_interval: float | None = None) -> Path:
        """Write the frames of a rollout; see `neuido.export.particles.export`."""
        from neuido.export.particles import export

        return export(frames, path, frame_interval=frame_interval)


sys.modules[__name__].__class__ = _Export  # a folder and a function have one name in `neuido`
