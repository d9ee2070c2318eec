"""Samples of the signed distance of a triangle mesh on a lattice, computed once by Warp's mesh queries."""

import numpy as np
import warp as wp

from neuido.physics.colliders.solids import mass_properties
from neuido.physics.runtime.device import start_warp
from neuido.physics.runtime.once import cached

FEWEST, MOST = 24, 128
"""Least and largest number of samples along the longest side of a mesh; the largest bounds the memory at 40 MB."""
ON_SURFACE = 1e-3
"""Distance in units of the spacing below which the normal of the nearest triangle is used, since the direction to it is rounding."""


@cached
def _kernel() -> wp.Kernel:
    start_warp()

    @wp.kernel(module="neuido.mesh_samples", enable_backward=False)
    def sample(mesh: wp.uint64, near: float, reach: float, places: wp.array(dtype=wp.vec3), out: wp.array(dtype=wp.vec4)):
        i = wp.tid()
        x = places[i]
        found = wp.mesh_query_point_sign_winding_number(mesh, x, reach)
        foot = wp.mesh_eval_position(mesh, found.face, found.u, found.v)
        away = x - foot
        size = wp.length(away)
        n = wp.mesh_eval_face_normal(mesh, found.face)
        if size > near:
            n = found.sign * away / size
        out[i] = wp.vec4(n[0], n[1], n[2], found.sign * size)

    return sample


def mesh_samples(vertices: np.ndarray, faces: np.ndarray, spacing: float, margin: float) -> tuple[np.ndarray, float, np.ndarray]:
    """Sample the gradient of the signed distance and the distance on a lattice around a closed mesh, on the CPU.

    Args:
        vertices: [m], (V, 3).
        faces: (T, 3); turned outwards if they point inwards.
        spacing: Wanted distance of the samples [m]; kept within `FEWEST` and `MOST` along the longest side.
        margin: Least distance of the outer samples from the mesh [m].

    Returns:
        Samples (nx, ny, nz, 4) float64, their spacing [m] and the place of the first [m], (3,).
    """
    if mass_properties(vertices, faces)[0] < 0:
        faces = faces[:, ::-1]
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    longest = float((high - low).max())
    spacing = float(np.clip(spacing, longest / MOST, longest / FEWEST))
    counts = np.ceil((high - low + 2 * margin) / spacing).astype(int) + 1
    lower = (low + high) / 2 - spacing * (counts - 1) / 2
    axes = [start + spacing * np.arange(n) for start, n in zip(lower, counts)]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    kernel = _kernel()
    mesh = wp.Mesh(
        points=wp.array(vertices - lower, dtype=wp.vec3, device="cpu"),
        indices=wp.array(np.ascontiguousarray(faces, dtype=np.int32).ravel(), dtype=wp.int32, device="cpu"),
        support_winding_number=True,
    )
    out = wp.zeros(len(places), dtype=wp.vec4, device="cpu")
    reach = 2 * float(np.linalg.norm(spacing * counts))
    at = wp.array(places - lower, dtype=wp.vec3, device="cpu")
    wp.launch(kernel, dim=len(places), inputs=[mesh.id, ON_SURFACE * spacing, reach, at, out], device="cpu")
    return out.numpy().astype(np.float64).reshape(*counts, 4), spacing, lower
