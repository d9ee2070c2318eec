"""Atomic writing of files."""

import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from neuido.errors import UserError


@contextmanager
def whole_file(path: str | os.PathLike) -> Iterator[Path]:
    """Open a context that yields a temporary path in the folder of `path`; at its end the temporary file is renamed to `path`.

    After an error the temporary file is deleted, and an existing file at `path` is unchanged.

    Args:
        path: The file to write; missing folders are created.

    Raises:
        UserError: The file cannot be written.
    """
    path = Path(path)
    hidden = path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield hidden
        os.replace(hidden, path)
    except OSError as error:
        raise UserError(f"{path} cannot be written: {str(error.strerror).lower()}; give another path") from error
    finally:
        if hidden.exists():
            hidden.unlink()
