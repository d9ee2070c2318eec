"""Convert files of testing machines, trackers and motion capture to a folder that `neuido diagnose` reads."""

import os
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from neuido.data.files.parsing import naming
from neuido.data.files.values import number
from neuido.data.footage.filming import Filming
from neuido.data.footage.video_frames import is_video
from neuido.data.importers.declared_guide import Guide
from neuido.data.importers.fields.field_exports import BINARY, layout_of
from neuido.data.importers.machines.loading_path import Preparation
from neuido.data.importers.machines.material_folder import Material, write_material_tests
from neuido.data.importers.machines.testing_machine import Specimen
from neuido.data.importers.plain_motion import Motion
from neuido.data.importers.tables.checked_folder import recording_name, roles_of
from neuido.data.importers.tables.titled_tables import Table, read_cells, read_titled
from neuido.data.importers.tables.titles import find_columns, named_points
from neuido.data.importers.tables.units import parse_quantity
from neuido.data.importers.track_folder import Axes, RecordedMotion, in_si, write_tracks
from neuido.data.importers.tracker_exports import layout_of_rows, read_motions
from neuido.errors import UserError

if TYPE_CHECKING:
    from neuido.data.footage.contact_sheet import Sheet

KINDS = ("auto", "material", "track", "body", "field")
WHAT = {"material": "a material test", "track": "a motion", "body": "points on a deforming body", "field": "a full field",
        "plane": "a full field on a mesh (--elements)",
        "film": "a video", "outlines": "an outline (--kind body)", "views": "clips of several cameras (--cameras)"}  # fmt: skip
"""What the data of each kind are called in messages."""


def import_file(
    files: str | os.PathLike | Sequence[str | os.PathLike],
    out: str | os.PathLike | None,
    *,
    kind: str = "auto",
    mode: str = "uniaxial",
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    specimen: Specimen | None = None,
    filming: Filming | None = None,
    compression: bool = False,
    preparation: Preparation | None = None,
    step: str | None = None,
    sheet: str | None = None,
    forces: str | None = None,
    region: Sequence[float] | None = None,
    elements: str | None = None,
    condition: str | None = None,
    density: float | None = None,
    young: float | None = None,
    poisson: float | None = None,
    scale: float | None = None,
    y_down: bool = False,
    up: str = "y",
    frame_rate: float | None = None,
    point: str | None = None,
    mass: float | None = None,
    diameter: float | None = None,
    volume: float | None = None,
    floor: float | None = None,
    guide: Guide | None = None,
    held_out: Sequence[str] = (),
) -> list[str]:
    """Convert files of a testing machine, a tracker or a camera to a folder for `neuido diagnose`.

    `neuido import --help` describes the options.

    Args:
        files: One file per recording.
        out: The folder to create; it must not exist. None: check the files and write nothing.

    Returns:
        The lines of the summary: what each column was taken for, in which unit, and what was assumed.

    Raises:
        UserError: A file cannot be read, or something is missing. The message names the option that supplies it.
    """
    paths = [Path(file).expanduser() for file in ([files] if isinstance(files, str | os.PathLike) else files)]
    if not paths:
        raise UserError("no file is given: name at least one")
    if kind not in KINDS:
        raise UserError(f"--kind {kind} is unknown: choose from {', '.join(KINDS)}")
    if up not in ("y", "z") and not (filming and filming.cameras):
        raise UserError(f"--up {up} must be y or z")
    guide = guide or Guide()
    for option, value in (("density", density), ("young", young), ("mass", mass), ("diameter", diameter), ("volume", volume),
                          ("scale", scale), ("frame_rate", frame_rate), ("stiffness", guide.stiffness)):  # fmt: skip
        if value is not None:
            number(value, f"--{option}", above=0.0)
    if out is not None and Path(out).expanduser().exists():
        raise UserError(f"--out {out} exists already: give another folder")
    for path in paths:
        if not path.is_file():
            raise UserError(f"{path} is missing" if not path.exists() else f"{path} is not a file")
    files_by_name: dict[str, Path] = {}
    for path in paths:
        name = recording_name(path.stem)
        if name in files_by_name:
            raise UserError(f"{files_by_name[name]} and {path} give a recording the same name, {name}: rename one of them")
        files_by_name[name] = path
    columns, units = dict(columns or {}), dict(units or {})
    axes = Axes(scale, y_down, up, frame_rate)
    filming, contact = filming or Filming(), None
    films = [path for path in paths if is_video(path)]
    if films and len(films) < len(paths):
        raise UserError(f"{films[0].name} is a video and {next(p for p in paths if p not in films).name} is not: import them one by one")
    if films and kind not in ("auto", "track", "body"):
        raise UserError(f"--kind {kind} is not for videos: leave it out, and give --cameras if the clips are views of one motion")
    outlines = films and kind == "body" and filming.cameras is None
    with naming(paths[0]):
        if films:
            chosen = "track"
        elif kind != "auto":
            chosen = kind
        else:
            chosen = "field" if elements is not None else _kind(paths[0], columns)
    if chosen == "field" and elements is not None:
        chosen = "plane"
    guided = {key: value for key, value in guide._asdict().items() if value is not None and value != "none"}
    shared = guided.pop("length", None)  # of a specimen too
    dimensions = {"section_diameter" if key == "diameter" else key: value for key, value in (specimen or Specimen())._asdict().items()}
    filmed = {key: None if value == "none" else value for key, value in filming._asdict().items()}
    several = {key: filmed.pop(key) for key in ("board", "synchronise")}
    placed = {key: filmed.pop(key) for key in ("cameras", "offsets")}
    _check_options(
        paths[0].name,
        "views" if films and filming.cameras is not None else "outlines" if outlines else "film" if films else chosen,
        (("film", "outlines", "views", "track", "body"), {"scale": scale, "frame_rate": frame_rate}),
        (("film", "track", "body"), {"y_down": y_down, "point": point, "mass": mass, "diameter": diameter}),
        (("body",), {"volume": volume}),
        (("views", "body", "outlines", "track", "film"), {"floor": floor}),
        (("track", "film"), {"guide": guided.pop("type", None), **guided}),
        (("material", "field", "outlines", "body", "plane"), {"density": density, "young": young, "poisson": poisson}),
        (("material",), {"step": step, "sheet": sheet, "compression": compression, "mode": None if mode == "uniaxial" else mode,
                         **(preparation or Preparation()).changed()}),
        (("material", "field", "outlines", "plane"), {"thickness": dimensions.pop("thickness")}),
        (("material", "field"), dimensions),
        (("track", "film"), {"length": shared}),
        (("material", "film", "outlines", "views", "track", "body", "plane"), {"held_out": held_out or None}),
        (("field", "plane"), {"forces": forces}),
        (("field",), {"region": region}),
        (("plane",), {"elements": elements, "condition": condition}),
        (("film", "outlines", "views"), filmed),
        (("views", "track", "body"), placed),
        (("views",), several),
    )  # fmt: skip
    if films:
        from neuido.data.footage.contact_sheet import Sheet

        contact = Sheet()
        if filming.cameras is not None:
            from neuido.data.importers.view_folder import write_view_folder

            summary = write_view_folder(
                files_by_name, out, filming, contact, held_out=held_out, scale=scale, up=up, floor=floor, frame_rate=frame_rate
            )
            return summary + _contact_sheet(contact, filming)
    if outlines:
        from neuido.data.importers.filmed_body import write_filmed_body

        assert contact is not None
        thickness = None if specimen is None else specimen.thickness
        summary = write_filmed_body(
            files_by_name,
            out,
            filming,
            contact,
            roles=roles_of(list(files_by_name), held_out),
            scale=scale,
            thickness=None if thickness is None else parse_quantity(thickness, "m", "thickness"),
            density=density,
            young=young,
            poisson=poisson,
            floor=floor,
            frame_rate=frame_rate,
        )
        return summary + _contact_sheet(contact, filming) + _next_commands(out)

    def read(path: Path) -> dict[str, RecordedMotion]:
        if contact is None:
            return {own: in_si(path, motion, units, axes) for own, motion in read_motions(path, columns, frame_rate).items()}
        from neuido.data.footage.centre_track import read_centres

        found = read_centres(path, filming, frame_rate=frame_rate, diameter=diameter, scaled=scale is not None, sheet=contact)
        motion = Motion(found.t, {"object": found.x}, found.unit, False, found.notes, True)
        return {"": in_si(path, motion, units, axes._replace(y_down=False))._replace(scale_error=found.scale_error)}

    cameras = filming.cameras is not None and not films
    said = [f"read as {WHAT[chosen]} (--kind {'field' if chosen == 'plane' else chosen})"] if kind == "auto" and not films else []
    if chosen == "material":
        summary = write_material_tests(
            files_by_name,
            out,
            held_out=held_out,
            mode=mode,
            columns=columns,
            units=units,
            specimen=specimen or Specimen(),
            compression=compression,
            preparation=preparation or Preparation(),
            step=step,
            sheet=sheet,
            material=Material(density, young, poisson),
        )
    elif chosen == "plane":
        from neuido.data.importers.fields.plane_folder import write_plane_folder

        summary = write_plane_folder(
            files_by_name,
            out,
            elements=str(elements),
            forces=forces,
            units=units,
            thickness=None if specimen is None else specimen.thickness,
            condition=condition,
            material=Material(density, young, poisson),
            held_out=held_out,
        )
    elif chosen == "field":
        from neuido.data.importers.fields.field_folder import write_field_test

        summary = write_field_test(
            files_by_name,
            out,
            forces=forces,
            region=region,
            columns=columns,
            units=units,
            specimen=specimen or Specimen(),
            material=Material(density, young, poisson),
        )
    else:
        takes: dict[str, tuple[Path, RecordedMotion]] = {}
        of_file: dict[str, list[str]] = {}
        for name, path in {} if cameras else files_by_name.items():
            with naming(path):
                for label, motion in read(path).items():
                    own = recording_name(f"{name}-{label}" if label else name, takes)
                    takes[own] = (path, motion)
                    of_file.setdefault(name, []).append(own)
        if cameras:
            from neuido.data.importers.view_tracks import read_view_tracks

            takes["views"] = (Path(str(filming.cameras)), read_view_tracks(paths, filming, columns, units, axes))
        roles = roles_of(list(takes), held_out, of_file)
        if chosen == "track":
            summary = write_tracks(takes, out, roles=roles, point=point, mass=mass, diameter=diameter, guide=guide, floor=floor)
        else:
            from neuido.data.importers.deforming import write_deforming_body

            summary = [line for path, motion in takes.values() for line in (f"{path.name}: {note}" for note in motion.notes)]
            with naming(paths[0]):
                summary += write_deforming_body(
                    {name: motion[:2] for name, (_, motion) in takes.items()},
                    out,
                    roles=roles,
                    density=density,
                    young=young,
                    poisson=poisson,
                    volume=volume,
                    floor=floor,
                )
        if len(takes) > 1:
            summary.append(f"held out: {', '.join(name for name, role in roles.items() if role == 'held_out')} (--held_out NAMES)")
    return said + summary + _contact_sheet(contact, filming) + _next_commands(out)


def _check_options(name: str, chosen: str, *groups: tuple[tuple[str, ...], Mapping[str, object]]) -> None:
    """Raise UserError if an option is given that is not for this kind of data.

    Args:
        name: Name of the first file.
        chosen: Kind of the data, a key of `WHAT`.
        groups: Kinds of data, and the options that are for these alone.
    """
    for kinds, options in groups:
        wrong = next((option for option, value in options.items() if value is not None and value is not False), None)
        if wrong is not None and chosen not in kinds:
            others = " or ".join(dict.fromkeys(WHAT[kind] for kind in kinds))
            other = "" if chosen in ("film", "views") else ", or give --kind"
            raise UserError(f"--{wrong} is for {others}, and {name} holds {WHAT[chosen]}: leave it out{other}")


def _next_commands(out: str | os.PathLike | None) -> list[str]:
    if out is None:
        return []
    folder, answer = shlex.quote(str(out)), shlex.quote(f"{out}-answer")
    return [f"next: neuido check {folder}; neuido diagnose {folder} --out {answer}"]


def _contact_sheet(contact: "Sheet | None", filming: Filming) -> list[str]:
    """Write the contact sheet of videos if the user wants one; return the line of the summary."""
    if contact is None or filming.picture is None:
        return []
    contact.write(Path(filming.picture).expanduser())
    return [f"contact sheet in {filming.picture}"]


def _kind(path: Path, columns: Mapping[str, str]) -> str:
    """Detect what a file contains; return `material`, `track`, `body` or `field`."""
    if path.suffix.lower() in BINARY:
        return "field"
    if path.suffix.lower() in (".c3d", ".trc", ".h5", ".hdf5"):
        return "track"
    rows, _ = read_cells(path)
    if layout_of_rows(rows):
        return "track"
    table = read_titled(path)
    if layout_of(table.titles) is not None:
        return "field"
    found = find_columns(table.titles, dict(columns), table.units)
    if {"time", "frame"} & set(found):
        if {"x", "y", "z"} & set(found):
            return "body" if {"id", "x", "y", "z"} <= set(found) and _named_rows(table, found["id"]) > 1 else "track"
        if named_points(table.titles):
            return "track"
        if "angle" in found and not {"force", "displacement", "nominal_stress", "shear_stress"} & set(found):
            return "track"
        if "displacement" in found and set(found) <= {"time", "frame", "displacement", "recording", "rate"}:
            unknown = [i for i, title in enumerate(table.titles) if i not in found.values() and np.isfinite(table.data[:, i]).any()]
            return "track" if not unknown else "material"  # an unknown column may be the force
    elif named_points(table.titles) and not {"force", "nominal_stress", "shear_stress"} & set(found):
        return "track"
    return "material"


def _named_rows(table: Table, column: int) -> int:
    """Return the number of different entries of a column."""
    return len({row[column] for row in table.cells if column < len(row) and row[column]})
