"""Colliders of USD files: prims with the collision schema of UsdPhysics, gravity, friction and mass."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from neuido.data.bodies.triangle_mesh import clean_mesh
from neuido.data.bodies.usd_files import open_stage, placed, prim_mesh, shown_prims, stage_units, world_matrix
from neuido.data.neighbours import poses
from neuido.data.neighbours.neighbour_scene import NeighbourScene, Obstacle
from neuido.errors import UserError
from neuido.physics.runtime.lazy import import_extra

EVEN = 1e-4
"""Relative difference of the scales of two axes up to which they count as equal."""
EARTH = 9.81
"""Magnitude of gravity where the file leaves it to the reader, as UsdPhysics says [m/s^2]."""


def read_usd_scene(path: Path) -> NeighbourScene:
    """Read the colliders of a USD file at its first time.

    If no prim has the collision schema, all shapes that are shown are colliders.

    Raises:
        UserError: As `open_stage`; or a shape has no size.
    """
    stage = open_stage(path)
    Usd, UsdGeom, UsdPhysics = (import_extra(f"pxr.{name}", "USD", extra="usd") for name in ("Usd", "UsdGeom", "UsdPhysics"))
    time = Usd.TimeCode.EarliestTime()
    metres, up = stage_units(stage)
    scene = NeighbourScene(path.stem, f"{path.name} (USD)")
    prims = [prim for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()) if prim.IsActive()]
    turn = poses.upright(up)
    scene.gravity = tuple((turn @ _gravity(prims, metres, up, UsdPhysics)).tolist())  # type: ignore[assignment]
    touching = [
        prim for prim in prims if prim.HasAPI(UsdPhysics.CollisionAPI) and _enabled(UsdPhysics.CollisionAPI(prim).GetCollisionEnabledAttr())
    ]
    if not touching:
        touching = [prim for prim in shown_prims(stage) if prim.IsA(UsdGeom.Gprim)]
        if touching:
            scene.note(str(path), f"no prim has PhysicsCollisionAPI: all {len(touching)} shapes are colliders")
    for prim in prims:
        deforming = [str(name) for name in prim.GetAppliedSchemas() if "Deformable" in str(name)]
        if deforming:
            scene.note(f"{path.name}{prim.GetPath()}", f"{deforming[0]} has no counterpart; give the body as a file of its own")
        if prim.IsA(UsdPhysics.Joint):
            scene.note(f"{path.name}{prim.GetPath()}", "the joint has no counterpart and is left out")
    for prim in touching:
        own = _obstacle(prim, time, scene, path.name, metres)
        if own is not None:
            own.friction = _friction(prim)
            _set_mass(own, prim, touching, scene, path.name)
            scene.obstacles.append(own.turned(turn))
    return scene


def _enabled(attribute: Any) -> bool:
    value = attribute.Get()
    return True if value is None else bool(value)


def _gravity(prims: list[Any], metres: float, up: str, UsdPhysics: Any) -> np.ndarray:
    down = -np.eye(3)["xyz".index(up)]
    for prim in prims:
        if prim.IsA(UsdPhysics.Scene):
            own = UsdPhysics.Scene(prim)
            direction = np.array(own.GetGravityDirectionAttr().Get() or (0, 0, 0), float)
            magnitude = own.GetGravityMagnitudeAttr().Get()
            size = EARTH if magnitude is None or not math.isfinite(magnitude) else float(magnitude) * metres
            length = np.linalg.norm(direction)
            return size * (direction / length if length > 0 else down)
    return EARTH * down


def _obstacle(prim: Any, time: Any, scene: NeighbourScene, file: str, metres: float) -> Obstacle | None:
    """Return the collider of a prim in axes of the file and in metres; None, with a note, where it has no counterpart."""
    UsdGeom = import_extra("pxr.UsdGeom", "USD", extra="usd")
    matrix, place = world_matrix(prim, time), f"{file}{prim.GetPath()}"
    kind, name = str(prim.GetTypeName()).lower(), prim.GetName()
    if prim.IsA(UsdGeom.Mesh):
        vertices, faces = placed(*prim_mesh(prim, time), matrix)
        if not len(faces):
            scene.note(place, "the mesh has no triangles and is left out")
            return None
        return Obstacle("mesh", name, np.zeros(3), np.eye(3), mesh=clean_mesh(vertices * metres, faces, place))
    scale = np.linalg.norm(matrix[:3, :3], axis=0)
    if not (scale > 0).all():
        raise UserError(f"{place}: the transform of {name} has no extent along an axis")
    rotation, at = matrix[:3, :3] / scale, matrix[:3, 3] * metres
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > EVEN:
        scene.note(place, "it is sheared, which has no counterpart: it is left out")
        return None
    if np.linalg.det(rotation) < 0:
        rotation = rotation * np.array([-1.0, 1.0, 1.0])  # the shapes are their own mirror images
    own, scale = Obstacle(kind, name, at, rotation), scale * metres

    def value(attribute: str) -> float:
        found = float(prim.GetAttribute(attribute).Get(time))
        if not (found > 0 and math.isfinite(found)):
            raise UserError(f"{place}: {attribute} of {name} must be positive, got {found}")
        return found

    if kind == "cube":
        own.kind, own.size = "cuboid", tuple((value("size") * scale).tolist())  # type: ignore[assignment]
    elif kind == "sphere" and np.ptp(scale) <= EVEN * scale.max():
        own.radius = value("radius") * float(scale[0])
    elif kind in ("cylinder", "capsule", "plane"):
        axis = "XYZ".index(str(prim.GetAttribute("axis").Get(time) or "Z"))
        across = [scale[a] for a in range(3) if a != axis]
        if kind != "plane":
            own.radius, own.length = value("radius") * float(across[0]), value("height") * float(scale[axis])
        if kind != "plane" and abs(across[0] - across[1]) > EVEN * max(across):
            scene.note(place, f"the {kind} is scaled unevenly, which has no counterpart: it is left out")
            return None
        own.rotation = rotation @ poses.turn_between((0, 1, 0), np.eye(3)[axis].tolist())
    else:
        scene.note(place, f"a {prim.GetTypeName()} (or its uneven scale) has no counterpart and is left out")
        return None
    return own


def _friction(prim: Any) -> float:
    """Return the dynamic friction of the physics material bound to a prim; 0 without one."""
    UsdShade = import_extra("pxr.UsdShade", "USD", extra="usd")
    UsdPhysics = import_extra("pxr.UsdPhysics", "USD", extra="usd")
    material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")[0]
    if not material or not material.GetPrim().HasAPI(UsdPhysics.MaterialAPI):
        return 0.0
    return max(0.0, float(UsdPhysics.MaterialAPI(material.GetPrim()).GetDynamicFrictionAttr().Get() or 0.0))


def _set_mass(own: Obstacle, prim: Any, touching: list[Any], scene: NeighbourScene, file: str) -> None:
    """Let a collider that is a whole rigid body with a mass move freely."""
    UsdPhysics = import_extra("pxr.UsdPhysics", "USD", extra="usd")
    body = prim
    while body and not body.HasAPI(UsdPhysics.RigidBodyAPI):
        body = body.GetParent()
    if not body or not _enabled(UsdPhysics.RigidBodyAPI(body).GetRigidBodyEnabledAttr()):
        return
    mass = float(UsdPhysics.MassAPI(body).GetMassAttr().Get() or 0.0) if body.HasAPI(UsdPhysics.MassAPI) else 0.0
    alone = sum(other.GetPath().HasPrefix(body.GetPath()) for other in touching) == 1
    if mass > 0 and alone and own.kind != "plane":
        own.mass = mass
    else:
        why = "has several colliders" if not alone else "states no mass"
        scene.note(f"{file}{body.GetPath()}", f"the rigid body {why}: it is at rest")
