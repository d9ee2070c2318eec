"""PhysGaussian's scene configurations (JSON): material, grid, time steps, boundary conditions, and how the Gaussians are placed.

Its simulation runs in a cube from 0 to `grid_lim` with the body scaled to unit length around (1, 1, 1) and +z up. Here the cube is kept,
turned to +y up: (x, y, z) becomes (x, z, grid_lim - y).
"""

import math
from pathlib import Path
from typing import Any

import numpy as np

from neuido.data.files.parsing import read_json
from neuido.data.files.values import mapping, number, vector
from neuido.data.neighbours import poses
from neuido.data.neighbours.neighbour_scene import NeighbourScene, Obstacle, Placement, SoftBody
from neuido.errors import UserError, suggest

PADDING = 3.0
"""Cells between the faces of the domain and the walls of `bounding_box`."""
LAWS = {
    "jelly": ({"law": "fixed_corotated"}, None),
    "metal": ({"law": "sigma"}, "von_mises"),
    "sand": ({"law": "sigma"}, "drucker_prager"),
    "plasticine": ({"law": "sigma"}, "von_mises"),
    "snow": ({"law": "sigma"}, "von_mises"),
    "foam": ({"law": "sigma"}, None),
}
"""Elastic and plastic law of each material."""
PART_OF_IT = {
    "plasticine": "softening of a plasticine has no counterpart: it yields at yield_stress",
    "snow": "the damage of snow has no counterpart: it yields at yield_stress",
    "foam": "the viscoplasticity of a foam has no counterpart: it is elastic",
}
DEFAULTS = {"grid_lim": 2.0, "n_grid": 50, "nu": 0.4, "E": 1e5, "density": 200.0, "substep_dt": 1e-4, "frame_dt": 1e-2, "frame_num": 100,
            "opacity_threshold": 0.02, "scale": 1.0, "friction_angle": 25.0}  # fmt: skip
"""What PhysGaussian takes where a key is absent."""
PASSED_OVER = ("mpm_space_vertical_upward_axis", "mpm_space_viewpoint_center", "default_camera_index", "show_hint", "init_azimuthm",
               "init_elevation", "init_radius", "move_camera", "delta_a", "delta_e", "delta_r")  # fmt: skip
"""Keys of the camera."""
READ = (
    "material",
    "g",
    "yield_stress",
    "rotation_degree",
    "rotation_axis",
    "sim_area",
    "boundary_conditions",
    "particle_filling",
    *DEFAULTS,
)


def is_physgaussian(content: Any) -> bool:
    """Return whether a JSON content is a scene configuration of PhysGaussian."""
    return (
        isinstance(content, dict)
        and len({"material", "substep_dt", "boundary_conditions", "E", "n_grid", "opacity_threshold"} & set(content)) >= 2
    )


def read_physgaussian(path: Path) -> tuple[NeighbourScene, Placement]:
    """Read a scene configuration.

    Returns:
        The scene, whose one body has neither mesh nor particles yet, and the placement of its Gaussians.

    Raises:
        UserError: A value is of the wrong type or out of its range, or the material is unknown.
    """
    content = read_json(path)
    if not is_physgaussian(content):
        raise UserError(f"{path} is not a scene configuration of PhysGaussian: it lacks material, substep_dt, n_grid and the like")
    content = mapping(content, str(path))

    def value(key: str, **bounds: float) -> float:
        return number(content.get(key, DEFAULTS[key]), f"{path}: {key}", **bounds)  # type: ignore[arg-type]

    scene = NeighbourScene(path.stem, f"{path.name} (PhysGaussian)")
    cube = value("grid_lim", above=0.0)
    gravity = content.get("g", [0.0, 0.0, 0.0])
    turn = poses.upright("z")
    scene.gravity = tuple((turn @ vector(gravity, f"{path}: g")).tolist())  # type: ignore[assignment]
    scene.domain, scene.cells = ((0.0, 0.0, 0.0), (cube, cube, cube)), _whole(content, "n_grid", path)
    scene.dt = value("substep_dt", above=0.0)
    scene.steps = max(1, round(value("frame_dt", above=0.0) / scene.dt)) * _whole(content, "frame_num", path)
    scene.bodies.append(_body(content, path, scene, value("E", above=0.0), value("nu", least=0.0), value("density", above=0.0)))
    for key in content:
        if key not in (*READ, *PASSED_OVER):
            scene.note(str(path), f"{key} = {str(content[key])[:60]} has no counterpart and is left out")
    if "particle_filling" in content:
        scene.note(str(path), "particle_filling is replaced by neuido's own filling")
    conditions = content.get("boundary_conditions", [])
    if not isinstance(conditions, list):
        raise UserError(f"{path}: boundary_conditions must be a list, got {type(conditions).__name__}")
    for i, condition in enumerate(conditions):
        _condition(mapping(condition, f"{path}: boundary_conditions[{i}]"), f"{path}: boundary_conditions[{i}]", scene, cube)
    return scene, _placement(content, path, cube, value)


def _whole(content: dict[str, Any], key: str, path: Path) -> int:
    value = content.get(key, DEFAULTS[key])
    if not isinstance(value, int) or isinstance(value, bool) or not 1 <= value <= 10_000_000:
        raise UserError(f"{path}: {key} must be a positive whole number, got {value!r}")
    return value


def _body(content: dict[str, Any], path: Path, scene: NeighbourScene, young: float, poisson: float, density: float) -> SoftBody:
    material = content.get("material", "jelly")
    if material not in LAWS:
        raise UserError(f"{path}: material = {str(material)[:40]!r} is unknown{suggest(str(material), LAWS)}; it takes {', '.join(LAWS)}")
    elastic, plastic = LAWS[material]
    plasticity: dict[str, Any] | None = None
    if plastic == "von_mises":
        if "yield_stress" not in content:
            raise UserError(f"{path}: the material {material} needs yield_stress")
        plasticity = {"law": plastic, "yield_stress": number(content["yield_stress"], f"{path}: yield_stress", above=0.0)}
    elif plastic == "drucker_prager":
        angle = content.get("friction_angle", DEFAULTS["friction_angle"])
        plasticity = {"law": plastic, "friction_angle": number(angle, f"{path}: friction_angle", above=0.0)}
    if material in PART_OF_IT:
        scene.note(str(path), PART_OF_IT[material])
    return SoftBody(material, density=density, elasticity={**elastic, "young": young, "poisson": poisson}, plasticity=plasticity)


def _point(given: Any, where: str, cube: float) -> np.ndarray:
    x, y, z = vector(given, where)
    return np.array([x, z, cube - y])


def _condition(given: dict[str, Any], where: str, scene: NeighbourScene, cube: float) -> None:
    kind = given.get("type")
    start = number(given.get("start_time", 0.0), f"{where}.start_time")
    end = number(given.get("end_time", 1e3), f"{where}.end_time")
    assert scene.dt is not None and scene.steps is not None
    lasts = start <= 0.0 and end >= scene.dt * scene.steps
    if kind == "bounding_box":
        scene.walls = {"contact": "separate", "friction": 0.0, "inset": PADDING}
    elif kind == "surface_collider":
        normal = poses.upright("z") @ vector(given.get("normal"), f"{where}.normal")
        if not np.linalg.norm(normal) > 0:
            raise UserError(f"{where}.normal must not be zero")
        surface = given.get("surface")
        own = Obstacle("plane", f"plane {len(scene.obstacles)}", _point(given.get("point"), f"{where}.point", cube),
                       poses.turn_between((0, 1, 0), normal.tolist()),
                       friction=number(given.get("friction", 0.0), f"{where}.friction", least=0.0),
                       contact=surface if surface in ("sticky", "slip") else "separate")  # fmt: skip
        scene.obstacles.append(own)
        if not lasts:
            scene.note(where, f"it acts from {start:g} to {end:g} s there, and all the time here")
    elif kind == "cuboid":
        centre = _point(given.get("point"), f"{where}.point", cube)
        x, y, z = vector(given.get("size"), f"{where}.size")
        if any(vector(given.get("velocity"), f"{where}.velocity")):
            scene.note(where, "a cuboid that moves has no counterpart and is left out")
        elif not lasts:
            scene.note(where, f"a cuboid that holds from {start:g} to {end:g} s has no counterpart and is left out")
        else:
            half = np.abs([x, z, y])
            scene.clamps.append((tuple((centre - half).tolist()), tuple((centre + half).tolist())))  # type: ignore[arg-type]
    else:
        scene.note(where, f"{str(kind)[:40]} has no counterpart and is left out")


def _placement(content: dict[str, Any], path: Path, cube: float, value: Any) -> Placement:
    degrees, axes = content.get("rotation_degree", []), content.get("rotation_axis", [])
    if (
        not isinstance(degrees, list)
        or not isinstance(axes, list)
        or len(degrees) != len(axes)
        or any(axis not in (0, 1, 2) for axis in axes)
    ):
        raise UserError(f"{path}: rotation_degree and rotation_axis must be lists of one length, with axes 0, 1 or 2")
    rotation, upright = np.eye(3), poses.upright("z")
    for i, (angle, axis) in enumerate(zip(degrees, axes)):
        rotation = poses.about_axis(int(axis), math.radians(number(angle, f"{path}: rotation_degree[{i}]"))) @ rotation
    area = content.get("sim_area")
    box = None
    if area is not None:
        if not isinstance(area, list) or len(area) != 6:
            raise UserError(f"{path}: sim_area must be six numbers, lowest and highest x, y and z")
        numbers = [number(each, f"{path}: sim_area") for each in area]
        corners = np.stack([numbers[::2], numbers[1::2]]) @ upright.T
        box = corners.min(axis=0), corners.max(axis=0)
    centre = np.array([1.0, 1.0, cube - 1.0])
    return Placement(upright @ rotation, box, value("opacity_threshold", least=0.0), value("scale", above=0.0), centre)
