"""Export of motion to files that other programs read. The package itself is callable: `neuido.export(frames, path)`."""

import os
import sys
from pathlib import Path
from types import ModuleType
from typing import Any


class _Export(ModuleType):
    def __call__(self, frames: Any, path: str | os.PathLike, **options: Any) -> Path:
        """Write the frames of a rollout; see `neuido.export.exporting.export`, which has the options."""
        from neuido.export.exporting import export

        return export(frames, path, **options)


sys.modules[__name__].__class__ = _Export  # a folder and a function have one name in `neuido`
