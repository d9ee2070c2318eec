"""Write a neighbour's scene as a folder: `scene.yaml` (`neuido-scene/1`), with meshes and particles beside it."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from neuido.data.bodies.mesh_filling import closed_mesh
from neuido.data.bodies.triangle_mesh import TriangleMesh
from neuido.data.files.writing import new_folder, write_arrays, write_text
from neuido.data.neighbours.neighbour_scene import NeighbourScene, Obstacle, SoftBody
from neuido.data.neighbours.overlaps import note_overlaps
from neuido.data.neighbours.poses import to_quaternion
from neuido.errors import UserError
from neuido.physics.laws.classical import material

PER_CELL = 2.0
"""Spacings of particles along the edge of a grid cell: eight particles a cell."""
COURANT = 0.4
"""Share of a cell that an elastic wave may cross in a step: the laws that stiffen need a reserve (the limit is 1)."""
ROOM = 1.5
"""Space around all bodies and colliders, in longest sides of the bodies."""
REACH = 20.0
"""Distance up to which the domain includes colliders, in longest sides of the bodies."""
NAMED = 3
"""Colliders that a line names."""
CELLS = (16, 1024)
"""Fewest and most cells along the longest side of the domain; the grid follows the particles, so that a large one costs no memory."""
DURATION = 1.0
"""Simulated time where the file states no number of steps [s]."""
ROUNDING = 1e-12
"""Size of a number below which it is written as zero: what is left of rotations by a right angle [m, m/s^2, -]."""
DENSITY, POISSON = 1000.0, 0.3
"""What is taken where neither file nor option says it [kg/m^3, -]; a line says so."""


def write_scene(scene: NeighbourScene, out: Path | None, *, particles: int) -> list[str]:
    """Write a scene, or only check that it can be written.

    Args:
        scene: The scene; each body has a mesh or particles, a density and the parameters of its law.
        out: The folder to create; None: nothing is written.
        particles: Approximate number of particles of each body that is a mesh.

    Returns:
        What was understood, line by line.

    Raises:
        UserError: There is no body, a mesh is not closed, or a parameter is out of its range.
    """
    if not scene.bodies:
        raise UserError(f"{scene.source} has no deformable body: give one as a second file, a mesh or Gaussians (.ply)")
    files: dict[str, Any] = {}
    bodies = [_body(body, b, files, particles) for b, body in enumerate(scene.bodies)]
    note_overlaps(scene)
    domain, cells, dt, steps = _discretisation(scene, particles)
    content: dict[str, Any] = {
        "format": "neuido-scene/1",
        "name": scene.name[:80],
        "source": scene.source,
        "scene": {
            "domain": [list(corner) for corner in domain],
            "gravity": list(scene.gravity),
            "walls": scene.walls,
            "colliders": [_collider(obstacle, o, files) for o, obstacle in enumerate(scene.obstacles)],
            "clamps": [{"box": [list(low), list(high)]} for low, high in scene.clamps],
        },
        **_models(scene.bodies, bodies),
        "discretisation": {"grid": cells, "dt": dt},
        "steps": steps,
        "on_leave": "delete",
    }
    for key in ("colliders", "clamps"):
        if not content["scene"][key]:
            del content["scene"][key]
    if out is not None:
        with new_folder(out) as hidden:
            for name, given in files.items():
                if isinstance(given, str):
                    write_text(hidden / name, given)
                else:
                    write_arrays(hidden / name, given)
            write_text(hidden / "scene.yaml", yaml.safe_dump(_plain(content), sort_keys=False, allow_unicode=True))
    return _summary(scene, domain, cells, dt, steps)


def complete(scene: NeighbourScene, *, density: float | None, young: float | None, poisson: float | None) -> None:
    """Fill in, by options, what a file does not say of its bodies; options win over the file.

    Raises:
        UserError: No Young's modulus is known, or a parameter is out of its range.
    """
    for body in scene.bodies:
        given = {"young": young, "poisson": poisson}
        body.elasticity |= {key: value for key, value in given.items() if value is not None}
        if "young" not in body.elasticity:
            raise UserError(f"{scene.source} states no Young's modulus of {body.name}: give --young in Pa")
        for key, default in (("poisson", POISSON),):
            if key not in body.elasticity:
                body.elasticity[key] = default
                scene.note("", f"{key} of {body.name} is taken as {default:g}; --{key} says another")
        body.density = density if density is not None else body.density
        if body.density is None and body.mass and (body.mesh is not None or body.particles is not None):
            body.density = body.mass / body.volume()
        if body.density is None:
            body.density = DENSITY
            scene.note("", f"density of {body.name} is taken as {DENSITY:g} kg/m^3; --density says another")
        material(body.elasticity, body.plasticity)


def _plain(value: Any) -> Any:
    """Return a value with NumPy's numbers and tuples as YAML has them; numbers with nine digits."""
    if isinstance(value, dict):
        return {key: _plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [_plain(each) for each in value]
    if isinstance(value, float | np.floating):
        return 0.0 if abs(value) < ROUNDING else float(f"{value:.9g}")
    return int(value) if isinstance(value, np.integer) else value


def _models(bodies: list[SoftBody], entries: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the keys `model` and `body`, or `bodies` where there are several."""
    models = [
        {"density": own.density, "elasticity": own.elasticity, **({"plasticity": own.plasticity} if own.plasticity else {})}
        for own in bodies
    ]
    if len(bodies) == 1:
        return {"model": models[0], "body": entries[0]}
    names: list[str] = []
    for own in bodies:
        names.append(own.name if own.name not in names else f"{own.name} {len(names)}")
    return {"bodies": [{"name": name, "model": model, "body": body} for name, model, body in zip(names, models, entries)]}


def _obj(mesh: TriangleMesh) -> str:
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in mesh.vertices.tolist()]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in mesh.faces.tolist()]
    return "\n".join(lines) + "\n"


def _body(body: SoftBody, b: int, files: dict[str, Any], particles: int) -> dict[str, Any]:
    if body.particles is not None:
        files[f"body-{b}.npz"] = body.particles
        return {"particles": f"body-{b}.npz"}
    if body.mesh is None:
        raise UserError(f"the body {body.name} needs its shape as a second file: a mesh or Gaussians (.ply)")
    body.mesh = closed_mesh(body.mesh, body.name)
    files[f"body-{b}.obj"] = _obj(body.mesh)
    return {"shape": "mesh", "file": f"body-{b}.obj", "particles": particles, "velocity": list(body.velocity)}


def _collider(own: Obstacle, o: int, files: dict[str, Any]) -> dict[str, Any]:
    contact = {"contact": own.contact, "friction": own.friction}
    if own.kind == "plane":
        return {"type": "plane", "point": own.position, "normal": own.rotation[:, 1], **contact}
    entry: dict[str, Any] = {"kind": own.kind, "name": own.name[:80], "position": own.position, "rotation": to_quaternion(own.rotation)}
    if own.kind in ("sphere", "capsule", "cylinder"):
        entry["radius"] = own.radius
    if own.kind in ("capsule", "cylinder"):
        entry["length"] = own.length
    if own.kind == "cuboid":
        entry["size"] = own.size
    if own.mesh is not None:
        files[f"collider-{o}.obj"] = _obj(closed_mesh(own.mesh, own.name))
        entry["file"] = f"collider-{o}.obj"
    if own.mass is not None:
        entry["mass"] = own.mass
    return {**entry, **contact}


def _discretisation(scene: NeighbourScene, particles: int) -> tuple[Any, int, float, int]:
    """Return the corners of the domain [m], cells along its longest side, the step [s] and the number of steps."""
    spacing, speed, boxes = math.inf, 0.0, []
    for body in scene.bodies:
        points = body.particles["x"] if body.particles is not None else body.mesh.vertices  # type: ignore[union-attr]
        boxes.append((points.min(axis=0), points.max(axis=0)))
        if body.particles is not None:
            each = float(np.median(body.particles["volume"]))
        else:
            each = body.volume() / particles
        spacing = min(spacing, each ** (1 / 3))
        elastic, _ = material(body.elasticity, body.plasticity)
        speed = max(speed, math.sqrt(float(elastic.modulus().max()) / body.density) + math.hypot(*body.velocity))  # type: ignore[operator]
    longest = max(float((high - low).max()) for low, high in boxes)
    if scene.domain is not None:
        domain = scene.domain
    else:
        boxes += _reached(scene, boxes, REACH * longest)
        boxes += [foot for obstacle in scene.obstacles if obstacle.kind == "plane" for foot in _feet(obstacle, boxes, REACH * longest)]
        low, high = np.min([box[0] for box in boxes], axis=0), np.max([box[1] for box in boxes], axis=0)
        domain = tuple((low - ROOM * longest).tolist()), tuple((high + ROOM * longest).tolist())
    side = max(u - l for l, u in zip(*domain))
    wanted = max(math.ceil(side / (PER_CELL * spacing)), CELLS[0])
    cells = scene.cells or min(wanted, CELLS[1])
    if not scene.cells and wanted > cells:
        scene.note("", f"cells of {side / cells:.3g} m are wider than {PER_CELL:g} spacings of the particles, for the domain is large")
    stable = COURANT * side / cells / speed
    dt = min(scene.dt or stable, stable)
    if scene.dt is not None and scene.dt > stable:
        scene.note("", f"the time step of {scene.dt:g} s is shortened to {dt:.3g} s: a wave would cross more than {COURANT:g} cells")
    if scene.steps is not None and scene.dt is not None:
        return domain, cells, dt, math.ceil(scene.dt * scene.steps / dt - 1e-6)
    scene.note("", f"the file states no duration: {DURATION:g} s are simulated (`steps` of scene.yaml)")
    return domain, cells, dt, math.ceil(DURATION / dt)


def _reached(scene: NeighbourScene, boxes: list[Any], reach: float) -> list[Any]:
    """Return the boxes around colliders, cut off where they are farther than `reach` [m] from the bodies."""
    low, high = np.min([box[0] for box in boxes], axis=0) - reach, np.max([box[1] for box in boxes], axis=0) + reach
    out, far = [], []
    for obstacle in scene.obstacles:
        box = obstacle.extent()
        if box is None:
            continue
        if (box[1] < low).any() or (box[0] > high).any():
            far.append(obstacle.name)
            continue
        if (box[0] < low).any() or (box[1] > high).any():
            scene.note("", f"the domain ends {reach:.3g} m from the bodies, within the collider {obstacle.name}")
        out.append((np.maximum(box[0], low), np.minimum(box[1], high)))
    if far:
        names = ", ".join(far[:NAMED]) + (", ..." if len(far) > NAMED else "")
        scene.note("", f"{len(far)} colliders ({names}) are farther than {reach:.3g} m from the bodies, and outside the domain")
    return out


def _feet(plane: Obstacle, boxes: list[Any], reach: float) -> list[Any]:
    """Return the feet of boxes on a plane, as boxes of no size, where they are nearer than `reach` [m]."""
    normal = plane.rotation[:, 1]
    middles = [(low + high) / 2 for low, high in boxes]
    heights = [float(normal @ (middle - plane.position)) for middle in middles]
    feet = [middle - height * normal for middle, height in zip(middles, heights) if abs(height) < reach]
    return [(foot, foot) for foot in feet]


def _summary(scene: NeighbourScene, domain: Any, cells: int, dt: float, steps: int) -> list[str]:
    lines = [f"{scene.source}: {scene.name}"]
    for body in scene.bodies:
        assert body.density is not None
        law = ", ".join(f"{key} {value:g}" if isinstance(value, float) else str(value) for key, value in body.elasticity.items())
        plastic = f", {body.plasticity['law']}" if body.plasticity else ""
        if body.particles is not None:
            size = f"{len(body.particles['x'])} particles, {float(body.particles['volume'].sum()):.4g} m^3"
        else:
            size = f"a mesh of {body.volume():.4g} m^3"
        lines.append(f"body {body.name}: {size}, {body.density:.4g} kg/m^3, {law}{plastic}")
    kinds: dict[str, int] = {}
    for obstacle in scene.obstacles:
        kinds[obstacle.kind] = kinds.get(obstacle.kind, 0) + 1
    if kinds:
        lines.append("colliders: " + ", ".join(f"{count} {kind}{'s' * (count > 1 and kind != 'mesh')}" for kind, count in kinds.items()))
    lengths = " x ".join(f"{u - l:.4g}" for l, u in zip(*domain))
    gravity = ", ".join(f"{g:.4g}" for g in scene.gravity)
    lines.append(f"domain {lengths} m, {cells} cells, {steps} steps of {dt:.3g} s, gravity ({gravity}) m/s^2")
    return [*lines, *(f"note: {note}" for note in scene.notes)]
