"""Colliders of USD files: prims with the collision schema of UsdPhysics, gravity, friction and mass."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from neuido.data.bodies.triangle_mesh import TriangleMesh, clean_mesh
from neuido.data.bodies.usd_files import open_stage, placed, prim_mesh, shown_prims, stage_units, world_matrix
from neuido.data.neighbours import poses
from neuido.data.neighbours.collision_meshes import collision_mesh, convex_hull
from neuido.data.neighbours.neighbour_scene import NeighbourScene, Obstacle, SoftBody
from neuido.data.neighbours.soft_shapes import tetrahedra_surface
from neuido.errors import UserError
from neuido.physics.runtime.lazy import import_extra

EVEN = 1e-4
"""Relative difference of the scales of two axes up to which they count as equal."""
CONSTANTS = {"youngsModulus": "young", "poissonsRatio": "poisson"}
"""Constants of deformable materials [Pa, -]."""
SHOWN = 3
"""Prims that a note names."""
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
    soft = [prim for prim in shown_prims(stage) if prim.IsA(UsdGeom.TetMesh)]
    if not touching:
        touching = [prim for prim in shown_prims(stage) if prim.IsA(UsdGeom.Gprim) and prim not in soft]
        if touching:
            scene.note(str(path), f"no prim has PhysicsCollisionAPI: all {len(touching)} shapes are colliders")
    for prim in prims:
        deforming = [str(name) for name in prim.GetAppliedSchemas() if "Deformable" in str(name)]
        if deforming:
            scene.note(f"{path.name}{prim.GetPath()}", f"{deforming[0]} has no counterpart; give the body as a file of its own")
    joints = [str(prim.GetPath()) for prim in prims if prim.IsA(UsdPhysics.Joint)]
    if joints:
        shown = ", ".join(joints[:SHOWN]) + (", ..." if len(joints) > SHOWN else "")
        scene.note(path.name, f"joints have no counterpart and are left out ({len(joints)}: {shown})")
    rest: dict[str, list[str]] = {}
    for prim in touching:
        own = _obstacle(prim, time, scene, path.name, metres)
        if own is not None:
            own.friction = _friction(prim)
            _set_mass(own, prim, touching, rest)
            scene.obstacles.append(own.turned(turn))
    for prim in soft:
        scene.bodies.append(_tetrahedral_body(prim, time, path.name, turn, metres))
    for why, bodies in rest.items():
        shown = ", ".join(bodies[:SHOWN]) + (", ..." if len(bodies) > SHOWN else "")
        scene.note(path.name, f"rigid bodies that {why} are at rest ({len(bodies)}: {shown})")
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
        return _mesh_obstacle(prim, name, clean_mesh(vertices * metres, faces, place), place, scene)
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


def _mesh_obstacle(prim: Any, name: str, mesh: TriangleMesh, place: str, scene: NeighbourScene) -> Obstacle | None:
    """Return the collider of a mesh by the approximation that the file asks for; for a decomposition, the mesh itself."""
    UsdPhysics = import_extra("pxr.UsdPhysics", "USD", extra="usd")
    kind = str(UsdPhysics.MeshCollisionAPI(prim).GetApproximationAttr().Get() or "") if prim.HasAPI(UsdPhysics.MeshCollisionAPI) else ""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    if kind == "boundingSphere":
        middle = (low + high) / 2
        return Obstacle("sphere", name, middle, np.eye(3), radius=float(np.linalg.norm(mesh.vertices - middle, axis=1).max()))
    if kind == "boundingCube":
        return Obstacle("cuboid", name, (low + high) / 2, np.eye(3), size=tuple((high - low).tolist()))  # type: ignore[arg-type]
    hull = convex_hull(mesh, name) if kind == "convexHull" else None
    closed = hull or collision_mesh(mesh, name, place, scene, concave=kind in ("none", "sdf"))
    return None if closed is None else Obstacle("mesh", name, np.zeros(3), np.eye(3), mesh=closed)


def _tetrahedral_body(prim: Any, time: Any, file: str, turn: np.ndarray, metres: float) -> SoftBody:
    """Return a body with the surface of a `UsdGeomTetMesh`, and the constants of its physics material under any of their prefixes."""
    UsdGeom = import_extra("pxr.UsdGeom", "USD", extra="usd")
    mesh, place = UsdGeom.TetMesh(prim), f"{file}{prim.GetPath()}"
    points = np.asarray(mesh.GetPointsAttr().Get(time) or [], np.float64).reshape(-1, 3)
    elements = np.asarray(mesh.GetTetVertexIndicesAttr().Get(time) or [], np.int64).reshape(-1, 4)
    surface = tetrahedra_surface(points, elements, place)
    vertices, faces = placed(surface.vertices, surface.faces, world_matrix(prim, time))
    own = SoftBody(prim.GetName(), TriangleMesh(vertices * metres @ turn.T, faces), elasticity={"law": "neo_hookean"})
    material = _physics_material(prim)
    for attribute in material.GetPrim().GetAuthoredAttributes() if material else ():
        word, value = attribute.GetBaseName(), attribute.Get()
        if word in CONSTANTS and isinstance(value, float) and value > 0:
            own.elasticity[CONSTANTS[word]] = value
        elif word == "density" and isinstance(value, float) and value > 0:
            own.density = value
    return own


def _physics_material(prim: Any) -> Any:
    UsdShade = import_extra("pxr.UsdShade", "USD", extra="usd")
    return UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")[0]


def _friction(prim: Any) -> float:
    """Return the dynamic friction of the physics material bound to a prim; 0 without one."""
    UsdPhysics = import_extra("pxr.UsdPhysics", "USD", extra="usd")
    material = _physics_material(prim)
    if not material or not material.GetPrim().HasAPI(UsdPhysics.MaterialAPI):
        return 0.0
    return max(0.0, float(UsdPhysics.MaterialAPI(material.GetPrim()).GetDynamicFrictionAttr().Get() or 0.0))


def _set_mass(own: Obstacle, prim: Any, touching: list[Any], rest: dict[str, list[str]]) -> None:
    """Let a collider that is a whole rigid body with a mass move freely; `rest` takes the others, by the reason."""
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
        named = rest.setdefault("have several colliders" if not alone else "state no mass", [])
        if str(body.GetPath()) not in named:
            named.append(str(body.GetPath()))
