"""Displacements of the nodes of a mesh, its elements, and reaction forces become a folder of a plane specimen."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import yaml

from neuido.data.files.delimited import read_delimited
from neuido.data.files.parsing import naming
from neuido.data.files.writing import write_text
from neuido.data.formats.layout import natural_key
from neuido.data.importers.machines.material_folder import Material
from neuido.data.importers.tables.checked_folder import write_checked
from neuido.data.importers.tables.titles import bare_title
from neuido.data.importers.tables.units import conversion_factor, parse_quantity
from neuido.data.measured.columns import optional_numbers
from neuido.data.measured.plane_experiment import AXES, Boundary, read_plane_experiment, stiffness_ratio, triangles_of
from neuido.errors import UserError
from neuido.physics.plane.plane_specimen import CONDITIONS, PlaneSpecimen

MARKS = {"x": ("boundary_x", "bcx", "bc_x", "set_x"), "y": ("boundary_y", "bcy", "bc_y", "set_y")}
"""Titles of the columns that name the part of the boundary of a node."""
MOVES = {"x": ("ux", "u_x", "u", "displacement_x"), "y": ("uy", "u_y", "v", "displacement_y")}
"""Titles of displacements."""
POISSON = 0.3
"""Poisson's ratio that is declared where none is given; it is fitted."""


class Columns(NamedTuple):
    """A text table: the cells of each column by its title in small letters, and the unit that stands in the title."""

    cells: dict[str, list[str]]
    units: dict[str, str]

    def numbers(self, title: str) -> np.ndarray:
        """Return a column as numbers, (n,).

        Raises:
            UserError: A cell is neither a number nor empty.
        """
        return optional_numbers(self.cells[title], lambda i: f"data row {i}, {title}")

    def first(self, titles: Sequence[str]) -> str | None:
        """Return the first of several titles that the table has."""
        return next((title for title in titles if title in self.cells), None)


def write_plane_folder(
    files: Mapping[str, Path],
    out: str | os.PathLike | None,
    *,
    elements: str,
    forces: str | None,
    units: Mapping[str, str],
    thickness: str | None,
    condition: str | None,
    material: Material,
    held_out: Sequence[str],
) -> list[str]:
    """Write load steps of a flat specimen as a folder of `neuido-plane/1`; return the lines of the summary.

    Args:
        files: Tables by name, in order of their names: of each load step the displacements of the nodes (ux, uy), and in the first one or
            in a table of their own the places (x, y) and the parts of the boundary (boundary_x, boundary_y or bcx, bcy; empty or 0: free).
        out: The folder to create. None: check the content and write nothing.
        elements: Table of the nodes of the elements, three or four a row.
        forces: Table of the forces on the parts of the boundary, a row a load step; or with `*` one file a load step, a row a part
            in the order of their names.
        units: Unit of `displacement` (of places too) and of `force`, where the titles have none.
        thickness: Of the specimen, with its unit.
        condition: Plane `strain` or `stress`.
        material: The declared material.
        held_out: Names of the files of load steps that are only scored; the later half of several where empty.

    Raises:
        UserError: A table cannot be read, or something is missing.
    """
    if thickness is None:
        raise UserError("a plane specimen needs its thickness: give --thickness with its unit, as '2 mm'")
    if condition not in CONDITIONS:
        raise UserError(f"--condition {condition} must be stress (a thin specimen) or strain (a thick one, or one held between plates)")
    if material.density is not None:
        raise UserError("--density has no part in a quasi-static specimen: leave it out")
    tables = {name: _columns(path) for name, path in sorted(files.items(), key=lambda item: natural_key(item[1].name))}
    steps = {name: table for name, table in tables.items() if table.first(MOVES["x"]) and table.first(MOVES["y"])}
    placed = next((name for name, table in tables.items() if {"x", "y"} <= set(table.cells)), None)
    if placed is None or not steps:
        what = "places of the nodes (x, y)" if placed is None else "displacements of the nodes (ux, uy)"
        raise UserError(f"no file has {what}: {', '.join(tables)}")
    with naming(files[placed]):
        factor, notes = _length(tables[placed], units)
        x = factor * np.stack([tables[placed].numbers(a) for a in AXES], 1)
        marks = {a: _marks(tables[placed], a, len(x)) for a in AXES}
    moved = []
    for name, table in steps.items():
        with naming(files[name]):
            u = factor * np.stack([table.numbers(str(table.first(MOVES[a]))) for a in AXES], 1)
            if len(u) != len(x):
                raise UserError(f"{len(u)} rows, and there are {len(x)} nodes: give a row each, in their order")
            moved.append(u)
    corners = _elements(elements, tables[placed])
    parts = [
        Boundary(f"{name}_{a}", axis, np.flatnonzero(np.array(marks[a]) == name), "measured")
        for axis, a in enumerate(AXES)
        for name in dict.fromkeys(filter(None, marks[a]))
    ]
    parts.sort(key=lambda part: natural_key(part.name))
    if not parts:
        raise UserError(f"{placed}: no node belongs to the boundary: name in columns boundary_x and boundary_y the part that moves it")
    force = None if forces is None else _forces(forces, len(steps), [part.name for part in parts], units)
    roles = _roles(list(steps), held_out)
    notes += [f"{len(x)} nodes, {len(corners)} elements, {len(steps)} load steps, plane {condition}",
              f"moved as measured: {', '.join(f'{part.name} ({len(part.nodes)} nodes)' for part in parts)}"]  # fmt: skip
    deep, poisson = parse_quantity(thickness, "m", "thickness"), POISSON if material.poisson is None else material.poisson
    young = material.young
    if young is None:
        young, words = _young(x, corners, deep, condition, parts, moved, force, poisson)
        notes.append(words)
    free = ["young", "poisson"] if force is not None else ["poisson"]
    content: dict[str, Any] = {"format": "neuido-plane/1", "name": next(iter(files))}
    content["model"] = {"elasticity": {"law": "neo_hookean", "young": float(f"{young:.4g}"), "poisson": poisson}, "free": free}
    content["specimen"] = {"nodes": "nodes.csv", "elements": "elements.csv", "thickness": deep, "condition": condition}
    content["recordings"] = []
    for role in ("fit", "held_out"):
        own = [name for name in steps if roles[name] == role]
        if own:
            entry: dict[str, Any] = {"name": role, "role": role, "displacements": [f"{name}.csv" for name in own]}
            content["recordings"].append(entry | ({"forces": f"forces_{role}.csv"} if force is not None else {}))
    if list(roles.values()) == sorted(roles.values()) and len(content["recordings"]) > 1:
        content["recordings"][1]["continues"] = "fit"  # all load steps to fit come first
    held = [name for name, role in roles.items() if role == "held_out"]
    notes.append(f"held out: {', '.join(held)} (--held_out NAMES)" if held else "no load step is held out (--held_out NAMES)")

    def fill(folder: Path) -> None:
        _write(folder / "nodes.csv", ("x", "y", "boundary_x", "boundary_y"), zip(*x.T.tolist(), marks["x"], marks["y"]))
        titles = tuple(f"node{i + 1}" for i in range(corners.shape[1]))
        _write(folder / "elements.csv", titles, (["" if np.isnan(node) else int(node) for node in row] for row in corners))
        for name, u in zip(steps, moved):
            _write(folder / f"{name}.csv", ("ux", "uy"), u.tolist())
        for entry in content["recordings"]:
            if force is not None:
                rows = [row for row, name in zip(force.tolist(), steps) if roles[name] == entry["role"]]
                kept = [i for i in range(len(parts)) if np.isfinite(force[:, i]).any()]
                _write(folder / entry["forces"], tuple(parts[i].name for i in kept), [[row[i] for i in kept] for row in rows])
        write_text(folder / "plane.yaml", yaml.safe_dump(content, sort_keys=False, default_flow_style=None))

    return notes + write_checked(out, fill, read_plane_experiment)


def _columns(path: Path) -> Columns:
    table = read_delimited(path)
    if len(table.rows) < 2:
        raise UserError(f"{path} has no rows below its titles")
    titles = [bare_title(cell).lower().replace(" ", "_") for cell in table.rows[0]]
    units = {
        title: cell.partition("[")[2].partition("]")[0] or cell.partition("(")[2].partition(")")[0]
        for title, cell in zip(titles, table.rows[0])
    }
    cells = {title: [row[i].strip() if i < len(row) else "" for row in table.rows[1:]] for i, title in enumerate(titles)}
    return Columns(cells, {title: unit.strip() for title, unit in units.items()})


def _length(table: Columns, units: Mapping[str, str]) -> tuple[float, list[str]]:
    """Return the factor from the unit of places and displacements to m, with a note."""
    unit = units.get("displacement") or table.units["x"]
    if not unit:
        raise UserError("places and displacements have no unit: give --units.displacement mm")
    return conversion_factor(unit, "m", "--units.displacement"), [f"places and displacements in {unit}"]


def _marks(table: Columns, axis: str, count: int) -> list[str]:
    title = table.first(MARKS[axis])
    return [""] * count if title is None else ["" if cell in ("0", "0.0") else cell for cell in table.cells[title]]


def _elements(file: str, nodes: Columns) -> np.ndarray:
    """Return the nodes of each element, counted from 0, (n, 3) or (n, 4); NaN where there is no fourth."""
    path = Path(file).expanduser()
    with naming(path):
        table = _columns(path)
        titles = [title for title in table.cells if title.startswith(("node", "n"))][:4]
        if len(titles) < 3:
            raise UserError(f"no columns node1, node2, node3 of the elements (titles: {', '.join(table.cells)[:120]})")
        values = np.stack([table.numbers(title) for title in titles], 1)
        known = nodes.numbers("id") if "id" in nodes.cells else np.arange(len(nodes.cells["x"])) + (1 if np.nanmin(values) >= 1 else 0)
        number = {int(name): i for i, name in enumerate(known)}
        out = np.full(values.shape, np.nan)
        for i, row in enumerate(values):
            own = row[np.isfinite(row)]
            lost = next((int(value) for value in own if int(value) not in number), None)
            if len(own) < 3 or lost is not None:
                raise UserError(f"element {i} names {'too few nodes' if lost is None else f'the node {lost}, which is not there'}")
            out[i, : len(own)] = [number[int(value)] for value in own]
        return out[:, np.isfinite(out).any(0)]


def _forces(file: str, steps: int, parts: Sequence[str], units: Mapping[str, str]) -> np.ndarray:
    """Return the force on each part of the boundary in each load step [N], (T, B)."""
    path = Path(file).expanduser()
    if "*" in path.name:
        found = sorted(path.parent.glob(path.name), key=lambda own: natural_key(own.name))
        if len(found) != steps:
            raise UserError(f"--forces {file} finds {len(found)} files and there are {steps} load steps: give a file each")
        rows, unit = [], ""
        for own in found:
            with naming(own):
                table = _columns(own)
                title = next(iter(table.cells))
                values, unit = table.numbers(title), unit or table.units[title]
                if len(values) != len(parts):
                    raise UserError(f"{len(values)} rows, and there are {len(parts)} parts of the boundary: {', '.join(parts)}")
                rows.append(values)
        force = np.stack(rows)
    else:
        with naming(path):
            table = _columns(path)
            named = {part: table.first((part, part.rpartition("_")[0])) for part in parts}
            if not any(named.values()):
                raise UserError(f"--forces has no column of a part of the boundary: title them {', '.join(parts)}")
            unit = next(table.units[title] for title in named.values() if title)
            force = np.stack([table.numbers(t) if t else np.full(steps, np.nan) for t in named.values()], 1) if all(
                len(table.cells[t]) == steps for t in named.values() if t) else np.empty((0, 0))  # fmt: skip
            if not force.size:
                raise UserError(f"--forces must have a row a load step, and there are {steps} of them")
    unit = units.get("force") or unit
    if not unit:
        raise UserError("the forces have no unit: give --units.force N")
    return force * conversion_factor(unit, "N", "--units.force")


def _roles(names: Sequence[str], held_out: Sequence[str]) -> dict[str, str]:
    if unknown := [name for name in held_out if name not in names]:
        raise UserError(f"--held_out has the unknown load step {unknown[0]!r}: choose from {', '.join(names)}")
    held = set(held_out) or set(names[(len(names) + 1) // 2 :])
    if len(held) == len(names):
        raise UserError("--held_out lists every load step: leave at least one to fit")
    return {name: "held_out" if name in held else "fit" for name in names}


def _young(
    x: np.ndarray,
    corners: np.ndarray,
    thickness: float,
    condition: str,
    parts: Sequence[Boundary],
    moved: Sequence[np.ndarray],
    force: np.ndarray | None,
    poisson: float,
) -> tuple[float, str]:
    """Return Young's modulus that the first load step with forces shows [Pa], with a note."""
    if force is None:
        return 1e6, "no forces (--forces): Young's modulus has no part in the displacements, 1 MPa is declared"
    specimen = PlaneSpecimen(torch.from_numpy(x), torch.from_numpy(triangles_of(corners)), thickness, condition)
    for u, own in zip(moved, force):
        ratio = stiffness_ratio(specimen, parts, u, own, {"young": 1.0, "poisson": poisson}) if np.isfinite(own).any() else None
        if ratio is not None and ratio > 0:
            return (
                ratio,
                f"declared: neo-Hookean, Young's modulus {ratio:.3g} Pa from the work of the forces (--young), Poisson's ratio {poisson}",
            )
    raise UserError("the forces work against the motion, or tell no modulus: check their signs, or give --young (Pa)")


def _write(path: Path, titles: Sequence[str], rows: Any) -> None:
    """Write a CSV file."""
    write_text(path, "\n".join([",".join(titles), *(",".join(str(cell) for cell in row) for row in rows)]) + "\n")
