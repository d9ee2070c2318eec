"""Motion as files that other programs read. The package is its own function: `neuido.export(frames, path)`."""

import os
import sys
from pathlib import Path
from types import ModuleType
from typing import Any


class _Export(ModuleType):
    def __call__(self, frames: Any, path: str | os.PathLike) -> Path:
        """Write the frames of a rollout; see `neuido.export.particles.export`."""
        from neuido.export.particles import export

        return export(frames, path)


sys.modules[__name__].__class__ = _Export  # a folder and a function have one name in `neuido`
