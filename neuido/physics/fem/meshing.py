"""Meshing of a body of particles by linear tetrahedra: a lattice of cells along the axes of the body, with 5 or 6 tetrahedra per cell.

If the particles lie on a regular lattice, the mesh has the cells of that lattice. Else each particle fills a cube of its volume, and a cell
belongs to the body if it is at least half full. The number of cells along each axis is chosen so that few cells are partly full; plane
faces of the body then stay plane. If many cells are partly full all the same, the body is curved, and the outer nodes are moved onto the
surface.
"""

import itertools
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from neuido.errors import UserError
from neuido.physics.linalg.extent import box_axes, without_volume
from neuido.physics.runtime.limits import check_memory

PER_PARTICLE = 1.0
"""Elements per particle if no number of elements is given."""
LOOSE = 1.1
"""Ratio of the volumes of mesh and particles up to which the mesh is scaled to the volume of the particles."""
CURVED = 0.12
"""Share of partly full cells above which a body counts as curved, and the steps of its surface are smoothed."""
STIFFENING = 2.5
"""Largest factor by which the smoothing may raise `stiffness_bound`; the number of inner steps rises by its square root."""
EVEN_CORNERS = ((0, 0, 0), (1, 1, 0), (1, 0, 1), (0, 1, 1))
"""Corners of a cell whose coordinates have an even sum, the corners of the inner tetrahedron of five."""
ELEMENT_BYTES = 1500
"""Memory that an element takes while the mesh is made [bytes]; 1240 for 169,000 elements of 3,000 scattered particles."""
TOGETHER = 1e-3
"""Distance, as a share of their size, below which particles count as being in one place."""


class Mesh(NamedTuple):
    """A mesh of N nodes and E linear tetrahedra."""

    nodes: Tensor
    """Positions at t = 0 [m], (N, 3) float64."""
    elements: Tensor
    """Nodes of each element, ordered so that its volume is positive, (E, 4) int64."""

    @property
    def volume(self) -> Tensor:
        """Volume of each element [m^3], (E,)."""
        corners = self.nodes[self.elements]
        return torch.linalg.det(corners[:, 1:] - corners[:, :1]) / 6.0

    @property
    def gradients(self) -> Tensor:
        """Gradients of the four shape functions of each element [1/m], (E, 4, 3)."""
        corners = self.nodes[self.elements]
        last = torch.linalg.inv(corners[:, 1:] - corners[:, :1]).mT
        return torch.cat([-last.sum(dim=1, keepdim=True), last], dim=1)

    def __repr__(self) -> str:
        return f"Mesh({len(self.nodes)} nodes, {len(self.elements)} elements)"


def tetrahedra_of(cells: np.ndarray, kind: int) -> np.ndarray:
    """Divide lattice cells into tetrahedra.

    With five, a large tetrahedron lies inside and one on each of four corners; neighbouring cells are mirror images, so that their faces
    match. With six, all share a diagonal of the cell (Freudenthal 1942).

    Args:
        cells: Indices of the cells, (n, 3).
        kind: Tetrahedra per cell, 5 or 6.

    Returns:
        Lattice indices of the corners, (n, kind, 4, 3).

    Raises:
        UserError: Another kind.
    """
    if kind == 6:
        rows = []
        for order in itertools.permutations(range(3)):
            path = np.zeros((4, 3), dtype=np.int64)
            for n, axis in enumerate(order):
                path[n + 1] = path[n]
                path[n + 1, axis] += 1
            rows.append(path)
        pattern = np.repeat(np.stack(rows)[None], 2, axis=0)
    elif kind == 5:
        pattern = np.stack([_five_tetrahedra(parity) for parity in (0, 1)])
    else:
        raise UserError(f"tetrahedra must be 5 or 6, got {kind}")
    return pattern[cells.sum(axis=1) % 2] + cells[:, None, None]


def _five_tetrahedra(parity: int) -> np.ndarray:
    """Return the corners of five tetrahedra in a unit cell, (5, 4, 3); `parity` 0 or 1 selects one of two mirror images."""
    inner = [tuple((c + parity) % 2 for c in corner) for corner in EVEN_CORNERS]
    rows = [inner]
    for corner in itertools.product((0, 1), repeat=3):
        if corner not in inner:
            rows.append([corner, *(other for other in inner if sum(a != b for a, b in zip(corner, other)) == 1)])
    return np.array(rows)


def stiffness_bound(mesh: Mesh) -> Tensor:
    """Compute the largest eigenvalue of the sum of grad N grad N^T over the corners of each element.

    Four times it, times P-wave modulus over density, bounds the square of the highest frequency of the element and so its stable step.

    Args:
        mesh: The mesh.

    Returns:
        Eigenvalues [1/m^2], (E,).
    """
    gradients = mesh.gradients
    return torch.linalg.eigvalsh(gradients.mT @ gradients)[:, -1]


def mesh_of_cells(cells: np.ndarray, origin: np.ndarray, axes: np.ndarray, kind: int = 5) -> Mesh:
    """Mesh the cells of a lattice.

    Args:
        cells: Indices of the cells, (n, 3).
        origin: Position of the corner of cell (0, 0, 0) [m], (3,).
        axes: Edge vectors of a cell as rows [m], (3, 3).
        kind: Tetrahedra per cell, 5 or 6.
    """
    corners = tetrahedra_of(cells - cells.min(axis=0), kind).reshape(-1, 3)
    places, index = np.unique(corners, axis=0, return_inverse=True)
    nodes = torch.from_numpy(origin + (places + cells.min(axis=0)) @ axes)
    return oriented(nodes, torch.from_numpy(index.reshape(-1, 4)))


def oriented(nodes: Tensor, elements: Tensor) -> Mesh:
    """Create a mesh, and reorder the nodes of elements with a negative volume.

    Args:
        nodes: Positions [m], (N, 3).
        elements: Nodes of each element, (E, 4).

    Raises:
        UserError: An element without volume, or a node that belongs to no element.
    """
    nodes, elements = nodes.double(), elements.long()
    volume = Mesh(nodes, elements).volume
    flat = volume.abs() <= 1e-6 * volume.abs().mean()
    if bool(flat.any()):
        raise UserError(f"element {int(flat.nonzero()[0])} of the mesh has no volume; mesh the body again, or remove the element")
    if len(torch.unique(elements)) != len(nodes):
        raise UserError(f"{len(nodes) - len(torch.unique(elements))} nodes of the mesh belong to no element; remove them")
    return Mesh(nodes, torch.where((volume < 0)[:, None], elements[:, [0, 1, 3, 2]], elements))


def mesh_body(x: Tensor, volume: Tensor, *, elements: int | None = None, kind: int = 5) -> Mesh:
    """Mesh the body that particles fill.

    The mesh has the volume of the particles, unless these leave gaps between them (`LOOSE`).

    Args:
        x: Positions [m], (P, 3).
        volume: Volumes [m^3], (P,).
        elements: Approximate number of elements; by default `PER_PARTICLE` times the number of particles. If the particles lie on a
            lattice whose cells give no more elements than that, the mesh has these cells.
        kind: Tetrahedra per cell, 5 or 6.

    Raises:
        UserError: No particles, too few elements or more than fit into memory, or particles that span no
            volume or fill no cell.
    """
    points, weight = x.double().cpu().numpy(), volume.double().cpu().numpy()
    if not len(points):
        raise UserError("a body without particles cannot be meshed; give at least one")
    apart = len(np.unique(np.round((points - points[0]) / (TOGETHER * np.cbrt(weight.mean()))), axis=0))
    if apart < kind:
        raise UserError(f"a body of {apart} particle{'s' if apart > 1 else ''} in different places has no mesh, which needs {kind}: "
                        "give more particles or a mesh, or use material points")  # fmt: skip
    if flat := without_volume(points):
        raise UserError(f"the {len(points)} particles of a body {flat}, which has no mesh: give layers or a mesh, or use material points")
    wanted = PER_PARTICLE * len(points) if elements is None else float(elements)
    if not kind <= wanted < np.inf:
        raise UserError(f"elements is {elements}; give at least {kind}, the tetrahedra of one cell")
    check_memory(round(ELEMENT_BYTES * wanted), "cpu", f"a mesh of {wanted:.4g} elements", "lower `elements`")
    total = weight.sum()
    edge = (kind * total / wanted) ** (1 / 3)
    lattice = lattice_of(points)
    if lattice is not None:
        origin, axes, index = lattice
        size = np.linalg.norm(axes, axis=1)
        if kind * len(points) <= 1.05 * wanted:
            return _scaled(mesh_of_cells(index, origin - 0.5 * axes.sum(axis=0), axes, kind), total)
        turn = axes / size[:, None]
        lower, upper = (index.min(axis=0) - 0.5) * size + turn @ origin, (index.max(axis=0) + 0.5) * size + turn @ origin
        spread = np.broadcast_to(size, points.shape)
    else:
        turn = box_axes(points)
        # if cells are hardly larger than particles, larger cubes keep the fill of the cells uniform
        wide = min(max(2.2 - 0.8 * edge / np.cbrt(weight.mean()), 1.0), 2.0)
        spread = np.repeat(wide * np.cbrt(weight)[:, None], 3, axis=1)
        lower, upper = _faces(points @ turn.T, weight)
    q = points @ turn.T
    counts, filled, misfit = _best_counts(q, weight, spread, lower, upper, edge)
    size = (upper - lower) / counts
    occupied = filled.sum() * size.prod()
    if occupied > LOOSE * total:  # the particles leave gaps between them: a cell is full at half of their mean density
        counts, filled, misfit = _best_counts(q, weight, spread, lower, upper, edge, level=0.5 * total / occupied)
        size = (upper - lower) / counts
    cells = np.argwhere(filled)
    mesh = mesh_of_cells(cells, lower @ turn, size[:, None] * turn, kind)
    if misfit > CURVED:
        level = 0.5 * min(total / occupied, 1.0) if occupied > LOOSE * total else 0.5
        mesh = _fit_surface(mesh, torch.from_numpy(points), torch.from_numpy(weight), level, float(size.max()))
    return _scaled(mesh, total)


def _fit_surface(mesh: Mesh, x: Tensor, volume: Tensor, level: float, edge: float) -> Mesh:
    """Move the outer nodes to where the density of the particles, smoothed over half a cell, equals `level`."""
    order = mesh.elements[:, [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]].reshape(-1, 3).sort(dim=1).values
    face, count = torch.unique(order, dim=0, return_counts=True)
    outer = torch.unique(face[count == 1])
    start, sigma = mesh.nodes[outer], 0.5 * edge
    place = start.clone()
    for _ in range(6):
        for own in torch.arange(len(outer)).split(512):
            arm = (place[own, None] - x) / sigma
            density = volume * torch.exp(-0.5 * arm.square().sum(dim=-1)) / (sigma * (2 * np.pi) ** 0.5) ** 3
            slope = -(density[..., None] * arm).sum(dim=1) / sigma
            move = (level - density.sum(dim=1))[:, None] * slope / slope.square().sum(dim=1, keepdim=True).clamp(min=1e-30)
            place[own] += move * (0.25 * edge / move.norm(dim=1, keepdim=True)).clamp(max=1.0)
    shift = torch.zeros_like(mesh.nodes)
    shift[outer] = (place - start) * (0.7 * edge / (place - start).norm(dim=1, keepdim=True)).clamp(max=1.0)
    limit = STIFFENING * stiffness_bound(mesh).max()
    for _ in range(12):  # flat elements would need more inner steps, so the shift of their nodes is reduced
        moved = mesh._replace(nodes=mesh.nodes + shift)
        thin = (stiffness_bound(moved) > limit) | (moved.volume <= 0)
        if not bool(thin.any()):
            return moved
        shift[torch.unique(mesh.elements[thin])] *= 0.6
    return mesh


def _scaled(mesh: Mesh, total: float) -> Mesh:
    """Scale the mesh about its centre to the volume `total`; unchanged if its own volume differs by more than `LOOSE`."""
    volume = mesh.volume
    if not 1 / LOOSE <= float(volume.sum()) / total <= LOOSE:
        return mesh
    centre = (volume[:, None] * mesh.nodes[mesh.elements].mean(dim=1)).sum(dim=0) / volume.sum()
    return mesh._replace(nodes=centre + (mesh.nodes - centre) * float(total / volume.sum()) ** (1 / 3))


def lattice_of(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Find the rectangular lattice on which all points lie, to 2 % of its spacing.

    Args:
        x: Points [m], (P, 3).

    Returns:
        Origin [m], (3,), edge vectors as rows [m], (3, 3), and lattice indices of the points, (P, 3); None without such a lattice.
    """
    if len(x) < 8:
        return None
    middle = x[np.argmin(((x - x.mean(axis=0)) ** 2).sum(axis=1))]
    d = x - middle
    near = d[np.argsort((d**2).sum(axis=1))[1:40]]
    axes: list[np.ndarray] = []
    for v in near:
        if all(abs(v @ a) <= 0.02 * np.linalg.norm(v) * np.linalg.norm(a) for a in axes):
            axes.append(v)
        if len(axes) == 3:
            break
    if len(axes) < 3:
        return None
    basis, origin = np.stack(axes), middle
    order = np.argsort((d**2).sum(axis=1))
    for share in (0.02, 0.2, 1.0):  # first near the middle, where rounding to lattice indices is safe
        own = order[: max(27, int(share * len(x)))]
        index = np.rint((x[own] - origin) @ np.linalg.inv(basis))
        if np.linalg.matrix_rank(index - index.mean(axis=0)) < 3:
            continue
        fit, *_ = np.linalg.lstsq(np.column_stack([index, np.ones(len(own))]), x[own], rcond=None)
        basis, origin = fit[:3], fit[3]
    place = (x - origin) @ np.linalg.inv(basis)
    index = np.rint(place)
    cosines = basis @ basis.T / np.outer(*[np.linalg.norm(basis, axis=1)] * 2)
    if np.abs(place - index).max() > 0.02 or np.abs(cosines - np.eye(3)).max() > 0.01:
        return None
    if len(np.unique(index, axis=0)) < len(x):
        return None
    index = index.astype(np.int64)
    return origin + index.min(axis=0) @ basis, basis, index - index.min(axis=0)


def _faces(q: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Estimate the lower and upper face of the body along each axis [m], (3,) each.

    A line is fitted to the volume beyond a position within the outer layer of particles; the face is where the line reaches zero.
    """
    out = np.empty((2, 3))
    h = np.cbrt(weight.mean())
    for a in range(3):
        for side, sign in enumerate((1.0, -1.0)):
            place = sign * q[:, a]
            order = np.argsort(place)
            place, mass = place[order], weight[order]
            beyond = np.cumsum(mass) - 0.5 * mass
            layer = place <= place[0] + min(6.0 * h, 0.4 * (place[-1] - place[0]))
            end = place[0] - 0.4 * h
            if layer.sum() >= 8:
                slope, offset = np.polyfit(place[layer], beyond[layer], 1)
                end = np.clip(-offset / slope, place[0] - 0.8 * h, place[0]) if slope > 0 else end
            out[side, a] = sign * end
    return out[0], out[1]


def _best_counts(
    q: np.ndarray, weight: np.ndarray, spread: np.ndarray, lower: np.ndarray, upper: np.ndarray, edge: float, level: float = 0.5
) -> tuple[np.ndarray, np.ndarray, float]:
    """Choose the number of cells along each axis so that cells are near `edge` [m] in size and few are partly full.

    Args:
        q: Positions along the axes of the body [m], (P, 3).
        weight: Volume of each particle [m^3], (P,).
        spread: Edges of the cube that each particle fills [m], (P, 3).
        lower: Lower faces of the body [m], (3,).
        upper: Upper faces [m], (3,).
        edge: Wanted size of a cell [m].
        level: Fill from which a cell belongs to the body [-].

    Returns:
        Numbers of cells (3,), which cells are full (nx, ny, nz), and the share of partly full cells.

    Raises:
        UserError: No cell is full.
    """
    steps = (np.arange(4) + 0.5) / 4 - 0.5
    offsets = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    points = (q[:, None] + offsets * spread[:, None]).reshape(-1, 3)
    share = np.repeat(weight / len(offsets), len(offsets))
    extent = upper - lower
    options = [sorted({max(1, round(float(e) / edge * f)) for f in (0.85, 0.93, 1.0, 1.07, 1.15)}) for e in extent]
    place = (points - lower) / extent
    best = None
    for counts in itertools.product(*options):
        n = np.array(counts)
        cell = np.clip((place * n).astype(np.int64), 0, n - 1)
        fill = np.bincount(np.ravel_multi_index(tuple(cell.T), counts), share, minlength=int(n.prod())) / (extent / n).prod()
        full = _without_holes((fill >= level).reshape(counts)).ravel()
        misfit = np.abs(np.minimum(fill / (2 * level), 1.0) - full).sum() / max(full.sum(), 1)
        shape = np.log(extent / n / edge)
        cost = 3.0 * misfit + 0.3 * np.abs(shape).max() + np.abs(shape.mean())
        if full.any() and (best is None or cost < best[0]):
            best = (cost, n, full.reshape(counts), misfit)
    if best is None:
        raise UserError(
            f"the particles fill no cell of the mesh; raise `elements`, or check their volumes, {weight.sum():.3g} m^3 together"
        )
    return best[1:]


def _without_holes(full: np.ndarray) -> np.ndarray:
    """Fill cells with five or six full neighbours: where particles are sparse, a cell inside the body may be less than half full."""
    padded = np.pad(full, 1).astype(np.int64)
    middle = slice(1, -1)
    around = sum(
        padded[tuple(slice(1 + d, padded.shape[b] - 1 + d) if b == a else middle for b in range(3))] for a in range(3) for d in (-1, 1)
    )
    return full | (around >= 5)
