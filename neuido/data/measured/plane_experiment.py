"""Plane specimens: measured displacements of the nodes of a mesh and reaction forces, in the folder format `neuido-plane/1`."""

import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neuido.data.files.values import check_keys, file_name, mapping, number
from neuido.data.measured.columns import (
    errors_of,
    named_columns,
    read_effects,
    read_entries,
    read_free,
    read_header,
    read_role,
    read_text,
)
from neuido.data.measured.plausibility import MAX_UNIT_FACTOR, ODD_UNIT_FACTOR
from neuido.errors import PlausibilityWarning, UserError
from neuido.physics.plane.plane_law import EFFECTS, ENERGIES, PlaneLaw
from neuido.physics.plane.plane_specimen import CONDITIONS, PlaneSpecimen

FORMAT = "neuido-plane/1"
AXES = ("x", "y")
MOTIONS = ("measured", "rigid", "held")
"""Motions of a part of the boundary along one axis: each node as measured, all nodes alike by the mean of what was measured, or none."""
LAWS = tuple(ENERGIES)
MOST_MOVED = 3.0
"""Largest plausible displacement relative to the largest extent of the specimen."""
MOST_EXTENT = 100.0
"""Largest plausible extent of a specimen [m]."""
MOST_TURNED = 0.01
"""Largest share of the triangles that a measured motion may turn inside out: noise does that to few."""
BALANCE = 0.1
"""Largest sum of the forces along an axis, relative to the largest of them, that is not said: a machine is right within a few per cent."""


@dataclass(frozen=True, eq=False)
class Boundary:
    """A part of the boundary that is moved along one axis."""

    name: str
    """Name of the part with its axis, such as `right_x`."""
    axis: int
    """0 for x, 1 for y."""
    nodes: np.ndarray
    """Numbers of its nodes, (k,)."""
    motion: str
    """One of `MOTIONS`."""


@dataclass(frozen=True, eq=False)
class PlaneRecording:
    """Load steps of the specimen, one after the other."""

    name: str
    role: str
    """`fit`, or `held_out` (scored, never fitted)."""
    displacement: np.ndarray
    """Displacement of the nodes [m], (T, N, 2); NaN where it was not measured."""
    force: np.ndarray
    """Force that the surroundings exert on each part of the boundary, along its axis [N], (T, B); NaN where it was not measured."""
    displacement_noise: float | None = None
    """Stated standard deviation of the noise of a displacement [m]; None: to be estimated."""
    force_noise: float | None = None
    """Stated standard deviation of the error of a force [N]; None: that of a testing machine of class 1."""
    continues: str = ""
    """Name of the earlier recording in whose last state this one begins; empty: it begins at rest."""


@dataclass(frozen=True, eq=False)
class PlaneExperiment:
    """A flat specimen with its declared model and recordings."""

    name: str
    folder: Path
    model: dict[str, Any]
    """The declared model: `elasticity` with `law` (`LAWS`), `young` [Pa] and `poisson`."""
    free: tuple[str, ...]
    """The parameters of the model to fit; all others are taken as exact."""
    effects: dict[str, float]
    """Effects of the declared model by flat names, for example {"strain_stiffening.k": 0.01}."""
    specimen: PlaneSpecimen
    boundary: tuple[Boundary, ...]
    recordings: tuple[PlaneRecording, ...]

    @property
    def prescribed(self) -> np.ndarray:
        """Which displacements are prescribed, (N, 2)."""
        out = np.zeros(tuple(self.specimen.nodes.shape), dtype=bool)
        for part in self.boundary:
            out[part.nodes, part.axis] = True
        return out


def read_plane_experiment(path: str | os.PathLike, *, model: Mapping[str, Any] | None = None) -> PlaneExperiment:
    """Read a folder of a plane specimen, or its `plane.yaml`.

    Args:
        path: The folder or the file.
        model: Replaces the key `model` of the file.

    Raises:
        UserError: A key, law, column or file is unknown or missing, the mesh is none, the boundary does not hold the specimen, or values
            are implausible for their unit. The message names the file and the key.
    """
    file, content = read_header(Path(path), "plane.yaml", FORMAT)
    folder = file.parent
    with errors_of(file):
        check_keys(content, "the file", ("format", "name", "model", "specimen", "boundary", "recordings"), ("boundary",))
        name = read_text(content["name"], "name")
        declared, free, effects = _model(content["model"] if model is None else model)
        specimen, marks = _specimen(content["specimen"], folder)
        boundary = _boundary(content.get("boundary") or {}, marks)
        if {part.axis for part in boundary} != {0, 1} or sum(len(part.nodes) for part in boundary) < 3:
            raise UserError(
                "the specimen can move freely: name in boundary_x and boundary_y the nodes that are held or moved, at least three"
            )
        recordings = read_entries(
            content["recordings"], "recordings", "recording", lambda entry, where: _recording(entry, where, folder, specimen, boundary)
        )
        for n, recording in enumerate(recordings):
            if recording.continues and recording.continues not in (before := [r.name for r in recordings[:n]]):
                raise UserError(
                    f"recordings[{n}] ({recording.name}).continues = {recording.continues!r} must name an earlier recording: "
                    f"{', '.join(before) or 'there is none'}"
                )
        if not any(recording.role == "fit" for recording in recordings):
            raise UserError("recordings has no entry with role fit: give at least one")
        found = PlaneExperiment(name, folder, declared, free, effects, specimen, boundary, recordings)
        _check(found)
    return found


def _model(given: Any) -> tuple[dict[str, Any], tuple[str, ...], dict[str, float]]:
    given = mapping(given, "model")
    check_keys(given, "model", ("elasticity", "free", "effects"), ("free", "effects"))
    effects = read_effects(given.get("effects"), "model.effects", known=EFFECTS)
    law = mapping(given["elasticity"], "model.elasticity")
    check_keys(law, "model.elasticity", ("law", "young", "poisson"))
    for key in ("young", "poisson"):
        law[key] = number(law[key], f"model.elasticity.{key}")
    try:
        PlaneLaw(law)
    except UserError as error:
        raise UserError(f"model.{error}") from error
    free = read_free(given.get("free", []), ("young", "poisson"))
    if law["law"] != "linear" and any(key.startswith("geometric_nonlinearity") for key in effects):
        raise UserError(f"model.effects.geometric_nonlinearity: {law['law']} is a law of large deformation already: leave it out")
    return {"elasticity": law}, free, effects


def _specimen(given: Any, folder: Path) -> tuple[PlaneSpecimen, dict[str, list[str]]]:
    """Return the specimen, and by axis the name of the part of the boundary of each node (empty: free)."""
    check_keys(given, "specimen", ("nodes", "elements", "thickness", "condition"))
    nodes, texts = named_columns(folder, given["nodes"], "specimen.nodes", AXES, words=tuple(f"boundary_{a}" for a in AXES))
    elements, _ = named_columns(folder, given["elements"], "specimen.elements", ("node1", "node2", "node3"), ("node4",))
    corners = np.stack([elements[f"node{i}"] for i in (1, 2, 3)], 1)
    if "node4" in elements:
        corners = np.column_stack([corners, elements["node4"]])
    whole = corners[np.isfinite(corners)]
    if not np.isfinite(corners[:, :3]).all() or (whole != whole.round()).any() or (whole < 0).any():
        raise UserError(
            "specimen.elements: the nodes of an element must be whole numbers, counted from 0 in the order of the table of nodes"
        )
    thickness = number(given["thickness"], "specimen.thickness", above=0.0)
    if given["condition"] not in CONDITIONS:
        raise UserError(f"specimen.condition = {given['condition']!r} is unknown: choose from {', '.join(CONDITIONS)}")
    try:
        places = torch.from_numpy(np.stack([nodes[a] for a in AXES], 1))
        specimen = PlaneSpecimen(places, torch.from_numpy(triangles_of(corners)), thickness, given["condition"])
    except UserError as error:
        raise UserError(f"specimen: {error}") from error
    return specimen, {a: texts.get(f"boundary_{a}", [""] * len(places)) for a in AXES}


def triangles_of(elements: np.ndarray) -> np.ndarray:
    """Return the nodes of the triangles of elements, (E, 3); the second triangles of quadrilaterals follow all first ones.

    Args:
        elements: Nodes of the elements, (n, 3) or (n, 4); the fourth is NaN where an element is a triangle.
    """
    squares = elements[np.isfinite(elements).sum(1) == 4]
    return np.concatenate([elements[:, :3], squares[:, [0, 2, -1]]]).astype(int)


def _boundary(motions: Any, marks: Mapping[str, Sequence[str]]) -> tuple[Boundary, ...]:
    motions = mapping(motions, "boundary")
    found = []
    for axis, a in enumerate(AXES):
        names = [text.strip() for text in marks[a]]
        for name in dict.fromkeys(n for n in names if n and n != "0"):
            key = f"{file_name(name, f'boundary_{a}')}_{a}"
            found.append(Boundary(key, axis, np.flatnonzero(np.array(names) == name), motions.get(key, "measured")))
    known = [part.name for part in found]
    for key, value in motions.items():
        if key not in known:
            raise UserError(
                f"boundary.{key} is no part of the boundary: the columns boundary_x and boundary_y name {', '.join(known) or 'none'}"
            )
        if value not in MOTIONS:
            raise UserError(f"boundary.{key} = {value!r} is unknown: choose from {', '.join(MOTIONS)}")
    return tuple(found)


def _recording(entry: Any, where: str, folder: Path, specimen: PlaneSpecimen, boundary: Sequence[Boundary]) -> PlaneRecording:
    check_keys(entry, where, ("name", "role", "displacements", "forces", "noise", "continues"), ("forces", "noise", "continues"))
    name = file_name(entry["name"], f"{where}.name")
    where = f"{where} ({name})"
    role = read_role(entry["role"], where)
    files = entry["displacements"]
    if not isinstance(files, list) or not files:
        raise UserError(f"{where}.displacements must be a list of files, one a load step, got {files!r}")
    count, steps = len(specimen.nodes), []
    for i, given in enumerate(files):
        columns, _ = named_columns(folder, given, f"{where}.displacements[{i}]", ("ux", "uy"))
        if len(columns["ux"]) != count:
            raise UserError(
                f"{where}.displacements[{i}]: {given} has {len(columns['ux'])} rows and there are {count} nodes: give a row each"
            )
        steps.append(np.stack([columns["ux"], columns["uy"]], 1))
    force = np.full((len(files), len(boundary)), np.nan)
    if entry.get("forces") is not None:
        columns, _ = named_columns(folder, entry["forces"], f"{where}.forces", (), tuple(part.name for part in boundary))
        if not columns:
            names = ", ".join(part.name for part in boundary)
            raise UserError(f"{where}.forces: {entry['forces']} names no part of the boundary: title its columns {names}")
        for key, values in columns.items():
            if len(values) != len(files):
                raise UserError(
                    f"{where}.forces: {entry['forces']} has {len(values)} rows and there are {len(files)} load steps: give a row each"
                )
            force[:, [part.name for part in boundary].index(key)] = values
    noise = mapping(entry.get("noise") or {}, f"{where}.noise")
    check_keys(noise, f"{where}.noise", ("displacement", "force"), ("displacement", "force"))
    stated = {key: number(value, f"{where}.noise.{key}", above=0.0) for key, value in noise.items()}
    continues = read_text(entry["continues"], f"{where}.continues") if entry.get("continues") is not None else ""
    return PlaneRecording(name, role, np.stack(steps), force, stated.get("displacement"), stated.get("force"), continues)


def _check(found: PlaneExperiment) -> None:
    """Check that boundary, displacements and forces go together and are plausible."""
    x, fixed = found.specimen.nodes.numpy(), found.prescribed
    extent = float(np.ptp(x, axis=0).max())
    if extent > MOST_EXTENT:
        raise UserError(
            f"specimen.nodes: the specimen is {extent:g} m large: give places in m, not in mm or pixels (`neuido import` converts)"
        )
    for n, recording in enumerate(found.recordings):
        _check_recording(found, recording, f"recordings[{n}] ({recording.name})", x, fixed, extent)
    if "young" in found.free and not any(np.isfinite(r.force).any() for r in found.recordings if r.role == "fit"):
        raise UserError("model.free: young changes no displacement here, and no recording to fit has forces: leave it out, or give forces")


def _check_recording(
    found: PlaneExperiment, recording: PlaneRecording, where: str, x: np.ndarray, fixed: np.ndarray, extent: float
) -> None:
    u, force = recording.displacement, recording.force
    for part in found.boundary:
        own = u[:, part.nodes, part.axis]
        lacking = ~np.isfinite(own) if part.motion == "measured" else ~np.isfinite(own).any(1, keepdims=True)
        if part.motion != "held" and lacking.any():
            step, node = np.argwhere(np.broadcast_to(lacking, own.shape))[0]
            raise UserError(
                f"{where}: node {part.nodes[node]} of {part.name} has no displacement in load step {step}: give it, or set "
                f"boundary.{part.name} to rigid or held"
            )
    if not (np.isfinite(u) & ~fixed).any():
        raise UserError(f"{where}: no node that may move has a displacement: the boundary must leave some free")
    largest = np.nanmax(np.abs(u), axis=(1, 2))
    if not largest.any():
        raise UserError(f"{where}: all displacements are zero: name the right columns")
    if largest.max() > MOST_MOVED * extent:
        raise UserError(
            f"{where}: a node moves by {largest.max():g} m in load step {int(largest.argmax())}, and the specimen is {extent:g} m large: "
            "give both in m, and displacements, not places"
        )
    for step, moved in enumerate(u):
        whole = np.isfinite(moved).all(1)[found.specimen.triangles.numpy()].all(1)
        F = found.specimen.gradient(torch.from_numpy(moved)).numpy()[whole]
        turned = np.flatnonzero(F[:, 0] * F[:, 3] - F[:, 1] * F[:, 2] <= 0)
        if len(turned) > max(MOST_TURNED * len(F), 1):
            raise UserError(
                f"{where}: load step {step} turns {len(turned)} of {len(F)} triangles inside out, the first is "
                f"{np.flatnonzero(whole)[turned[0]]}: are the rows in the order of the nodes, and the displacements in m?"
            )
    given = force[np.isfinite(force)]
    if not len(given):
        return
    if not given.any():
        raise UserError(f"{where}: all forces are zero: name the right columns of {', '.join(p.name for p in found.boundary)}")
    _check_forces(found, recording, where)


def _check_forces(found: PlaneExperiment, recording: PlaneRecording, where: str) -> None:
    """Check sign, unit and balance of the forces."""
    force = recording.force
    last = int(np.nanargmax(np.abs(force))) // force.shape[1]
    for axis, a in enumerate(AXES):
        own = [i for i, part in enumerate(found.boundary) if part.axis == axis]
        if len(own) > 1 and np.isfinite(force[last, own]).all() and np.abs(force[last, own]).max() > 0:
            rest = abs(float(force[last, own].sum())) / float(np.abs(force[last, own]).max())
            if rest > BALANCE:
                warnings.warn(
                    f"{where}: the forces along {a} in load step {last} add up to {rest:.0%} of the largest, and not to zero",
                    PlausibilityWarning,
                    stacklevel=2,
                )
    if recording.continues:
        return  # what has yielded leaves forces against the motion from rest
    ratio = stiffness_ratio(found.specimen, found.boundary, recording.displacement[last], force[last], found.model["elasticity"])
    if ratio is None:
        return
    if ratio < 0 and -ratio > 1 / ODD_UNIT_FACTOR:
        raise UserError(
            f"{where}: the forces of load step {last} work against the motion: a force is that of the surroundings on the specimen along "
            "+x or +y, so that a pull at the right is positive and at the left negative"
        )
    shown = f"{where}: force and motion of load step {last} show a stiffness {{}} times that declared (young): check the units (N, m)"
    factor = max(abs(ratio), 1 / abs(ratio))
    if factor > MAX_UNIT_FACTOR:
        raise UserError(shown.format(f"{abs(ratio):.3g}"))
    if factor > ODD_UNIT_FACTOR:
        warnings.warn(shown.format(f"{abs(ratio):.3g}"), PlausibilityWarning, stacklevel=2)


def stiffness_ratio(
    specimen: PlaneSpecimen, boundary: Sequence[Boundary], displacement: np.ndarray, force: np.ndarray, elasticity: Mapping[str, Any]
) -> float | None:
    """Return the ratio of the stiffness that force and motion of a load step show to that of small-strain elasticity.

    It is the work of the forces over the strain energy, and negative where the forces work against the motion. A part without a force
    carries what the others of its axis leave.

    Args:
        specimen: The specimen.
        boundary: The parts of its boundary.
        displacement: Displacements of the nodes [m], (N, 2).
        force: Force on each part of the boundary along its axis [N], (B,); NaN where it was not measured.
        elasticity: `young` [Pa] and `poisson`.

    Returns:
        The ratio; None where displacements are missing or no force works.
    """
    if not np.isfinite(displacement).all():
        return None
    moved = [0.0 if part.motion == "held" else float(displacement[part.nodes, part.axis].mean()) for part in boundary]
    work = 0.0
    for axis in (0, 1):
        own = [i for i, part in enumerate(boundary) if part.axis == axis]
        against = [moved[i] for i in own if not np.isfinite(force[i])]
        work += sum(float(force[i]) * (moved[i] - (float(np.mean(against)) if against else 0.0)) for i in own if np.isfinite(force[i])) / 2
    law = PlaneLaw(dict(elasticity) | {"law": "linear"})
    F = specimen.whole(law, specimen.gradient(torch.from_numpy(displacement)))
    energy = float((law.energy(F.unbind(1)) * specimen.thickness * specimen.areas).sum())  # type: ignore[arg-type, attr-defined]
    return work / energy if energy > 0 and work else None
