"""Spring-Gaus' configurations (YAML): ground, gravity, frames and the box that the object lies in.

Its springs have constants a point, which give no modulus of a continuum: Young's modulus, Poisson's ratio and density come from options.
"""

from pathlib import Path
from typing import Any

import numpy as np

from neuido.data.files.parsing import read_yaml
from neuido.data.files.values import mapping, number, path_inside, vector
from neuido.data.neighbours import poses
from neuido.data.neighbours.neighbour_scene import NeighbourScene, Obstacle, Placement, SoftBody
from neuido.errors import UserError

ABOVE = 3
"""Folders above a configuration in which the file that its DEFAULT names, relative to the root of the code, is looked for."""


def is_springgaus(content: Any) -> bool:
    """Return whether a YAML content is a configuration of Spring-Gaus."""
    return isinstance(content, dict) and isinstance(content.get("DATA"), dict) and "BC" in content["DATA"]


def read_springgaus(path: Path) -> tuple[NeighbourScene, Placement]:
    """Read a configuration.

    Returns:
        The scene, whose one body has neither mesh nor particles yet, and the placement of its Gaussians.

    Raises:
        UserError: The file that DEFAULT names is missing, or a value is of the wrong type or out of its range.
    """
    content = read_yaml(path)
    if not is_springgaus(content):
        raise UserError(f"{path} is not a configuration of Spring-Gaus: it lacks DATA.BC")
    base = _default(path, content.get("DEFAULT"))
    data = {**mapping(base.get("DATA", {}), "DATA"), **mapping(content["DATA"], "DATA")}
    motion = {**mapping(base.get("VELOCITY", {}), "VELOCITY"), **mapping(content.get("VELOCITY", {}), "VELOCITY")}
    motion |= {**mapping(base.get("DYNAMIC", {}), "DYNAMIC"), **mapping(content.get("DYNAMIC", {}), "DYNAMIC")}
    scene = NeighbourScene(str(data.get("OBJ_NAME", path.stem))[:80], f"{path.name} (Spring-Gaus)")
    gravity = vector(motion.get("G", [0.0, -9.8, 0.0]), f"{path}: G")
    ground = data["BC"]
    if not isinstance(ground, list) or not ground or not all(isinstance(each, list) and len(each) == 2 for each in ground):
        raise UserError(f"{path}: DATA.BC must be a list of [point, normal]")
    planes = [(np.array(vector(p, f"{path}: DATA.BC")), np.array(vector(n, f"{path}: DATA.BC"))) for p, n in ground]
    if any(not np.linalg.norm(normal) > 0 for _, normal in planes):
        raise UserError(f"{path}: a normal in DATA.BC is zero")
    turn = poses.turn_between(planes[0][1].tolist(), (0, 1, 0))
    for point, normal in planes:
        scene.obstacles.append(
            Obstacle("plane", f"ground {len(scene.obstacles)}", turn @ point, poses.turn_between((0, 1, 0), (turn @ normal).tolist()))
        )
    scene.gravity = tuple((turn @ gravity).tolist())  # type: ignore[assignment]
    if np.abs(turn - np.eye(3)).max() > 1e-9:
        scene.note(str(path), f"turned so that the normal of the ground, {planes[0][1].tolist()}, points up")
    frequency = data.get("FREQ")
    interval = number(data.get("DT", 1 / 60), f"{path}: DATA.DT", above=0.0)
    if frequency is not None:
        interval = 1 / number(frequency, f"{path}: DATA.FREQ", above=0.0)
    substeps = number(motion.get("N_STEP", 100), f"{path}: N_STEP", above=0.0)
    scene.dt = interval / substeps
    scene.steps = round(number(data.get("FRAME_ALL", data.get("N_FRAME", 30)), f"{path}: DATA.FRAME_ALL", above=0.0) * substeps)
    velocity = turn @ vector(motion.get("INIT_VELOCITY", [0.0, 0.0, 0.0]), f"{path}: INIT_VELOCITY")
    scene.bodies.append(SoftBody(scene.name, elasticity={"law": "neo_hookean"}, velocity=tuple(velocity.tolist())))  # type: ignore[arg-type]
    for key in ("GLOBAL_K", "GLOBAL_M", "GLOBAL_DAMP"):
        if key in data:
            scene.note(
                str(path), f"{key} = {data[key]} of the springs has no counterpart: --young, --poisson and --density say the material"
            )
    scene.note(str(path), "the factor by which the ground slows sliding is learned there: the ground is frictionless here")
    if "REGIST" in data:
        scene.note(str(path), "REGIST, which moves the Gaussians of the stills to the video, is not applied")
    area = None
    if "XYZ_MIN" in data and "XYZ_MAX" in data:
        low, high = (np.array(vector(data[key], f"{path}: DATA.{key}")) for key in ("XYZ_MIN", "XYZ_MAX"))
        if not (low < high).all():
            raise UserError(f"{path}: DATA.XYZ_MIN must be below DATA.XYZ_MAX on each axis")
        corners = low + np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * (high - low)
        corners = corners @ turn.T
        area = corners.min(axis=0), corners.max(axis=0)
    return scene, Placement(turn, area)


def _default(path: Path, named: Any) -> dict[str, Any]:
    """Return the content of the file that DEFAULT names, looked for in the folders above the configuration; nothing without the key."""
    if named is None:
        return {}
    for folder in list(path.resolve().parents)[: ABOVE + 1]:
        found = path_inside(folder, named, f"{path}: DEFAULT")
        if found.is_file():
            return read_yaml(found)
    raise UserError(f"{path}: DEFAULT = {named} is in none of the {ABOVE} folders above it")
