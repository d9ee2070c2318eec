"""Collision geometry of robots in URDF files, with every joint at its zero."""

from pathlib import Path

import numpy as np

from neuido.data.bodies.mesh_files import read_mesh
from neuido.data.files.values import path_inside
from neuido.data.neighbours import poses
from neuido.data.neighbours.neighbour_scene import NeighbourScene, Obstacle
from neuido.data.neighbours.poses import Pose
from neuido.data.neighbours.soft_shapes import stretched
from neuido.data.neighbours.xml_elements import Element, read_xml
from neuido.errors import UserError

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
    for name, link in links.items():
        for i, collision in enumerate(link.named("collision")):
            own = collision.get("name") or (name if i == 0 else f"{name} {i}")
            obstacle = _obstacle(collision, placed[name], own, path.parent)
            scene.obstacles.append(obstacle.turned(poses.upright("z")))
    if not scene.obstacles:
        scene.note(str(path), "no link has collision geometry")
    return scene


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


def _obstacle(collision: Element, above: Pose, name: str, folder: Path) -> Obstacle:
    geometry = collision.first("geometry")
    shape = geometry.children[0] if geometry is not None and geometry.children else None
    if shape is None:
        raise UserError(f"{collision.place}: the collision of {name} has no geometry")
    at, rotation = _moved(collision.first("origin"), above)
    own = Obstacle(shape.tag, name, at, rotation, friction=1.0)
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
        own.mesh = stretched(read_mesh(path), np.array(scale))
    else:
        raise UserError(f"{shape.place}: the geometry {shape.tag} of {name} is unknown: box, cylinder, capsule, sphere or mesh")
    return own


def _positive(shape: Element, name: str) -> float:
    value = shape.number(name, 0.0)
    if not value > 0:
        raise UserError(f"{shape.place}: {name} of {shape.tag} must be positive, got {shape.get(name)!r}")
    return value
