"""Names and roles of imported recordings; write a folder of measured data only if its reader accepts it."""

import os
import re
import tempfile
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from neuido.data.files.writing import new_folder, write_text
from neuido.errors import PlausibilityWarning, UserError


def write_checked(out: str | os.PathLike | None, fill: Callable[[Path], None], read: Callable[[Path], object]) -> list[str]:
    """Write a new folder, read it back, and give it its final name only if the reader accepts it; return what is odd in it.

    Args:
        out: The folder to create. None: check the content in a temporary folder and keep nothing.
        fill: Writes the files into the folder that it is given.
        read: Reads the folder; raises UserError if the content is not valid.

    Raises:
        UserError: The reader refuses the content, or `out` exists. The message does not contain the path of the temporary folder.
    """

    def attempt(folder: Path) -> list[str]:
        try:
            with warnings.catch_warnings(record=True) as odd:
                warnings.simplefilter("always", PlausibilityWarning)
                fill(folder)
                read(folder)
        except UserError as error:
            raise UserError(str(error).replace(f"{folder}{os.sep}", "")) from error
        said = [str(each.message) for each in odd if issubclass(each.category, PlausibilityWarning)]
        return [f"odd: {line.replace(f'{folder}{os.sep}', '')}" for line in said]

    if out is None:
        with tempfile.TemporaryDirectory() as folder:
            return attempt(Path(folder))
    with new_folder(Path(out).expanduser()) as folder:
        return attempt(folder)


def write_tables(
    out: str | os.PathLike | None,
    name: str,
    content: dict[str, Any],
    tables: Mapping[str, Mapping[str, np.ndarray]],
    read: Callable[[Path], object],
) -> list[str]:
    """Write CSV tables and their YAML file to a new folder if the reader accepts them; return what is odd in them.

    Args:
        out: The folder to create. None: check the content and write nothing.
        name: Name of the YAML file.
        content: Its content.
        tables: Columns by title, of each table by its name without `.csv`.
        read: Reads the folder; raises UserError if the content is not valid.
    """

    def fill(folder: Path) -> None:
        for file, columns in tables.items():
            lines = [",".join(columns), *(",".join(repr(float(v)) for v in row) for row in zip(*columns.values()))]
            write_text(folder / f"{file}.csv", "\n".join(lines) + "\n")
        write_text(folder / name, yaml.safe_dump(content, sort_keys=False, default_flow_style=None, allow_unicode=True))

    return write_checked(out, fill, read)


def recording_name(text: str, others: Collection[str] = ()) -> str:
    """Return a name for a recording, which can name a file; a number is added where another recording has it."""
    name = re.sub(r"[^\w-]+", "-", text).strip("-_")[:60] or "recording"
    same = sum(1 for other in others if other == name or re.fullmatch(re.escape(name) + r"-\d+", other))
    return f"{name}-{same + 1}" if name in others else name


def roles_of(names: Sequence[str], held_out: Sequence[str], of_file: Mapping[str, Sequence[str]] | None = None) -> dict[str, str]:
    """Return the role of each recording, `fit` or `held_out`; without a choice the last of several is held out.

    Args:
        names: Names of the recordings.
        held_out: Names of recordings, or of files, that are only scored.
        of_file: The recordings of each file.

    Raises:
        UserError: A name of `held_out` is unknown, or all recordings are held out.
    """
    groups = {**{name: [name] for name in names}, **(of_file or {})}
    unknown = [name for name in held_out if name not in groups]
    if unknown:
        raise UserError(f"--held_out has the unknown recording {unknown[0]!r}: choose from {', '.join(groups)}")
    held = {name for group in held_out for name in groups[group]} or (set(names[-1:]) if len(names) > 1 else set())
    if len(held) == len(names):
        raise UserError("--held_out lists every recording: leave at least one to fit")
    return {name: "held_out" if name in held else "fit" for name in names}
