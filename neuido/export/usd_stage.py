"""USD stages of a motion (.usd, .usdc, .usda): points, meshes, cameras and Gaussians, through usd-core.

Source of the schemas: OpenUSD's UsdGeom (Points, Mesh, Camera, `metersPerUnit`, `upAxis`), UsdShade (UsdPreviewSurface) and UsdVol
(ParticleField3DGaussianSplat). One frame of the motion is one time code, so that every player shows every frame, and `timeCodesPerSecond`
says how many of them a second has.
"""

import math
import re
from pathlib import Path
from typing import Any

import numpy as np

from neuido.data.files.writing import atomic_write
from neuido.data.progress import Progress
from neuido.export.exchange import PALETTE, Exchange, Part, Surface
from neuido.physics.runtime.lazy import import_extra
from neuido.types import Cameras

APERTURE = 20.955
"""Horizontal aperture of the cameras, USD's default; the focal length is relative to it, in the same unit."""


def write_usd(path: Path, made: Exchange, *, speed: float = 1.0, progress: bool = False) -> list[Path]:
    """Write a motion as a USD stage.

    Args:
        path: File ending in .usd, .usdc (both binary) or .usda (text).
        made: The motion.
        speed: Speed at which it plays: 0.1 is ten times slower than it happened.
        progress: Whether progress is shown on stderr.

    Raises:
        UserError: usd-core is not installed.
    """
    Usd = import_extra("pxr.Usd", f"writing {path.name}", extra="usd")
    with atomic_write(path, keep_suffix=True) as hidden:
        stage = Usd.Stage.CreateNew(str(hidden))
        _Stage(stage, made, speed).write(progress)
        stage.GetRootLayer().Save()
        del stage
    return [path]


class _Stage:
    """A stage that is being written.

    Args:
        stage: The stage.
        made: The motion.
        speed: Speed at which it plays.
    """

    def __init__(self, stage: Any, made: Exchange, speed: float) -> None:
        from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, Vt

        self.Gf, self.Sdf, self.Usd, self.UsdGeom, self.UsdShade, self.Vt = Gf, Sdf, Usd, UsdGeom, UsdShade, Vt
        self.stage, self.made, self.speed = stage, made, np.float32(speed)
        rate = made.rate * speed
        UsdGeom.SetStageUpAxis(stage, made.up)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        stage.SetStartTimeCode(0)
        stage.SetEndTimeCode(made.frames - 1)
        stage.SetTimeCodesPerSecond(rate)
        stage.SetFramesPerSecond(rate)
        root = UsdGeom.Xform.Define(stage, "/World")
        stage.SetDefaultPrim(root.GetPrim())
        Usd.ModelAPI(root).SetKind("component")
        stage.SetMetadata("comment", f"neuido: metres, seconds; {made.frames} frames, {made.rate:.6g} a second, played at {speed:g} x")
        self.names: set[str] = set()

    def write(self, progress: bool) -> None:
        """Write all parts."""
        made = self.made
        writers: list[Any] = [self._points(part, i) for i, part in enumerate(made.parts)]
        writers += [self._mesh(surface, "surfaces") for surface in made.surfaces]
        writers += [self._mesh(surface, "colliders") for surface in made.colliders]
        if made.gaussians is not None:
            writers.append(self._gaussians())
        if made.cameras is not None:
            self._cameras(made.cameras)
        with Progress("writing USD", made.frames, unit="frames", shown=progress) as work:
            for k in range(made.frames):
                for write in writers:
                    write(k)
                work.update()

    def _path(self, *parts: str) -> str:
        """Return a path of valid names that no other prim has; the folders above it are made."""
        names = [self._name(part) for part in parts]
        above = "/World" + "".join(f"/{name}" for name in names[:-1])
        if above != "/World":
            self.UsdGeom.Scope.Define(self.stage, above)
        path, number = f"{above}/{names[-1]}", 1
        while path in self.names:
            number += 1
            path = f"{above}/{names[-1]}_{number}"
        self.names.add(path)
        return path

    @staticmethod
    def _name(text: str) -> str:
        name = re.sub(r"[^A-Za-z0-9_]", "_", text) or "_"
        return name if not name[0].isdigit() else f"_{name}"

    def _linear(self, colour: tuple[float, float, float]) -> Any:
        """Return an sRGB colour in linear RGB, in which USD has colours."""
        return self.Gf.Vec3f(*(((c + 0.055) / 1.055) ** 2.4 if c > 0.04045 else c / 12.92 for c in colour))

    def _shade(self, gprim: Any, path: str, colour: tuple[float, float, float]) -> None:
        """Give a prim its colour, as `displayColor` and as a preview surface."""
        linear = self._linear(colour)
        gprim.CreateDisplayColorPrimvar(self.UsdGeom.Tokens.constant).Set(self.Vt.Vec3fArray([linear]))
        material = self.UsdShade.Material.Define(self.stage, self._path("materials", path.rpartition("/")[2]))
        shader = self.UsdShade.Shader.Define(self.stage, material.GetPath().AppendChild("surface"))
        shader.CreateIdAttr("UsdPreviewSurface")
        shader.CreateInput("diffuseColor", self.Sdf.ValueTypeNames.Color3f).Set(linear)
        shader.CreateInput("roughness", self.Sdf.ValueTypeNames.Float).Set(0.6)
        material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
        self.UsdShade.MaterialBindingAPI.Apply(gprim.GetPrim()).Bind(material)

    def _extent(self, gprim: Any, points: np.ndarray, pad: float, k: int) -> None:
        low, high = points.min(axis=0) - pad, points.max(axis=0) + pad
        gprim.GetExtentAttr().Set(self.Vt.Vec3fArray.FromNumpy(np.stack([low, high]).astype(np.float32)), k)

    def _points(self, part: Part, number: int) -> Any:
        made, Vt, Tokens = self.made, self.Vt, self.UsdGeom.Tokens
        path = self._path("particles", part.name)
        points = self.UsdGeom.Points.Define(self.stage, path)
        self._shade(points, path, PALETTE[number % len(PALETTE)])
        points.CreateWidthsAttr().Set(Vt.FloatArray([made.width]))
        points.SetWidthsInterpolation(Tokens.constant)
        points.CreateIdsAttr().Set(Vt.Int64Array.FromNumpy(part.index.astype(np.int64)))
        points.CreateExtentAttr()
        place, velocity = points.CreatePointsAttr(), points.CreateVelocitiesAttr() if made.v is not None else None
        api, changing = self.UsdGeom.PrimvarsAPI(points), []
        for name, field in made.fields.items():
            whole = field.values.dtype.kind in "iu"
            kind = self.Sdf.ValueTypeNames.IntArray if whole else self.Sdf.ValueTypeNames.FloatArray
            primvar = api.CreatePrimvar(name, kind, Tokens.vertex)
            primvar.GetAttr().SetCustomDataByKey("unit", field.unit)
            array = Vt.IntArray if whole else Vt.FloatArray
            if field.values.ndim == 1:
                primvar.Set(array.FromNumpy(np.ascontiguousarray(field.values[part.index])))
            else:
                changing.append((primvar, field, array))

        def write(k: int) -> None:
            own = made.x[k][part.index]
            place.Set(Vt.Vec3fArray.FromNumpy(own), k)
            if velocity is not None and made.v is not None:
                velocity.Set(Vt.Vec3fArray.FromNumpy(self.speed * made.v[k][part.index]), k)  # per second of the stage's time
            self._extent(points, own, made.width / 2, k)
            for primvar, field, array in changing:
                primvar.Set(array.FromNumpy(np.ascontiguousarray(field.at(k)[part.index])), k)

        return write

    def _mesh(self, surface: Surface, folder: str) -> Any:
        Vt, Tokens = self.Vt, self.UsdGeom.Tokens
        path = self._path(folder, surface.name)
        mesh = self.UsdGeom.Mesh.Define(self.stage, path)
        self._shade(mesh, path, surface.colour)
        mesh.CreateSubdivisionSchemeAttr().Set(Tokens.none)
        mesh.CreateExtentAttr()
        places, counts, corners, normals = (
            mesh.CreatePointsAttr(), mesh.CreateFaceVertexCountsAttr(), mesh.CreateFaceVertexIndicesAttr(), mesh.CreateNormalsAttr()
        )  # fmt: skip
        mesh.SetNormalsInterpolation(Tokens.vertex)
        move = mesh.AddTransformOp() if surface.poses is not None else None
        still = self.Usd.TimeCode.Default()

        def write(k: int) -> None:
            vertices, faces, own = surface.at(k)
            if k == 0 or surface.remeshed:
                when = k if surface.remeshed else still
                counts.Set(Vt.IntArray(len(faces), 3), when)
                corners.Set(Vt.IntArray.FromNumpy(np.ascontiguousarray(faces.reshape(-1), np.int32)), when)
            if k == 0 or not surface.rigid:
                when = still if surface.rigid else k
                places.Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(vertices, np.float32)), when)
                normals.Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(own, np.float32)), when)
                if len(vertices):
                    self._extent(mesh, vertices, 0.0, when)
            if move is not None and surface.poses is not None and (k == 0 or len(surface.poses) > 1):
                move.Set(self.Gf.Matrix4d(*surface.pose(k).T.reshape(-1).tolist()), still if len(surface.poses) == 1 else k)

        return write

    def _cameras(self, cameras: Cameras) -> None:
        """Write pinhole cameras: OpenCV's axes (y down, z forward) become USD's (y up, looking along -z)."""
        for i, (view, K) in enumerate(zip(cameras.viewmats.double().cpu().numpy(), cameras.Ks.double().cpu().numpy())):
            camera = self.UsdGeom.Camera.Define(self.stage, self._path("cameras", f"view_{i}"))
            pose = np.linalg.inv(view) @ np.diag([1.0, -1.0, -1.0, 1.0])
            camera.AddTransformOp().Set(self.Gf.Matrix4d(*pose.T.reshape(-1).tolist()))
            fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
            focal = APERTURE * fx / cameras.width
            camera.CreateFocalLengthAttr().Set(float(focal))
            camera.CreateHorizontalApertureAttr().Set(APERTURE)
            camera.CreateVerticalApertureAttr().Set(float(focal * cameras.height / fy))
            camera.CreateHorizontalApertureOffsetAttr().Set(float((cameras.width / 2 - cx) * focal / fx))
            camera.CreateVerticalApertureOffsetAttr().Set(float((cy - cameras.height / 2) * focal / fy))
            camera.CreateClippingRangeAttr().Set(self.Gf.Vec2f(0.001, 1000.0))

    def _gaussians(self) -> Any:
        """Write the Gaussians as a particle field; harmonics are turned with the body."""
        from pxr import UsdVol

        Vt, moving = self.Vt, self.made.gaussians
        assert moving is not None
        field = UsdVol.ParticleField3DGaussianSplat.Define(self.stage, self._path("gaussians"))
        still = moving.ellipsoids(0)
        field.CreateRadianceSphericalHarmonicsDegreeAttr().Set(math.isqrt(still.harmonics.shape[1]) - 1)
        field.CreateOpacitiesAttr().Set(Vt.FloatArray.FromNumpy(still.opacities))
        attributes = (
            field.CreatePositionsAttr(), field.CreateOrientationsAttr(), field.CreateScalesAttr(),
            field.CreateRadianceSphericalHarmonicsCoefficientsAttr(),
        )  # fmt: skip
        extent = self.UsdGeom.Boundable(field.GetPrim()).CreateExtentAttr()

        def write(k: int) -> None:
            splats = moving.ellipsoids(k)
            quaternions = np.ascontiguousarray(splats.quaternions[:, [1, 2, 3, 0]])  # FromNumpy takes the real part last
            values = (
                Vt.Vec3fArray.FromNumpy(splats.means), Vt.QuatfArray.FromNumpy(quaternions), Vt.Vec3fArray.FromNumpy(splats.scales),
                Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(splats.harmonics.reshape(-1, 3))),
            )  # fmt: skip
            for attribute, value in zip(attributes, values):
                attribute.Set(value, k)
            pad = 3 * float(splats.scales.max())
            ends = np.stack([splats.means.min(axis=0) - pad, splats.means.max(axis=0) + pad])
            extent.Set(Vt.Vec3fArray.FromNumpy(ends.astype(np.float32)), k)

        return write
