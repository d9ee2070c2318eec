"""Collision geometry of robots in URDF files, with every joint at its zero."""

from pathlib import Path

import numpy as np

from neuido.data.bodies.mesh_files import read_mesh
from neuido.data.files.values import path_inside
from neuido.data.neighbours import poses
from neuido.data.neighbours.collision_meshes import collision_mesh
from neuido.data.neighbours.neighbour_scene import NeighbourScene, Obstacle, SoftBody
from neuido.data.neighbours.poses import Pose
from neuido.data.neighbours.soft_shapes import stretched
from neuido.data.neighbours.xml_elements import Element, read_xml
from neuido.errors import UserError

FRICTION = 1.0
"""Coulomb's coefficient where the file states none, as Gazebo has it."""
LEFT_OUT = ("transmission", "gazebo", "sensor", "ros2_control")
"""Elements of a robot without a counterpart."""


def read_urdf(path: Path) -> NeighbourScene:
    """Read the collision geometry of a robot; +z is up in the file.

    Raises:
        UserError: The file is not valid, links and joints do not form trees, or a mesh is missing or lies outside the folder of the file.
    """
    root = read_xml(path)
    if root.tag != "robot":
        raise UserError(f"{path} is not a URDF file: its first element is {root.tag}, not robot")
    scene = NeighbourScene(root.get("name") or path.stem, f"{path.name} (URDF)")
    links = {link.get("name"): link for link in root.named("link")}
    placed = _link_poses(root, links)
    moving = [joint.get("name") for joint in root.named("joint") if joint.get("type") != "fixed"]
    if moving:
        scene.note(str(path), f"{len(moving)} joints ({', '.join(moving[:5])}{', ...' if len(moving) > 5 else ''}) stand at their zero")
    for tag in LEFT_OUT:
        if found := root.named(tag):
            scene.note(found[0].place, f"{tag} ({len(found)} elements) has no counterpart and is left out")
    rough = _contact_friction(root)
    for name, link in links.items():
        for i, collision in enumerate(link.named("collision")):
            own = collision.get("name") or (name if i == 0 else f"{name} {i}")
            obstacle = _obstacle(collision, placed[name], own, path.parent, scene)
            if obstacle is not None:
                obstacle.friction = rough.get(name, FRICTION)
                scene.obstacles.append(obstacle.turned(poses.upright("z")))
    if not any(link.named("collision") for link in links.values()):
        scene.note(str(path), "no link has collision geometry")
    unstated = sum(1 for name, link in links.items() if link.named("collision") and name not in rough)
    if unstated:
        scene.note(str(path), f"{unstated} of the links with collision geometry state no friction, which is taken as {FRICTION:g}")
    if any(link.first("inertial") for link in links.values()):
        scene.note(str(path), "the masses of the links are not used: the robot stands still")
    for deformable in root.named("deformable", "reduced_deformable"):
        _add_deformable(deformable, scene)
    return scene


def _contact_friction(root: Element) -> dict[str, float]:
    """Return Coulomb's coefficient of the links that state one, as Bullet (contact/lateral_friction) or Gazebo (mu1) have it."""
    out = {}
    for link in root.named("link"):
        contact = link.first("contact")
        lateral = contact.first("lateral_friction") if contact is not None else None
        if lateral is not None and lateral.number("value", -1.0) >= 0:
            out[link.get("name")] = lateral.number("value", -1.0)
    for gazebo in root.named("gazebo"):
        sliding = gazebo.first("mu1")
        if sliding is not None and gazebo.get("reference") and sliding.number("value", -1.0) >= 0:
            out[gazebo.get("reference")] = sliding.number("value", -1.0)
    return out


def _add_deformable(element: Element, scene: NeighbourScene) -> None:
    """Add a soft body of Bullet's extension, whose shape comes from a second file."""
    name = element.get("name") or "deformable"
    own, inertial = SoftBody(name, elasticity={"law": "neo_hookean"}), element.first("inertial")
    mass = inertial.first("mass") if inertial is not None else None
    own.mass = mass.number("value", 0.0) if mass is not None else None
    hooke = element.first("neohookean")
    if hooke is not None:
        shear, first = _positive(hooke, "mu"), hooke.number("lambda", 0.0)
        own.elasticity |= {"young": shear * (3 * first + 2 * shear) / (first + shear), "poisson": first / (2 * (first + shear))}
        if hooke.number("damping", 0.0):
            scene.note(hooke.place, f"the damping of {name} has no counterpart and is left out")
    for tag in ("spring", "corotated", "repulsion_stiffness", "collision_margin", "friction"):
        if element.first(tag) is not None:
            scene.note(element.place, f"{tag} of the deformable {name} has no counterpart and is left out")
    shape = next((part.get("filename") for part in element.named("sim_mesh", "visual", "collision") if part.get("filename")), "")
    scene.note(element.place, f"the shape of the deformable {name}, {shape or 'unnamed'}, is not read: the second file is its shape")
    scene.bodies.append(own)


def _link_poses(root: Element, links: dict[str, Element]) -> dict[str, Pose]:
    """Return the pose of each link in the world: those that are no joint's child stand at the origin."""
    above: dict[str, tuple[str, Element]] = {}
    for joint in root.named("joint"):
        ends = [joint.first(tag) for tag in ("parent", "child")]
        names = [end.get("link") if end is not None else "" for end in ends]
        for name in names:
            if name not in links:
                raise UserError(f"{joint.place}: the joint {joint.get('name')} names the link {name!r}, which is not there")
        if names[1] in above:
            raise UserError(f"{joint.place}: the link {names[1]} is the child of two joints")
        above[names[1]] = names[0], joint
    out: dict[str, Pose] = {}
    for name in links:
        chain, own = [], name
        while own in above:
            chain.append(own)
            if len(chain) > len(links):
                raise UserError(f"{root.place}: the joints above the link {name} form a circle")
            own = above[own][0]
        pose: Pose = (np.zeros(3), np.eye(3))
        for child in reversed(chain):
            pose = _moved(above[child][1].first("origin"), pose)
        out[name] = pose
    return out


def _moved(origin: Element | None, above: Pose) -> Pose:
    if origin is None:
        return above
    at, angles = origin.numbers("xyz", 3, (0.0, 0.0, 0.0)), origin.numbers("rpy", 3, (0.0, 0.0, 0.0))
    assert at is not None and angles is not None
    return above[0] + above[1] @ np.array(at), above[1] @ poses.from_rpy(angles)


def _obstacle(collision: Element, above: Pose, name: str, folder: Path, scene: NeighbourScene) -> Obstacle | None:
    geometry = collision.first("geometry")
    shape = geometry.children[0] if geometry is not None and geometry.children else None
    if shape is None:
        raise UserError(f"{collision.place}: the collision of {name} has no geometry")
    at, rotation = _moved(collision.first("origin"), above)
    own = Obstacle(shape.tag, name, at, rotation)
    if shape.tag == "sphere":
        own.radius = _positive(shape, "radius")
    elif shape.tag in ("cylinder", "capsule"):
        own.radius, own.length = _positive(shape, "radius"), _positive(shape, "length")
        own.rotation = rotation @ poses.turn_between((0, 1, 0), (0, 0, 1))
    elif shape.tag == "box":
        size = shape.numbers("size", 3)
        if size is None or any(not side > 0 for side in size):
            raise UserError(f"{shape.place}: the box of {name} needs a size of three positive numbers")
        own.kind, own.size = "cuboid", size  # type: ignore[assignment]
    elif shape.tag == "mesh":
        file = shape.get("filename").removeprefix("file://")
        if file.startswith("package://"):
            file = file.removeprefix("package://")
            inside = file.partition("/")[2]
            file = file if path_inside(folder, file, f"{shape.place}: filename").is_file() else inside
        path = path_inside(folder, file, f"{shape.place}: filename of the mesh of {name}", kind="folder of the robot")
        if not path.is_file():
            raise UserError(f"{shape.place}: the mesh {shape.get('filename')} is missing in {folder}")
        scale = shape.numbers("scale", 3, (1.0, 1.0, 1.0))
        concave = collision.get("concave") in ("yes", "true", "1")
        own.mesh = collision_mesh(stretched(read_mesh(path), np.array(scale)), name, shape.place, scene, concave=concave)
        return None if own.mesh is None else own
    elif shape.tag == "plane":
        normal = shape.numbers("normal", 3, (0.0, 0.0, 1.0))
        own.rotation = rotation @ poses.turn_between((0, 1, 0), normal or (0.0, 0.0, 1.0))
    else:
        scene.note(shape.place, f"the geometry {shape.tag} of {name} has no counterpart and is left out")
        return None
    return own


def _positive(shape: Element, name: str) -> float:
    value = shape.number(name, 0.0)
    if not value > 0:
        raise UserError(f"{shape.place}: {name} of {shape.tag} must be positive, got {shape.get(name)!r}")
    return value
