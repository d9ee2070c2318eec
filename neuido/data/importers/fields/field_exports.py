"""Readers of full-field displacements by digital image correlation: VIC-2D, VIC-3D, ARAMIS, DICe, pyvale, Ncorr and muDIC."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from neuido.data.files.parsing import parser_errors
from neuido.data.importers.fields.matlab_file import read_variable
from neuido.data.importers.tables.titled_tables import read_titled
from neuido.data.importers.tables.titles import bare_title
from neuido.errors import UserError
from neuido.physics.runtime.limits import check_limit

LAYOUTS = {  # name: titles of the coordinates, of the displacements, of a column that says whether a point was found, its value if not
    "VIC-3D": (("X", "Y", "Z"), ("U", "V", "W"), "sigma", -1.0),
    "VIC-2D, calibrated": (("x_c", "y_c"), ("u_c", "v_c"), "sigma", -1.0),
    "VIC-2D": (("x", "y"), ("u", "v"), "sigma", -1.0),
    "DICe": (("COORDINATE_X", "COORDINATE_Y"), ("DISPLACEMENT_X", "DISPLACEMENT_Y"), "SIGMA", -1.0),
    "pyvale": (("subset_x", "subset_y"), ("displacement_u", "displacement_v"), "converged", 0.0),
    "ARAMIS": (("x", "y", "z"), ("displacement_x", "displacement_y", "displacement_z"), "", 0.0),
    "ARAMIS, plane": (("x", "y"), ("displacement_x", "displacement_y"), "", 0.0),
    "nodes": (("x", "y"), ("ux", "uy"), "", 0.0),
}
"""Titles, without their units, of the layouts of text; the first whose titles are all there counts."""
BINARY = (".mat", ".npy")


class Field(NamedTuple):
    """Displacements of the points of one specimen in one image."""

    x: np.ndarray
    """Places in the first image, (n, 2 or 3), in any unit."""
    u: np.ndarray
    """Displacements since the first image in the same unit, (n, 2 or 3)."""
    layout: str
    """What wrote the file."""


def layout_of(titles: Sequence[str]) -> str | None:
    """Return the layout of a table by its titles; None if it is no full field."""
    bare = [_bare(title) for title in titles]
    return next((name for name, (x, u, *_) in LAYOUTS.items() if set(x) <= set(bare) and set(u) <= set(bare)), None)


def read_fields(path: Path) -> list[Field]:
    """Read the images of one file: one of a text file, all of Ncorr's .mat and muDIC's .npy.

    Raises:
        UserError: The layout is unknown, or the file is malformed.
    """
    fields = _ncorr(path) if path.suffix.lower() == ".mat" else _mudic(path) if path.suffix.lower() == ".npy" else [_text(path)]
    out = []
    for field in fields:
        known = np.isfinite(field.x).all(axis=1) & np.isfinite(field.u).all(axis=1)
        if known.sum() < 4:
            raise UserError(f"{path}: an image has {known.sum()} points with a displacement; at least 4 are needed")
        out.append(Field(field.x[known], field.u[known], field.layout))
    return out


def _bare(title: str) -> str:
    """Return a title without its unit; letters keep their size, since VIC's X and x differ."""
    title = re.sub(r"\s*[\[(<].*$", "", title.strip().strip('"'))
    return title if title in ("X", "Y", "Z", "U", "V", "W") or title.isupper() else bare_title(title).replace(" ", "_")


def _text(path: Path) -> Field:
    table = read_titled(path)
    layout = layout_of(table.titles)
    if layout is None:
        titles = ", ".join(filter(None, table.titles))
        raise UserError(f"{path} has no coordinates and displacements of points (titles: {titles[:150]}): export x, y, u and v")
    bare = [_bare(title) for title in table.titles]
    x, u, quality, bad = LAYOUTS[layout]
    kept = np.ones(len(table.data), bool)
    if quality in bare:
        kept = table.data[:, bare.index(quality)] != bad
    return Field(*(table.data[kept][:, [bare.index(title) for title in titles]] for titles in (x, u)), layout)


def _ncorr(path: Path) -> list[Field]:
    if not path.is_file():
        raise UserError(f"{path} is missing")
    with parser_errors(path, "MATLAB file of Ncorr"):
        saved = read_variable(path, "data_dic_save")
        if saved is None:
            raise UserError(f"{path} has no data_dic_save: save the analysis in Ncorr, as a MATLAB file of version 7")
        (parts,) = saved.parts("dispinfo", "displacements")
        (info,) = parts["dispinfo"].parts("pixtounits", "spacing")
        factor = info["pixtounits"].number() * (int(info["spacing"].number()) + 1)
        out = []
        for image in parts["displacements"].parts("plot_u_ref_formatted", "plot_v_ref_formatted", "roi_ref_formatted"):
            (region,) = image["roi_ref_formatted"].parts("mask")
            mask = region["mask"].values().astype(bool)
            u, v = (image[f"plot_{axis}_ref_formatted"].values().astype(float) for axis in "uv")
            if not mask.shape == u.shape == v.shape or mask.ndim != 2:
                raise UserError(f"{path}: mask and displacements of an image differ in shape: {mask.shape}, {u.shape}, {v.shape}")
            rows, columns = np.nonzero(mask)
            out.append(Field(factor * np.stack([columns, rows], 1).astype(float), np.stack([u[mask], v[mask]], 1), "Ncorr"))
    return out


def _mudic(path: Path) -> list[Field]:
    with parser_errors(path, "NumPy array of muDIC's coordinates"):
        array = np.load(path, mmap_mode="r", allow_pickle=False)
        if array.ndim != 5 or array.shape[1] != 2 or array.shape[-1] < 2 or array.dtype.kind != "f":
            raise UserError(f"{path} has the shape {array.shape}: save `fields.coords()` of muDIC, (elements, 2, n, m, images)")
        check_limit(array.size, "NEUIDO_MAX_ARRAY_ELEMENTS", f"{path} has {array.size} elements")
        places = np.moveaxis(np.array(array, float), (4, 1), (0, -1)).reshape(array.shape[-1], -1, 2)
    return [Field(places[0], place - places[0], "muDIC") for place in places]
