"""MuJoCo's scene files (MJCF): flexible bodies, geoms as colliders, gravity and time step.

MuJoCo has +z up, and angles in degrees unless its compiler says radian. Attributes that an element lacks come from its default class.
"""

import math
from pathlib import Path

import numpy as np

from neuido.data.bodies.mesh_files import TRIMESH_FORMATS, read_mesh
from neuido.data.bodies.scanlines import enclosed_volume
from neuido.data.bodies.triangle_mesh import TriangleMesh, clean_mesh
from neuido.data.files.values import path_inside
from neuido.data.neighbours import poses, soft_shapes
from neuido.data.neighbours.collision_meshes import collision_mesh
from neuido.data.neighbours.neighbour_scene import NeighbourScene, Obstacle, SoftBody
from neuido.data.neighbours.poses import Pose
from neuido.data.neighbours.xml_elements import Element, read_xml
from neuido.errors import UserError
from neuido.physics.runtime.limits import check_limit

INCLUDES = 50
"""Largest number of files that one file includes."""
TIMESTEP, GRAVITY = 0.002, (0.0, 0.0, -9.81)
"""MuJoCo's own defaults [s, m/s^2]."""
DENSITY, FRICTION = 1000.0, 1.0
"""MuJoCo's defaults of a geom [kg/m^3, -]."""
QUIET = ("worldbody", "compiler", "option", "default", "asset", "size", "visual", "statistic", "include", "deformable", "custom")
"""Sections that are read, or that hold nothing of the mechanics."""


def read_mjcf(path: Path) -> NeighbourScene:
    """Read a MuJoCo scene.

    Raises:
        UserError: The file or one that it includes or names is missing, outside its folder or not valid.
    """
    return _Reader(path).scene


class _Reader:
    """Read one MJCF file.

    Args:
        path: The file.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.folder = path, path.parent
        root = read_xml(path)
        if root.tag != "mujoco":
            raise UserError(f"{path} is not a MuJoCo scene: its first element is {root.tag}, not mujoco")
        self.files = 0
        sections = self._included(root)
        self.scene = NeighbourScene(root.get("model") or path.stem, f"{path.name} (MuJoCo MJCF)")
        self.compiler = {key: value for section in sections if section.tag == "compiler" for key, value in section.attributes.items()}
        self.radians = self.compiler.get("angle", "degree") == "radian"
        self.defaults: dict[str, dict[str, dict[str, str]]] = {"main": {}}
        for section in sections:
            if section.tag == "default":
                self._read_default(section, section.get("class") or "main", self.defaults["main"])
        self.meshes = {
            mesh.get("name") or Path(mesh.get("file")).stem: mesh
            for section in sections
            if section.tag == "asset"
            for mesh in section.named("mesh")
        }
        self._options(sections)
        for section in sections:
            if section.tag == "worldbody":
                self._frame(section, (np.zeros(3), np.eye(3)), "main", None)
            elif section.tag == "deformable":
                self._deformables(section)
            elif section.tag not in QUIET:
                each = len(section.children)
                self.scene.note(section.place, f"{section.tag} ({each} element{'s' * (each != 1)}) has no counterpart and is left out")
        turn = poses.upright("z")
        self.scene.obstacles = [obstacle.turned(turn) for obstacle in self.scene.obstacles]
        for body in self.scene.bodies:
            assert body.mesh is not None  # all of MJCF are
            body.mesh = body.mesh._replace(vertices=body.mesh.vertices @ turn.T)

    def _included(self, root: Element) -> list[Element]:
        """Return the sections of a file, with those of files that it includes in their place."""
        out = []
        for section in root.children:
            if section.tag != "include":
                out.append(section)
                continue
            self.files += 1
            if self.files > INCLUDES:
                raise UserError(f"{section.place}: more than {INCLUDES} files are included; perhaps one includes itself")
            out += self._included(read_xml(self._named(section.get("file"), section, "")))
        return out

    def _named(self, file: str, element: Element, folder: str) -> Path:
        """Return a file that an element names, inside the folder of the scene."""
        relative = f"{folder.rstrip('/')}/{file}" if folder and not file.startswith("/") else file
        found = path_inside(self.folder, relative, f"{element.place}: file of {element.tag}", kind="folder of the scene")
        if not found.is_file():
            raise UserError(f"{element.place}: the file {relative} of {element.tag} is missing in {self.folder}")
        return found

    def _read_default(self, section: Element, name: str, above: dict[str, dict[str, str]]) -> None:
        own = {tag: dict(attributes) for tag, attributes in above.items()}
        for child in section.children:
            if child.tag != "default":
                own[child.tag] = {**own.get(child.tag, {}), **child.attributes}
        self.defaults[name] = own
        for child in section.named("default"):
            self._read_default(child, child.get("class"), own)

    def _options(self, sections: list[Element]) -> None:
        gravity, self.scene.dt = GRAVITY, TIMESTEP
        for section in sections:
            if section.tag == "option":
                gravity = section.numbers("gravity", 3, gravity) or gravity
                self.scene.dt = section.number("timestep", self.scene.dt)
                if not self.scene.dt > 0:
                    raise UserError(f"{section.place}: timestep = {self.scene.dt} must be positive")
                for name in ("wind", "density", "viscosity", "magnetic"):
                    if any(section.numbers(name) or ()):
                        self.scene.note(section.place, f"option {name} has no counterpart and is left out")
        self.scene.gravity = tuple((poses.upright("z") @ gravity).tolist())  # type: ignore[assignment]

    def _with_defaults(self, element: Element, inherited: str) -> Element:
        name = element.get("class") or inherited
        if name not in self.defaults:
            raise UserError(f"{element.place}: the default class {name!r} of {element.tag} is unknown")
        return element._replace(attributes={**self.defaults[name].get(element.tag, {}), **element.attributes})

    def _pose(self, element: Element, above: Pose) -> Pose:
        at = np.array(element.numbers("pos", 3, (0.0, 0.0, 0.0)))
        unit = 1.0 if self.radians else math.pi / 180
        rotation = np.eye(3)
        if (q := element.numbers("quat", 4)) is not None and any(q):
            rotation = poses.from_quaternion(q)
        elif (given := element.numbers("axisangle", 4)) is not None and any(given[:3]):
            rotation = poses.about_axis(given[:3], given[3] * unit)
        elif (euler := element.numbers("euler", 3)) is not None:
            rotation = poses.from_euler([angle * unit for angle in euler], self.compiler.get("eulerseq", "xyz"))
        elif (xy := element.numbers("xyaxes", 6)) is not None:
            x = np.array(xy[:3]) / np.linalg.norm(xy[:3])
            y = np.array(xy[3:]) - x * (x @ np.array(xy[3:]))
            y = y / np.linalg.norm(y)
            rotation = np.stack([x, y, np.cross(x, y)], axis=1)
        elif (z := element.numbers("zaxis", 3)) is not None and any(z):
            rotation = poses.turn_between((0, 0, 1), z)
        if not np.isfinite(rotation).all():
            raise UserError(f"{element.place}: the orientation of {element.tag} has an axis of no length")
        return above[0] + above[1] @ at, above[1] @ rotation

    def _frame(self, element: Element, pose: Pose, inherited: str, moving: Element | None) -> None:
        """Read what a body or a frame holds.

        Args:
            element: The body, frame or world.
            pose: Its pose in the world.
            inherited: Name of the default class of what it holds.
            moving: The body that moves by joints and holds it, if any.
        """
        if element.get("childclass") and element.get("childclass") not in self.defaults:
            raise UserError(f"{element.place}: the default class {element.get('childclass')!r} is unknown")
        inherited = element.get("childclass") or inherited
        joints = element.named("joint", "freejoint")
        geoms = [self._with_defaults(geom, inherited) for geom in element.named("geom")]
        free = any(joint.tag == "freejoint" or joint.get("type") == "free" for joint in joints)
        if joints:
            moving = element
        touching = [geom for geom in geoms if geom.number("contype", 1) or geom.number("conaffinity", 1)]
        if len(geoms) > len(touching):
            self.scene.note(element.place, f"{len(geoms) - len(touching)} geoms without collisions are left out")
        alone = free and len(touching) == 1 and not element.named("body", "frame", "flexcomp")
        if joints and not alone and (touching or not element.named("flexcomp")):
            self.scene.note(
                element.place, f"the body {element.get('name') or ''} moves by joints, which have no counterpart: it is at rest"
            )
        for geom in touching:
            self._geom(geom, pose, alone)
        for child in element.children:
            if child.tag in ("body", "frame"):
                self._frame(child, self._pose(child, pose), inherited, moving)
            elif child.tag == "flexcomp":
                self._flexcomp(self._with_defaults(child, inherited), pose)
            elif child.tag in ("composite", "replicate", "attach", "plugin"):
                self.scene.note(child.place, f"{child.tag} has no counterpart and is left out")

    def _geom(self, geom: Element, above: Pose, free: bool) -> None:
        kind, size = geom.get("type", "mesh" if geom.get("mesh") else "sphere"), geom.numbers("size") or ()
        at, rotation = self._pose(geom, above)
        ends = geom.numbers("fromto", 6)
        name = geom.get("name") or f"{kind} {len(self.scene.obstacles)}"
        friction = (geom.numbers("friction") or (FRICTION,))[0]
        needed = {"sphere": 1, "capsule": 2, "cylinder": 2, "box": 3, "ellipsoid": 3}.get(kind, 0)
        if ends is not None and kind in ("capsule", "cylinder", "box", "ellipsoid"):
            low, high = np.array(ends[:3]), np.array(ends[3:])
            at, along = above[0] + above[1] @ ((low + high) / 2), high - low
            if not np.linalg.norm(along) > 0:
                raise UserError(f"{geom.place}: fromto of geom {name} has no length")
            rotation = above[1] @ poses.turn_between((0, 0, 1), along)
            size = (*size[: needed - 1], float(np.linalg.norm(along)) / 2)
        if len(size) < needed or any(not value > 0 for value in size[:needed]):
            raise UserError(f"{geom.place}: geom {name} of type {kind} needs {needed} positive sizes, got {list(size)}")
        y_axis = poses.turn_between((0, 1, 0), (0, 0, 1))  # the local y axis of a collider is the local z axis of a geom
        own = Obstacle(kind, name, at, rotation, friction=friction)
        volume = 0.0
        if kind == "plane":
            own.rotation = rotation @ y_axis
        elif kind == "sphere":
            own.radius, volume = size[0], 4 / 3 * math.pi * size[0] ** 3
        elif kind in ("capsule", "cylinder"):
            own.rotation, own.radius, own.length = rotation @ y_axis, size[0], 2 * size[1]
            volume = math.pi * size[0] ** 2 * own.length + (4 / 3 * math.pi * size[0] ** 3 if kind == "capsule" else 0.0)
        elif kind == "box":
            own.kind, own.size, volume = "cuboid", tuple(2 * value for value in size[:3]), 8 * math.prod(size[:3])  # type: ignore[assignment]
        elif kind == "ellipsoid":
            own.kind, own.mesh, volume = "mesh", soft_shapes.ellipsoid_mesh(size[:3]), 4 / 3 * math.pi * math.prod(size[:3])
        elif kind == "mesh":
            own.mesh = collision_mesh(self._asset(geom), name, geom.place, self.scene)
            if own.mesh is None:
                return
            volume = abs(enclosed_volume(own.mesh))
        else:
            self.scene.note(geom.place, f"the geom {name} of type {kind} has no counterpart and is left out")
            return
        if free and kind != "plane":
            own.mass = geom.number("mass", geom.number("density", DENSITY) * volume)
        self.scene.obstacles.append(own)

    def _asset(self, geom: Element) -> TriangleMesh:
        mesh = self.meshes.get(geom.get("mesh"))
        if mesh is None:
            raise UserError(f"{geom.place}: the mesh {geom.get('mesh')!r} is not among the assets")
        mesh = self._with_defaults(mesh, "main")
        scale = np.array(mesh.numbers("scale", 3, (1.0, 1.0, 1.0)))
        if mesh.get("file"):
            found = self._mesh_file(mesh.get("file"), mesh)
        elif (points := mesh.numbers("vertex")) is not None and (faces := mesh.numbers("face")) is not None:
            found = clean_mesh(np.reshape(points, (-1, 3)), np.reshape(faces, (-1, 3)), f"{mesh.place}: the mesh")
        else:
            raise UserError(f"{mesh.place}: a mesh without a file needs vertex and face")
        return soft_shapes.stretched(found, scale)

    def _mesh_file(self, file: str, element: Element) -> TriangleMesh:
        path = self._named(file, element, self.compiler.get("meshdir") or self.compiler.get("assetdir", ""))
        if path.suffix.lower() not in TRIMESH_FORMATS:
            raise UserError(f"{element.place}: the mesh file {file} must end in {', '.join(TRIMESH_FORMATS)}; convert it")
        return read_mesh(path)

    def _flexcomp(self, flex: Element, above: Pose) -> None:
        name, kind = flex.get("name") or f"flex {len(self.scene.bodies)}", flex.get("type", "grid")
        count = flex.numbers("count", 3, (10.0, 10.0, 10.0))
        spacing = flex.numbers("spacing", 3, (0.02, 0.02, 0.02))
        assert count is not None and spacing is not None
        extent = [(n - 1) * step for n, step in zip(count, spacing)]
        solid = flex.get("dim", "2") == "3" or kind in ("box", "cylinder", "ellipsoid")
        if kind == "mesh" and flex.get("dof") in ("trilinear", "quadratic"):
            solid = True  # a shell in a solid lattice
        if not solid:
            what = "a rope" if flex.get("dim") == "1" else "a shell"
            self.scene.note(
                flex.place, f"the flexcomp {name} is {what} (dim {flex.get('dim', '2')}), which has no counterpart: it is left out"
            )
            return
        if kind in ("grid", "box", "cylinder", "ellipsoid"):
            if any(not side > 0 for side in extent):
                raise UserError(f"{flex.place}: the flexcomp {name} has no extent: count {list(count)}, spacing {list(spacing)}")
            make = {"cylinder": soft_shapes.cylinder_mesh, "ellipsoid": soft_shapes.ellipsoid_mesh}.get(kind, soft_shapes.box_mesh)
            mesh = make([side / 2 for side in extent])
        elif kind == "mesh":
            mesh = self._mesh_file(flex.get("file"), flex)
        elif kind == "direct":
            mesh = self._tetrahedra(flex, "point", name)
        else:
            self.scene.note(flex.place, f"the flexcomp {name} of type {kind} has no counterpart and is left out")
            return
        scale = flex.numbers("scale", 3, (1.0, 1.0, 1.0)) if kind in ("mesh", "direct") else (1.0, 1.0, 1.0)
        at, rotation = self._pose(flex, above)
        self._soft(flex, name, soft_shapes.stretched(mesh, np.array(scale)), at, rotation, flex.number("mass", 1.0))

    def _tetrahedra(self, flex: Element, points: str, name: str) -> TriangleMesh:
        at, elements = flex.numbers(points) or (), flex.numbers("element") or ()
        check_limit(len(elements), "NEUIDO_MAX_TRIANGLES", f"{flex.place}: {name} has {len(elements)} indices")
        if len(at) % 3 or len(elements) % 4 or not elements or any(index != int(index) for index in elements):
            raise UserError(f"{flex.place}: {name} needs {points} in threes and element in fours of whole numbers")
        return soft_shapes.tetrahedra_surface(np.reshape(at, (-1, 3)), np.reshape(elements, (-1, 4)).astype(int), f"{flex.place}: {name}")

    def _deformables(self, section: Element) -> None:
        for child in section.children:
            if child.tag != "flex":
                self.scene.note(child.place, f"{child.tag} has no counterpart and is left out")
                continue
            name = child.get("name") or f"flex {len(self.scene.bodies)}"
            if child.get("dim") != "3" or not child.get("vertex") or child.get("body", "world") != "world":
                self.scene.note(
                    child.place, f"the flex {name} is left out: only those of dim 3 with vertices in the world have a counterpart"
                )
                continue
            self._soft(child, name, self._tetrahedra(child, "vertex", name), np.zeros(3), np.eye(3), None)

    def _soft(self, flex: Element, name: str, mesh: TriangleMesh, at: np.ndarray, rotation: np.ndarray, mass: float | None) -> None:
        mesh = mesh._replace(vertices=mesh.vertices @ rotation.T + at)
        elasticity = flex.first("elasticity")
        law: dict = {"law": "neo_hookean"}
        if elasticity is not None and elasticity.number("young", 0.0) > 0:
            law |= {"young": elasticity.number("young", 0.0), "poisson": elasticity.number("poisson", 0.0)}
        else:
            self.scene.note(flex.place, f"{name} has no Young's modulus, its edges are held by constraints: --young gives one")
        if elasticity is not None and elasticity.number("damping", 0.0):
            self.scene.note(elasticity.place, f"damping of {name} has no counterpart in a scene file: `Effects` in Python has a viscosity")
        for tag in ("edge", "pin", "contact"):
            own = flex.first(tag)
            if own is not None and (tag != "contact" or own.get("selfcollide", "auto") != "none"):
                what = {"edge": "constraints of its edges are", "pin": "its pins are", "contact": "contact of the body with itself is"}[tag]
                self.scene.note(own.place, f"{name}: {what} left out" + (" (clamps of a scene file hold boxes)" if tag == "pin" else ""))
        volume = abs(enclosed_volume(mesh))
        if not volume > 0:
            raise UserError(f"{flex.place}: {name} encloses no volume")
        density = mass / volume if mass is not None else None
        if density is not None and not density > 0:
            raise UserError(f"{flex.place}: mass = {mass} of {name} must be positive")
        self.scene.bodies.append(SoftBody(name, mesh, density=density, elasticity=law))
