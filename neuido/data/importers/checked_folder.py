"""Write a folder of measured data only if its reader accepts it."""

import os
import tempfile
from collections.abc import Callable
from pathlib import Path

from neuido.data.files.writing import new_folder
from neuido.errors import UserError


def write_checked(out: str | os.PathLike | None, fill: Callable[[Path], None], read: Callable[[Path], object]) -> None:
    """Write a new folder, read it back, and give it its final name only if the reader accepts it.

    Args:
        out: The folder to create. None: check the content in a temporary folder and keep nothing.
        fill: Writes the files into the folder that it is given.
        read: Reads the folder; raises UserError if the content is not valid.

    Raises:
        UserError: The reader refuses the content, or `out` exists. The message does not contain the path of the temporary folder.
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
