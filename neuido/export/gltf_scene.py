"""glTF 2.0 scenes of a motion (.glb, .gltf), through pygltflib.

What moves is written in the ways that common players show (glTF 2.0 specification, sections 3.7.2.2 "Morph Targets" and
3.11 "Animations"):

* particles and surfaces whose triangles stay the same: one morph target for each frame after the first, and an animation of the weights
  in which each frame has the weight one in turn. Between two frames, positions are interpolated.
* surfaces that are reconstructed in each frame: a mesh for each frame, shown one after another by a scale of one or zero. The
  specification names a scale of zero as the way to animate visibility.
* colliders on a path: translation and rotation of their node.

glTF is in metres, with +y up; a scene with +z up is turned as a whole.
"""

import base64
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from neuido.data.files.writing import atomic_write
from neuido.data.progress import Progress
from neuido.export.exchange import PALETTE, Exchange, Surface
from neuido.physics.runtime.lazy import import_extra
from neuido.types import Cameras

FLOAT, UNSIGNED_INT = 5126, 5125
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
POINTS, TRIANGLES = 0, 4
WIDTHS = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def write_gltf(path: Path, made: Exchange, *, speed: float = 1.0, progress: bool = False) -> list[Path]:
    """Write a motion as a glTF scene with one animation.

    Args:
        path: File ending in .glb (binary) or .gltf (JSON that contains its data).
        made: The motion.
        speed: Speed at which it plays: 0.1 is ten times slower than it happened.
        progress: Whether progress is shown on stderr.

    Raises:
        UserError: pygltflib is not installed.
    """
    library = import_extra("pygltflib", f"writing {path.name}", extra="gltf")
    with Progress("writing glTF", len(made.parts) + len(made.surfaces) + len(made.colliders), unit="parts", shown=progress) as work:
        scene = _Scene(library, made, speed)
        for number, part in enumerate(made.parts):
            x = np.ascontiguousarray(made.x[:, part.index])
            scene.morphed(part.name, list(x), None, None, PALETTE[number % len(PALETTE)])
            work.update()
        for surface in (*made.surfaces, *made.colliders):
            scene.surface(surface)
            work.update()
        if made.cameras is not None:
            scene.cameras(made.cameras)
        content = scene.finished()
    with atomic_write(path, keep_suffix=True) as hidden:
        if path.suffix.lower() == ".glb":
            content.set_binary_blob(bytes(scene.data))
            content.save_binary(str(hidden))
        else:
            content.buffers[0].uri = "data:application/octet-stream;base64," + base64.b64encode(scene.data).decode("ascii")
            content.save_json(str(hidden))
    return [path]


class _Scene:
    """A glTF scene that is being made.

    Args:
        library: pygltflib.
        made: The motion.
        speed: Speed at which it plays.
    """

    def __init__(self, library: Any, made: Exchange, speed: float) -> None:
        self.g, self.made, self.data = library, made, bytearray()
        self.out = library.GLTF2(asset=library.Asset(version="2.0", generator="neuido"))
        self.root = library.Node(name="World", children=[])
        if made.up == "Z":
            self.root.rotation = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]
        self.out.nodes.append(self.root)
        self.animation = library.Animation(name="motion", samplers=[], channels=[])
        self.moves = made.frames > 1
        self.times = (made.times - made.times[0]) / speed
        self.clock = self._accessor(self.times[:, None], bounds=True) if self.moves else -1

    def finished(self) -> Any:
        """Return the scene."""
        g, out = self.g, self.out
        if self.animation.channels:
            out.animations.append(self.animation)
        out.scenes, out.scene = [g.Scene(name="neuido", nodes=[0])], 0
        out.buffers = [g.Buffer(byteLength=len(self.data))]
        return out

    def _accessor(self, values: np.ndarray, *, target: int | None = None, bounds: bool = False) -> int:
        """Append an array (n, width), or (n,) of indices, and return the index of its accessor."""
        g, whole = self.g, values.dtype.kind in "iu"
        values = np.ascontiguousarray(values, np.uint32 if whole else np.float32)
        values = values[:, None] if values.ndim == 1 else values
        view = g.BufferView(buffer=0, byteOffset=len(self.data), byteLength=values.nbytes, target=target)
        self.data += values.tobytes()
        self.out.bufferViews.append(view)
        accessor = g.Accessor(
            bufferView=len(self.out.bufferViews) - 1, byteOffset=0, componentType=UNSIGNED_INT if whole else FLOAT, count=len(values),
            type=WIDTHS[values.shape[1]],
        )  # fmt: skip
        if bounds:
            accessor.min, accessor.max = values.min(axis=0).tolist(), values.max(axis=0).tolist()
        self.out.accessors.append(accessor)
        return len(self.out.accessors) - 1

    def _material(self, name: str, colour: tuple[float, float, float]) -> int:
        """Append a material of an sRGB colour, and return its index."""
        g = self.g
        linear = [((c + 0.055) / 1.055) ** 2.4 if c > 0.04045 else c / 12.92 for c in colour]
        shade = g.PbrMetallicRoughness(baseColorFactor=[*linear, 1.0], metallicFactor=0.0, roughnessFactor=0.6)
        self.out.materials.append(g.Material(name=name, pbrMetallicRoughness=shade, doubleSided=True, alphaCutoff=None))
        return len(self.out.materials) - 1

    def _node(self, name: str, **content: Any) -> int:
        self.out.nodes.append(self.g.Node(name=name, **content))
        index = len(self.out.nodes) - 1
        self.root.children.append(index)
        return index

    def _animate(self, node: int, path: str, values: np.ndarray, *, clock: int | None = None, kind: str = "LINEAR") -> None:
        g = self.g
        clock = self.clock if clock is None else clock
        self.animation.samplers.append(g.AnimationSampler(input=clock, output=self._accessor(values), interpolation=kind))
        target = g.AnimationChannelTarget(node=node, path=path)
        self.animation.channels.append(g.AnimationChannel(sampler=len(self.animation.samplers) - 1, target=target))

    def _mesh(self, name: str, x: np.ndarray, faces: np.ndarray | None, normals: np.ndarray | None, material: int) -> Any:
        g = self.g
        attributes = g.Attributes(POSITION=self._accessor(x, target=ARRAY_BUFFER, bounds=True))
        if normals is not None:
            attributes.NORMAL = self._accessor(normals, target=ARRAY_BUFFER)
        primitive = g.Primitive(attributes=attributes, mode=POINTS if faces is None else TRIANGLES, material=material)
        if faces is not None:
            primitive.indices = self._accessor(faces.reshape(-1).astype(np.uint32), target=ELEMENT_ARRAY_BUFFER)
        mesh = g.Mesh(name=name, primitives=[primitive])
        self.out.meshes.append(mesh)
        return mesh

    def morphed(
        self, name: str, x: Sequence[np.ndarray], faces: np.ndarray | None, normals: Sequence[np.ndarray] | None, colour: tuple
    ) -> None:
        """Add points or a mesh of fixed triangles, with a morph target for each frame after the first."""
        mesh = self._mesh(name, x[0], faces, None if normals is None else normals[0], self._material(name, colour))
        node = self._node(name, mesh=len(self.out.meshes) - 1)
        targets = len(x) - 1
        if not targets:
            return
        mesh.weights = [0.0] * targets
        mesh.extras = {"targetNames": [f"frame_{k + 1}" for k in range(targets)]}
        for k in range(1, len(x)):
            target = {"POSITION": self._accessor(x[k] - x[0], target=ARRAY_BUFFER, bounds=True)}
            if normals is not None:
                target["NORMAL"] = self._accessor(normals[k] - normals[0], target=ARRAY_BUFFER)
            mesh.primitives[0].targets.append(target)
        self._animate(node, "weights", np.eye(len(x), dtype=np.float32)[:, 1:].reshape(-1, 1))

    def surface(self, surface: Surface) -> None:
        """Add a surface or a collider."""
        if surface.remeshed:
            self._flip_book(surface)
        elif not surface.rigid:
            self.morphed(surface.name, surface.vertices, surface.faces[0], surface.normals, surface.colour)
        else:
            vertices, faces, normals = surface.at(0)
            self._mesh(surface.name, vertices, faces, normals, self._material(surface.name, surface.colour))
            node = self._node(surface.name, mesh=len(self.out.meshes) - 1)
            self._place(node, surface)

    def _place(self, node: int, surface: Surface) -> None:
        if surface.poses is None:
            return
        from scipy.spatial.transform import Rotation

        turns = Rotation.from_matrix(surface.poses[:, :3, :3]).as_quat()
        against = np.einsum("ki,ki->k", turns[1:], turns[:-1]) < 0
        turns[1:] *= np.cumprod(np.where(against, -1.0, 1.0))[:, None]  # the shorter way between two frames
        places = surface.poses[:, :3, 3]
        self.out.nodes[node].translation, self.out.nodes[node].rotation = places[0].tolist(), turns[0].tolist()
        if self.moves and len(turns) > 1:
            self._animate(node, "translation", places)
            self._animate(node, "rotation", turns)

    def _flip_book(self, surface: Surface) -> None:
        """Add a mesh for each frame, each visible at its time alone."""
        material = self._material(surface.name, surface.colour)
        for k in range(self.made.frames):
            vertices, faces, normals = surface.at(k)
            if not len(faces):
                continue
            self._mesh(f"{surface.name}_{k:04d}", vertices, faces, normals, material)
            node = self._node(f"{surface.name}_{k:04d}", mesh=len(self.out.meshes) - 1, scale=[float(k == 0)] * 3)
            first, last = k == 0, k == self.made.frames - 1
            keys = [0.0] if first else [0.0, self.times[k]]
            seen = [1.0] if first else [0.0, 1.0]
            if not last:
                keys, seen = [*keys, self.times[k + 1]], [*seen, 0.0]
            clock = self._accessor(np.array(keys)[:, None], bounds=True)
            self._animate(node, "scale", np.repeat(np.array(seen)[:, None], 3, axis=1), clock=clock, kind="STEP")

    def cameras(self, cameras: Cameras) -> None:
        """Add pinhole cameras; an offset of the principal point has no place in glTF and is noted."""
        g, offset = self.g, 0.0
        for i, (view, K) in enumerate(zip(cameras.viewmats.double().cpu().numpy(), cameras.Ks.double().cpu().numpy())):
            angle = 2 * float(np.arctan(cameras.height / (2 * K[1, 1])))
            lens = g.Perspective(yfov=angle, aspectRatio=cameras.width * K[1, 1] / (cameras.height * K[0, 0]), znear=0.001, zfar=1000.0)
            self.out.cameras.append(g.Camera(name=f"view_{i}", type="perspective", perspective=lens))
            pose = np.linalg.inv(view) @ np.diag([1.0, -1.0, -1.0, 1.0])
            self._node(f"view_{i}", camera=i, matrix=pose.T.reshape(-1).tolist())
            offset = max(offset, abs(K[0, 2] - cameras.width / 2), abs(K[1, 2] - cameras.height / 2))
        if offset > 0.5:
            self.made.notes.append(f"glTF has no place for principal points off the middle; they are up to {offset:.3g} px off")
