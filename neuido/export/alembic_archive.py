"""Alembic archives (.abc) of a motion: points and meshes with velocities and normals, through alembic3d.

alembic3d is an unofficial build of Alembic's own Python bindings; the Alembic project publishes no wheel. Cameras and fields are left out.
"""

from pathlib import Path
from typing import Any

import numpy as np

from neuido.data.files.writing import atomic_write
from neuido.data.progress import Progress
from neuido.export.exchange import Exchange, Part, Surface
from neuido.physics.runtime.lazy import import_extra


def write_alembic(path: Path, made: Exchange, *, speed: float = 1.0, progress: bool = False) -> list[Path]:
    """Write a motion as an Alembic archive.

    Args:
        path: File ending in .abc.
        made: The motion.
        speed: Speed at which it plays: 0.1 is ten times slower than it happened.
        progress: Whether progress is shown on stderr.

    Raises:
        UserError: alembic3d is not installed.
    """
    import_extra("alembic3d", f"writing {path.name} (.usd holds the same and needs the extra `usd` alone)", extra="alembic")
    with atomic_write(path, keep_suffix=True) as hidden:
        archive = _Archive(hidden, made, speed)
        with Progress("writing Alembic", made.frames, unit="frames", shown=progress) as work:
            for k in range(made.frames):
                archive.write(k)
                work.update()
        del archive  # an archive is complete when its last object is gone
    return [path]


class _Archive:
    """An archive that is being written.

    Args:
        path: The file.
        made: The motion.
        speed: Speed at which it plays.
    """

    def __init__(self, path: Path, made: Exchange, speed: float) -> None:
        import imath  # type: ignore[import-not-found]  # of an extra that the checks go without
        from alembic3d import Abc, AbcCoreAbstract, AbcGeom  # type: ignore[import-not-found]

        self.imath, self.geom, self.made, self.speed = imath, AbcGeom, made, np.float32(speed)
        self.archive = Abc.OArchive(str(path))
        interval = 1.0 / (made.rate * speed)
        clock = self.archive.addTimeSampling(AbcCoreAbstract.TimeSampling(interval, 0.0))
        top = self.archive.getTop()
        self.points = [(part, AbcGeom.OPoints(top, f"particles_{part.name}", clock)) for part in made.parts]
        self.meshes = []
        for surface in (*made.surfaces, *made.colliders):
            self.meshes.append((surface, AbcGeom.OPolyMesh(top, surface.name, clock)))

    def write(self, k: int) -> None:
        """Write a frame."""
        for part, points in self.points:
            points.getSchema().set(self._points(part, k))
        for surface, mesh in self.meshes:
            mesh.getSchema().set(self._mesh(surface, k))

    def _vectors(self, values: np.ndarray) -> Any:
        out = self.imath.V3fArray(len(values))
        np.asarray(memoryview(out))[:] = values
        return out

    def _integers(self, values: np.ndarray) -> Any:
        out = self.imath.IntArray(len(values))
        np.asarray(memoryview(out))[:] = values
        return out

    def _floats(self, values: list[float]) -> Any:
        out = self.imath.FloatArray(len(values))
        np.asarray(memoryview(out))[:] = values
        return out

    def _points(self, part: Part, k: int) -> Any:
        made, geom, ids = self.made, self.geom, self._integers(part.index)
        width = geom.OFloatGeomParamSample(self._floats([made.width]), geom.GeometryScope.kConstantScope)
        v = np.zeros_like(made.x[k]) if made.v is None else made.v[k]
        return geom.OPointsSchemaSample(self._vectors(made.x[k][part.index]), ids, self._vectors(self.speed * v[part.index]), width)

    def _mesh(self, surface: Surface, k: int) -> Any:
        vertices, faces, normals = surface.placed(k)
        backwards = faces[:, ::-1].reshape(-1)  # Alembic's faces go clockwise
        counts = np.full(len(faces), 3)
        own = self.geom.ON3fGeomParamSample(self._vectors(normals), self.geom.GeometryScope.kVertexScope)
        empty = self.geom.OV2fGeomParamSample()
        return self.geom.OPolyMeshSchemaSample(self._vectors(vertices), self._integers(backwards), self._integers(counts), empty, own)
