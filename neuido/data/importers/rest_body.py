"""The body at rest behind tracked points: the points themselves where they are a whole lattice, else particles that fill their hull."""

from typing import NamedTuple

import numpy as np

from neuido.errors import UserError

FILL = 600
"""Particles that fill a hull, about: some eight along an edge, so that a body is four or five cells thick."""
EVEN = 0.05
"""Relative scatter of the distances to the nearest point up to which points stand on a lattice."""
WHOLE = 0.9
"""Share of their hull that the cells of points on a lattice fill where none of them is missing."""
NEAREST = 12
"""Points from which the velocity of a particle is interpolated."""


class RestBody(NamedTuple):
    """Particles of a body in the first frame."""

    x0: np.ndarray
    """Positions [m], (P, 3)."""
    v0: np.ndarray
    """Velocities [m/s], (P, 3)."""
    volume: float
    """Of the whole body [m^3]."""
    spacing: float
    """Distance of neighbouring particles [m]."""
    filled: bool
    """Whether the particles fill the hull of the points; otherwise they are the points."""
    note: str
    """What was done, for the summary."""


def rest_body(points: np.ndarray, velocity: np.ndarray, volume: float | None, name: str) -> RestBody:
    """Return the body behind the points of a first frame.

    Args:
        points: Positions [m], (N, 3).
        velocity: Their velocities [m/s], (N, 3).
        volume: Volume of the body [m^3]; None: that of the convex hull of the points.
        name: Name of the recording in error messages.

    Raises:
        UserError: The points lie in a plane, and no volume is given.
    """
    from scipy.spatial import ConvexHull, QhullError

    nearest = _nearest(points)
    usual = float(np.median(nearest))
    try:
        hull = ConvexHull(points)
    except QhullError as error:
        if volume is None:
            raise UserError(f"{name}: the points of the first frame lie in a plane and enclose no volume: give --volume (m^3)") from error
        return RestBody(points, velocity, volume, max(usual, (volume / len(points)) ** (1 / 3)), False, "as stated (--volume)")
    total = float(hull.volume) if volume is None else volume
    origin = "convex hull of the first frame; --volume replaces it" if volume is None else "as stated"
    grown = float(hull.volume + hull.area * usual / 2)  # half a spacing belongs to the outermost points
    if float(np.std(nearest)) < EVEN * usual and len(points) * usual**3 > WHOLE * grown:
        return RestBody(points, velocity, total, usual, False, f"{origin}; the points are the particles")
    centre = points[hull.vertices].mean(axis=0)
    factor = (total / float(hull.volume)) ** (1 / 3)
    spacing = (total / FILL) ** (1 / 3)
    lower, upper = (centre + factor * (edge - centre) for edge in (points.min(axis=0), points.max(axis=0)))
    axes = [low + spacing * (np.arange(max(round((high - low) / spacing), 1)) + 0.5) for low, high in zip(lower, upper)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    shrunk = centre + (grid - centre) / factor
    x0 = grid[(shrunk @ hull.equations[:, :3].T + hull.equations[:, 3] <= 0).all(axis=1)]
    if len(x0) < 8:
        return RestBody(points, velocity, total, usual, False, f"{origin}; the body is too thin to be filled, the points are the particles")
    return RestBody(x0, _carried(points, velocity, x0), total, spacing, True, f"{origin}; filled with {len(x0)} particles")


def _nearest(points: np.ndarray) -> np.ndarray:
    """Return the distance of each point to its nearest neighbour [m], (N,)."""
    from scipy.spatial import KDTree

    return KDTree(points).query(points, k=2)[0][:, 1]


def _carried(points: np.ndarray, velocity: np.ndarray, x0: np.ndarray) -> np.ndarray:
    """Interpolate velocities from points to particles: a linear field is carried over exactly, and what it leaves by near points.

    Near points may lie in one plane, as markers on a face do, and determine no linear field of their own.
    """
    from scipy.interpolate import RBFInterpolator

    basis, own = (np.column_stack([np.ones(len(x)), x]) for x in (points, x0))
    field = np.linalg.lstsq(basis, velocity, rcond=None)[0]
    carry = RBFInterpolator(points, velocity - basis @ field, neighbors=min(NEAREST, len(points)), kernel="linear", degree=0)
    return own @ field + carry(x0)
