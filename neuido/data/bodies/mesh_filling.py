"""Fill a closed mesh evenly with particles: a lattice in its depth, and under its surface particles that are relaxed.

The fine cells inside the mesh are shared out. Those of a lattice cell that lies in the depth belong to the particle at its centre. Those
under the surface belong to the nearest of particles that move to the centroids of their shares (Lloyd's method). They start in the lattice
cells that are at least half full; Poisson disks fill what lies far from these. The volume of a particle is its share.
"""

import math

import numpy as np
from scipy import ndimage
from scipy.spatial import KDTree

from neuido.data.bodies.scanlines import Inside, enclosed_volume, find_inside, lattice_around, open_edges
from neuido.data.bodies.triangle_mesh import TriangleMesh, clean_mesh
from neuido.errors import UserError
from neuido.physics.runtime.lazy import import_extra
from neuido.physics.runtime.limits import check_limit, check_memory

FINE = 3
"""Fine cells along the edge of a lattice cell."""
FINE_BYTES = 24
"""Memory of a fine cell [bytes]: its winding number and its sums, measured."""
GAP = 0.9
"""Distance from all particles, over the spacing, beyond which a further one is placed; the corner of a cube is 0.87 from its centre."""
ROUNDS = 6
"""Rounds of Lloyd's method; the variation of the volumes changes by less than a tenth in further ones (measured)."""
FEWEST = 8
"""Smallest number of particles of a body: two along each axis."""
THIN = 0.3
"""Share of the volume that the fine cells may miss or add. A plate of one spacing has three layers of fine cells, or now and then two or
four; a mesh that is thinner for the most part needs a smaller spacing."""
WELD = 1e-6
"""Distance over the diagonal below which a repair merges vertices: ten rounding units of float32."""


def closed_mesh(mesh: TriangleMesh, name: str, *, repair: bool = False) -> TriangleMesh:
    """Check that a mesh is closed, and turn its outside out.

    Args:
        mesh: A mesh.
        name: What it is called in error messages.
        repair: Whether to merge vertices that are close, drop repeated triangles, orient the rest alike, and close its holes first.

    Raises:
        UserError: It has open edges, or it encloses no volume.
    """
    if repair and open_edges(mesh.faces):
        mesh = _repaired(mesh, name)
    if count := open_edges(mesh.faces):
        advice = "the repair did not close them: close it in a program such as Blender or MeshLab" if repair else (
            "set repair to true to close its holes, or close it in a program such as Blender or MeshLab"
        )  # fmt: skip
        raise UserError(f"{name} is not watertight: {count} of its edges are open or have triangles of opposed orientation; {advice}")
    volume = enclosed_volume(mesh)
    extent = float(np.ptp(mesh.vertices, axis=0).max())
    if not math.isfinite(volume) or abs(volume) <= 1e-12 * extent**3:
        raise UserError(f"{name} encloses no volume: it is flat, or its outside and inside cancel")
    return mesh if volume > 0 else mesh._replace(faces=np.ascontiguousarray(mesh.faces[:, ::-1]))


def _repaired(mesh: TriangleMesh, name: str) -> TriangleMesh:
    trimesh = import_extra("trimesh", "the repair of a mesh", extra="mesh")
    step = WELD * float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    _, which, merged = np.unique(np.round(mesh.vertices / step).astype(np.int64), axis=0, return_index=True, return_inverse=True)
    faces = merged.reshape(-1)[mesh.faces]
    _, kept = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    welded = clean_mesh(mesh.vertices[which], faces[np.sort(kept)], name)
    whole = trimesh.Trimesh(welded.vertices, welded.faces, process=False)
    trimesh.repair.fix_normals(whole, multibody=True)
    trimesh.repair.fill_holes(whole, use_fan=True)
    trimesh.repair.fix_normals(whole, multibody=True)
    return clean_mesh(np.asarray(whole.vertices), np.asarray(whole.faces), name)


def fill_mesh(mesh: TriangleMesh, spacing: float, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Fill a closed mesh with particles.

    Args:
        mesh: A mesh as `closed_mesh` returns it.
        spacing: Edge of the cube that a particle fills on average [m].
        name: What it is called in error messages.

    Returns:
        Positions [m], (P, 3), and volumes [m^3], (P,), whose sum is the volume of the mesh. Overlapping parts count once.

    Raises:
        UserError: The spacing is too coarse for the mesh, or needs more particles or memory than there may be.
    """
    volume = enclosed_volume(mesh)
    expected = volume / spacing**3
    check_limit(int(min(expected, 1e18)), "NEUIDO_MAX_PARTICLES", f"a spacing of {spacing:g} m gives {name} {expected:.3g} particles")
    if expected < FEWEST:
        raise UserError(f"a spacing of {spacing:g} m is too coarse for {name}, which has {volume:.3g} m^3: lower spacing, or raise "
                        f"particles to {FEWEST} at least")  # fmt: skip
    lower, cells, edges = lattice_around(mesh, spacing)
    lower, cells = lower - edges, tuple(n + 2 for n in cells)  # an empty cell around, so that each has neighbours
    needed = math.prod(cells) * FINE**3 * FINE_BYTES
    check_memory(needed, "cpu", f"to fill {name} with a spacing of {spacing:g} m", "raise spacing, or lower particles")
    found = find_inside(mesh, lower, tuple(n * FINE for n in cells), edges / FINE)
    if found.overlaps:
        volume = found.volume
    sampled = float(found.inside.sum() * np.prod(found.edges))
    if abs(sampled - volume) > THIN * volume:
        raise UserError(f"a spacing of {spacing:g} m is too coarse for {name}: cells of a third of it find {sampled:.3g} of its "
                        f"{volume:.3g} m^3; lower spacing, or raise particles")  # fmt: skip
    x, shares = _shared_out(found, cells, spacing)
    return x, shares * (volume / shares.sum())


def _shared_out(found: Inside, cells: tuple[int, ...], spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Return particles (P, 3) [m] and the number of fine cells of each, (P,)."""
    blocks = found.inside.reshape(cells[0], FINE, cells[1], FINE, cells[2], FINE)
    count = blocks.sum(axis=(1, 3, 5))
    full = count == FINE**3
    deep = ndimage.binary_erosion(full, np.ones((3, 3, 3), bool))
    lattice = found.lower + FINE * found.edges * (np.argwhere(deep) + 0.5)
    near = found.inside & ~np.repeat(np.repeat(np.repeat(deep, FINE, 0), FINE, 1), FINE, 2)
    samples = found.lower + found.edges * (np.argwhere(near) + 0.5)
    if not len(samples):
        return lattice, np.full(len(lattice), float(FINE**3))
    start = found.lower + FINE * found.edges * (np.argwhere(~deep & (2 * count >= FINE**3)) + 0.5)
    there = np.concatenate([lattice, start])
    gaps = samples if not len(there) else samples[np.isinf(KDTree(there).query(samples, distance_upper_bound=GAP * spacing)[0])]
    x, shares = _relaxed(samples, np.concatenate([start, _disks(gaps, GAP * spacing)]))
    return np.concatenate([lattice, x]), np.concatenate([np.full(len(lattice), float(FINE**3)), shares])


def _disks(samples: np.ndarray, distance: float) -> np.ndarray:
    """Return the samples that a random order of visits accepts: none is closer to an accepted one than `distance`.

    Candidates that precede all others within the distance are accepted together, which gives the same as one at a time.
    """
    if not len(samples):
        return samples
    samples = np.random.default_rng(0).permutation(samples)
    pairs = KDTree(samples).query_pairs(distance, output_type="ndarray")
    first, second = pairs.min(axis=1, initial=len(samples)), pairs.max(axis=1, initial=0)
    undecided, taken = np.ones(len(samples), bool), np.zeros(len(samples), bool)
    while undecided.any():
        blocked = np.zeros(len(samples), bool)
        blocked[second] = True
        now = undecided & ~blocked
        taken |= now
        undecided &= ~now
        undecided[second[now[first]]] = False
        live = undecided[first] & undecided[second]
        first, second = first[live], second[live]
    return samples[taken]


def _relaxed(samples: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return particles after Lloyd's method, each at the centroid of the samples nearest to it, and the number of these."""
    for _ in range(ROUNDS):
        owner = KDTree(x, balanced_tree=False, compact_nodes=False).query(samples)[1]
        shares = np.bincount(owner, minlength=len(x)).astype(float)
        held = shares > 0
        x = np.stack([np.bincount(owner, samples[:, a], len(x)) for a in range(3)], axis=1)[held] / shares[held, None]
    return x, shares[held]
