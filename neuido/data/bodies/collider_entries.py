"""Solid colliders from the entries of a scene file, and mesh colliders from mesh files."""

import os
from collections.abc import Callable, Mapping
from typing import Any

from neuido.data.bodies.mesh_files import read_mesh
from neuido.data.files.values import check_keys, number, vector
from neuido.errors import UserError, suggest
from neuido.physics.colliders.solids import Capsule, Cuboid, Cylinder, HalfSpace, HeightField, MeshCollider, Sphere
from neuido.types import Keyframes, Solid

SHARED = ("kind", "name", "position", "rotation", "contact", "friction", "velocity", "spin", "path", "mass", "inertia", "restitution")
OWN: dict[str, tuple[type[Solid], tuple[str, ...], tuple[str, ...]]] = {
    "half_space": (HalfSpace, (), ()),
    "sphere": (Sphere, ("radius",), ()),
    "cuboid": (Cuboid, ("size",), ()),
    "capsule": (Capsule, ("radius", "length"), ()),
    "cylinder": (Cylinder, ("radius", "length"), ()),
    "height_field": (HeightField, ("heights", "size"), ()),
    "mesh": (MeshCollider, ("file",), ("scale", "up")),
}
"""Each kind of solid in a file: its class, and the keys that it needs and may have besides `SHARED`."""


def mesh_collider(file: str | os.PathLike, *, scale: float | None = None, up: str | None = None, **options: Any) -> MeshCollider:
    """Read a collider from a mesh file; it must be watertight.

    Args:
        file: An .obj, .stl, .ply, .glb or USD file.
        scale: Metres per unit of the file; by default what a USD file says, else 1.
        up: The axis of the file that points up: x, y or z; by default what a USD file says, else y.
        options: Position, rotation, contact, friction, motion, mass and name, as for every solid.

    Raises:
        UserError: The file cannot be read, the mesh is not watertight, or an option is impossible.
    """
    mesh = read_mesh(file, scale=scale, up=up)
    try:
        return MeshCollider(mesh.vertices, mesh.faces, **options)
    except UserError as error:
        raise UserError(f"{file}: {error}") from error


def solid_from_dict(given: Mapping[str, Any], where: str, find: Callable[[str, str], Any] | None) -> Solid:
    """Build a solid from an entry of `scene.colliders`.

    Args:
        given: The entry; `kind` says which.
        where: Name of the entry in error messages.
        find: Returns the path of a file that an entry names, from its text and the name of its key; None where files are not allowed.

    Raises:
        UserError: An unknown kind or key, a missing key, or a value outside its range.
    """
    kind = given.get("kind")
    if not isinstance(kind, str) or kind not in OWN:
        raise UserError(f"{where}.kind = {kind!r} is unknown{suggest(str(kind), OWN) or ':'} choose from plane, {', '.join(OWN)}")
    if find is None:
        raise UserError(f"{where} is a {kind}; here colliders are planes: scene files take the other kinds")
    made, needed, more = OWN[kind]
    check_keys(given, where, ("kind", *needed, *SHARED[1:], *more), (*SHARED[1:], *more))
    options: dict[str, Any] = {}
    for key in given:
        at = f"{where}.{key}"
        value = given[key]
        if key in ("position", "velocity", "spin") or (key == "size" and kind == "cuboid"):
            options[key] = vector(value, at)
        elif key in ("radius", "length", "mass"):
            options[key] = number(value, at, above=0.0)
        elif key == "restitution":
            options[key] = number(value, at, least=0.0)
        elif key == "friction":
            options[key] = number(value, at, least=0.0, infinite=True)
        elif key == "rotation":
            options[key] = _numbers(value, at, 4)
        elif key == "size":
            options[key] = _numbers(value, at, 2)
        elif key in ("name", "contact"):
            if not isinstance(value, str):
                raise UserError(f"{at} must be text, got {value!r}")
            options[key] = value
        elif key == "inertia":
            options[key] = tuple(_numbers(row, f"{at}[{i}]", 3) for i, row in enumerate(_list(value, at)))
        elif key == "path":
            options[key] = _path(value, at)
        elif key == "heights":
            options[key] = [[number(cell, at) for cell in _list(row, at)] for row in _list(value, at)]
            if len({len(row) for row in options[key]}) != 1:
                raise UserError(f"{at} has rows of different lengths")
    try:
        if kind == "mesh":
            scale = None if given.get("scale") is None else number(given["scale"], f"{where}.scale", above=0.0)
            file = given["file"]
            if not isinstance(file, str):
                raise UserError(f"file must be text, got {file!r}")
            return mesh_collider(find(file, f"{where}.file"), scale=scale, up=given.get("up"), **options)
        return made(**options)
    except UserError as error:
        raise UserError(str(error) if str(error).startswith(where) else f"{where}: {error}") from error


def _path(given: Any, where: str) -> Keyframes:
    """Build the motion of a collider from its entry `path`."""
    check_keys(given, where, ("times", "positions", "rotations", "smooth"), ("rotations", "smooth"))
    times = tuple(number(t, f"{where}.times") for t in _list(given["times"], f"{where}.times"))
    positions = tuple(vector(p, f"{where}.positions") for p in _list(given["positions"], f"{where}.positions"))
    rotations = given.get("rotations")
    if rotations is not None:
        rotations = tuple(_numbers(q, f"{where}.rotations", 4) for q in _list(rotations, f"{where}.rotations"))
    smooth = given.get("smooth", False)
    if not isinstance(smooth, bool):
        raise UserError(f"{where}.smooth must be true or false, got {smooth!r}")
    return Keyframes(times, positions, rotations, smooth)


def _list(given: Any, where: str) -> list:
    if not isinstance(given, list) or not given:
        raise UserError(f"{where} must be a list that is not empty, got {given!r}")
    return given


def _numbers(given: Any, where: str, count: int) -> tuple[float, ...]:
    if not isinstance(given, list) or len(given) != count:
        raise UserError(f"{where} must be {count} numbers, got {given!r}")
    return tuple(number(value, where) for value in given)
