"""Write the clips of several cameras as a recording of images, which `neuido reconstruct` reads."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from neuido.data.footage.contact_sheet import Sheet
from neuido.data.footage.filming import Filming
from neuido.data.footage.view_recording import write_views
from neuido.data.importers.tables.checked_folder import write_checked
from neuido.data.scenes.readers import read_recording
from neuido.errors import UserError


def write_view_folder(
    files: Mapping[str, Path],
    out: str | os.PathLike | None,
    filming: Filming,
    sheet: Sheet,
    *,
    held_out: Sequence[str],
    scale: float | None,
    up: str,
    floor: float | None,
    frame_rate: float | None,
) -> list[str]:
    """Write the clips of one motion as a recording; return the lines of the summary.

    Args:
        files: The video file of each view by its name.
        out: The folder to create. None: check the clips and write nothing.
        filming: The user's options.
        sheet: Collects frames for the contact sheet.
        held_out: Names of the views that are only scored.
        scale, up, floor, frame_rate: As for `write_views`.

    Raises:
        UserError: As `write_views`, or `held_out` has an unknown view or all.
    """
    names = list(files)
    if unknown := [name for name in held_out if name not in names]:
        raise UserError(f"--held_out has the unknown view {unknown[0]!r}: choose from {', '.join(names)}")
    if set(names) == set(held_out):
        raise UserError("--held_out lists every view: leave at least two to train on")
    held, summary = [names.index(name) for name in held_out], []

    def fill(folder: Path) -> None:
        summary.extend(
            write_views(
                list(files.values()), folder, filming, scale=scale, up=up, floor=floor, frame_rate=frame_rate, sheet=sheet, held_out=held
            )
        )

    write_checked(out, fill, read_recording)
    if out is not None:
        config = f"neuido predict --config configs/predict.yaml --data.scenes [{out}]"
        summary.append(f"next: neuido check {out}; neuido reconstruct {out}; {config}")
    return summary
