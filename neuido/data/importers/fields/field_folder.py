"""A full field in a uniform region and the force at each image become a material test; fields with gradients are refused."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from neuido.data.files.parsing import naming
from neuido.data.formats.layout import natural_key
from neuido.data.importers.fields.field_exports import Field, read_fields
from neuido.data.importers.machines.material_folder import Material, declared_model, modulus
from neuido.data.importers.machines.testing_machine import Specimen
from neuido.data.importers.tables.checked_folder import write_tables
from neuido.data.importers.tables.titled_tables import read_titled
from neuido.data.importers.tables.titles import find_columns
from neuido.data.importers.tables.units import conversion_factor, parse_quantity
from neuido.errors import UserError

UNIFORM = 0.05
"""Largest deviation from a uniform strain, relative to the elongation of the region, at which a mean strain stands for the specimen."""
SHEARED = 0.1
"""Largest shear relative to the largest strain at which a specimen counts as pulled along an axis."""


def write_field_test(
    files: Mapping[str, Path],
    out: str | os.PathLike | None,
    *,
    forces: str | None,
    region: Sequence[float] | None,
    columns: dict[str, str],
    units: Mapping[str, str],
    specimen: Specimen,
    material: Material,
) -> list[str]:
    """Write the images of one pulled or pressed specimen as a material test; return the lines of the summary.

    The stretch is that of the affine motion that fits the points best, along the axis x or y that is strained most.

    Args:
        files: The files by name, one an image or all images in one; in order of their names.
        out: The folder to create. None: check the content and write nothing.
        forces: File of a table with the force at each image.
        region: Smallest x, largest x, smallest y, largest y of the points to use, in the unit of the files; None: all.
        columns, units: Titles and units of the table of forces.
        specimen: Width and thickness, or diameter, of the specimen.
        material: The declared material.

    Raises:
        UserError: A file cannot be read, the strain is not uniform, or force or cross-section are missing.
    """
    from neuido.data.measured.material_test import read_material_tests

    fields: list[Field] = []
    found = []
    sources: list[Path] = []
    for path in sorted(files.values(), key=lambda path: natural_key(path.name)):
        with naming(path):
            own = [_within(field, region) for field in read_fields(path)]
            found += [_affine(field)[0] for field in own]
        fields += own
        sources += [path] * len(own)
    gradients = np.array(found)
    strain = gradients - np.eye(2)
    last = int(np.argmax(np.abs(strain).max(axis=(1, 2))))
    axis = int(np.argmax(np.abs(np.diagonal(strain[last]))))
    with naming(sources[last]):
        _check_uniform(fields[last], gradients[last], axis)
    stretch = np.linalg.norm(gradients[:, :, axis], axis=1)
    across = np.linalg.norm(gradients[:, :, 1 - axis], axis=1)
    count = np.median([len(field.x) for field in fields])
    notes = [
        f"full field of {fields[0].layout}: {len(fields)} images of {count:g} points, strained along {'xy'[axis]} up to {stretch[last]:.4g}"
    ]
    if abs(stretch[last] - 1) > 1e-9:
        ratio = -np.log(across[last]) / np.log(stretch[last])
        notes.append(f"transverse over axial logarithmic strain {ratio:.3g}: --poisson {ratio:.2g} declares it")
    force, time = _forces(forces, len(fields), columns, units, notes)
    test = {**({"time": time - time[0]} if time is not None else {}), "stretch": stretch, "nominal_stress": force / _section(specimen)}
    secant = modulus({key: values for key, values in test.items() if key != "time"})
    model, words = declared_model(material, [secant])
    name = next(iter(files))
    entry = {"name": name, "file": f"{name}.csv", "mode": "uniaxial", "columns": {key: key for key in test}, "role": "fit"}
    content = {"format": "neuido-material-test/1", "name": name, "model": model, "tests": [entry]}
    return notes + words + write_tables(out, "test.yaml", content, {name: test}, read_material_tests)


def _within(field: Field, region: Sequence[float] | None) -> Field:
    if region is None:
        return field
    if len(region) != 4 or not (region[0] < region[1] and region[2] < region[3]):
        raise UserError(f"--region {list(region)} must be the smallest x, largest x, smallest y and largest y")
    kept = (field.x[:, 0] >= region[0]) & (field.x[:, 0] <= region[1]) & (field.x[:, 1] >= region[2]) & (field.x[:, 1] <= region[3])
    if kept.sum() < 4:
        (left, low), (right, high) = field.x[:, :2].min(axis=0), field.x[:, :2].max(axis=0)
        raise UserError(f"--region {list(region)} has {kept.sum()} points; they lie in x {left:g} to {right:g} and y {low:g} to {high:g}")
    return field._replace(x=field.x[kept], u=field.u[kept])


def _affine(field: Field) -> tuple[np.ndarray, np.ndarray]:
    """Return the deformation gradient (2, 2) of the best affine motion in the plane, and what it leaves of the displacements (n, 2)."""
    x = field.x[:, :2] - field.x[:, :2].mean(axis=0)
    basis = np.concatenate([np.ones((len(x), 1)), x], 1)
    if np.linalg.matrix_rank(x) < 2:
        raise UserError("the points of an image lie on one line and tell no strain in the plane")
    found = np.linalg.lstsq(basis, field.u[:, :2], rcond=None)[0]
    return np.eye(2) + found[1:].T, field.u[:, :2] - basis @ found


def _check_uniform(field: Field, gradient: np.ndarray, axis: int) -> None:
    elongation = abs(gradient[axis, axis] - 1) * float(np.ptp(field.x[:, axis]))
    left = float(np.sqrt(np.mean(np.sum(_affine(field)[1] ** 2, axis=1))))
    if not elongation > 0:
        raise UserError("no image shows a strain: are these displacements, and not strains or coordinates?")
    if left > UNIFORM * elongation:
        raise UserError(
            f"the strain is not uniform: displacements differ from it by {left / elongation:.0%} of the elongation, more than "
            f"{UNIFORM:.0%}; for gradients (a hole, a notch) give the mesh (--elements), or choose a uniform part (--region)"
        )
    strain = (gradient + gradient.T) / 2 - np.eye(2)
    shear = abs(strain[0, 1] / strain[axis, axis])
    if shear > SHEARED:
        raise UserError(f"the specimen is sheared by {shear:.0%} of its largest strain: turn the axes of the export along the load")


def _forces(
    file: str | None, count: int, columns: dict[str, str], units: Mapping[str, str], notes: list[str]
) -> tuple[np.ndarray, np.ndarray | None]:
    """Read the force [N] at each image and its time [s], if the table has it."""
    if file is None:
        raise UserError("a full field needs the force at each image: give --forces FILE, a table with one row per image")
    path = Path(file).expanduser()
    if not path.is_file():
        raise UserError(f"--forces {path} is missing" if not path.exists() else f"--forces {path} is not a file")
    with naming(path):
        table = read_titled(path)
        found = find_columns(table.titles, columns)
        if "force" not in found:
            raise UserError(
                f"{path.name} has no force: name its column with --columns.force TITLE (titles: {', '.join(table.titles)[:150]})"
            )
        if len(table.data) != count:
            raise UserError(
                f"{path.name} has {len(table.data)} rows and there are {count} images: give one row per image, the first included"
            )
        out = {}
        for quantity, unit in (("force", "N"), ("time", "s")):
            if quantity not in found:
                continue
            own = units.get(quantity) or table.units[found[quantity]]
            if not own and quantity == "force":
                raise UserError(f"column {table.titles[found[quantity]]!r} has no unit: give --units.force N")
            values = table.data[:, found[quantity]] * (conversion_factor(own, unit, f"--units.{quantity}") if own else 1.0)
            if not np.isfinite(values).all():
                raise UserError(f"row {int(np.argmax(~np.isfinite(values)))} has no {quantity}: each image needs one")
            notes.append(f"{path.name}: column {table.titles[found[quantity]]!r} -> {quantity}, {own or unit}")
            out[quantity] = values
    return out["force"], out.get("time")


def _section(specimen: Specimen) -> float:
    """Return the cross-section [m^2]."""
    if specimen.diameter is not None:
        return np.pi / 4 * parse_quantity(specimen.diameter, "m", "section_diameter") ** 2
    if specimen.width is None or specimen.thickness is None:
        raise UserError("a force needs the cross-section: give --width and --thickness with their units, as '10 mm'")
    return parse_quantity(specimen.width, "m", "width") * parse_quantity(specimen.thickness, "m", "thickness")
