"""VTK files of a motion: `NAME.pvd` lists the frames with their times, `NAME/PART_0000.vtp` and on hold them (ParaView), through vtk.

Source: VTK File Formats, "XML File Formats", PolyData; the collection file (.pvd) is ParaView's.
"""

from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

from neuido.data.files.writing import atomic_write, write_text
from neuido.data.progress import Progress
from neuido.export.exchange import Exchange
from neuido.export.series import frame_name, remove_other_frames, safe_name
from neuido.physics.runtime.lazy import import_extra


def write_vtk(path: Path, made: Exchange, *, progress: bool = False) -> list[Path]:
    """Write a motion as PolyData files of particles, surfaces and colliders, and a collection that lists them.

    The collection is written last, so that it never lists a file that is not there.

    Args:
        path: The collection, ending in .pvd.
        made: The motion.
        progress: Whether progress is shown on stderr.

    Returns:
        The collection, then the files.

    Raises:
        UserError: vtk is not installed.
    """
    import_extra("vtkmodules.vtkIOXML", f"writing {path.name}", extra="vtk")
    folder, written, lines = path.with_suffix(""), [], []
    series = [(safe_name(part.name), part) for part in made.parts]
    meshes = [(safe_name(surface.name), surface) for surface in (*made.surfaces, *made.colliders)]
    with Progress("writing VTK", made.frames, unit="frames", shown=progress) as work:
        for k in range(made.frames):
            at = float(made.times[k])
            for number, (name, content) in enumerate((*series, *meshes)):
                own = folder / frame_name(name, k, made.frames, ".vtp")
                data = _particles(made, content, k) if number < len(series) else _surface(content, k)
                _write(own, data)
                written.append(own)
                file = quoteattr(f"{folder.name}/{own.name}")
                lines.append(f'<DataSet timestep="{at:.9g}" part="{number}" name={quoteattr(name)} file={file}/>')
            work.update()
    text = ['<?xml version="1.0"?>', '<VTKFile type="Collection" version="0.1">', "<Collection>", *lines, "</Collection>", "</VTKFile>"]
    write_text(path, "\n".join(text) + "\n")
    for name, _ in (*series, *meshes):
        remove_other_frames(folder, name, ".vtp", written)
    return [path, *written]


def _write(path: Path, data: Any) -> None:
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    with atomic_write(path, keep_suffix=True) as hidden:
        writer = vtkXMLPolyDataWriter()
        writer.SetFileName(str(hidden))
        writer.SetDataModeToAppended()
        writer.EncodeAppendedDataOff()
        writer.SetCompressorTypeToLZ4()  # a fifth of the time of zlib
        writer.SetInputData(data)
        if not writer.Write():
            raise OSError(None, "the file could not be written whole", str(path))


def _array(name: str, values: np.ndarray) -> Any:
    from vtkmodules.util.numpy_support import numpy_to_vtk

    array = numpy_to_vtk(np.ascontiguousarray(values), deep=True)
    array.SetName(name)
    return array


def _points(x: np.ndarray) -> Any:
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkPolyData

    points = vtkPoints()
    points.SetData(_array("points", x.astype(np.float32)))
    data = vtkPolyData()
    data.SetPoints(points)
    return data


def _cells(index: np.ndarray) -> Any:
    """Return cells (n, size) of point indices."""
    from vtkmodules.vtkCommonDataModel import vtkCellArray

    cells = vtkCellArray()
    offsets = np.arange(len(index) + 1, dtype=np.int64) * index.shape[1]
    cells.SetData(_array("offsets", offsets), _array("connectivity", index.reshape(-1).astype(np.int64)))
    return cells


def _particles(made: Exchange, part: Any, k: int) -> Any:
    data = _points(made.x[k][part.index])
    data.SetVerts(_cells(np.arange(len(part.index))[:, None]))
    values = data.GetPointData()
    if made.v is not None:
        values.AddArray(_array("velocity [m/s]", made.v[k][part.index]))
    if made.F is not None:
        values.AddArray(_array("deformation_gradient", made.F[k][part.index].reshape(-1, 9)))
    for name, field in made.fields.items():
        values.AddArray(_array(name if field.unit == "1" else f"{name} [{field.unit}]", field.at(k)[part.index]))
    return data


def _surface(surface: Any, k: int) -> Any:
    vertices, faces, normals = surface.placed(k)
    data = _points(vertices)
    data.SetPolys(_cells(faces))
    data.GetPointData().SetNormals(_array("normals", normals.astype(np.float32)))
    return data
