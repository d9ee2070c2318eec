"""A folder of measured data that appears once the reader of its format takes it."""

import os
import tempfile
from collections.abc import Callable
from pathlib import Path

from neuido.data.files.writing import new_folder
from neuido.errors import UserError


def write_checked(out: str | os.PathLike | None, fill: Callable[[Path], None], read: Callable[[Path], object]) -> None:
    """Fill a new folder, read it, and give it its name; with no `out` only try that.

    Args:
        out: The folder to make.
        fill: What writes its files.
        read: The reader of its format.

    Raises:
        UserError: What the reader finds, without the name of the temporary folder; a folder that is there already.
    """

    def attempt(folder: Path) -> None:
        fill(folder)
        try:
            read(folder)
        except UserError as error:
            raise UserError(str(error).replace(f"{folder}{os.sep}", "")) from error

    if out is None:
        with tempfile.TemporaryDirectory() as folder:
            attempt(Path(folder))
    else:
        with new_folder(Path(out).expanduser()) as folder:
            attempt(folder)
