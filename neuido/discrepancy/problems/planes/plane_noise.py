"""Noise of a plane specimen: of the displacements by their neighbours on the mesh, of the forces by the class of the machine."""

import numpy as np
from scipy.spatial import cKDTree

from neuido.data.measured.plane_experiment import PlaneExperiment, PlaneRecording
from neuido.errors import UserError

NEIGHBOURS = 16
"""Nodes to which a cubic is fitted; it has ten terms in the plane, and leaves six degrees of freedom."""
MEDIAN = 5.348
"""Median of chi^2 with six degrees of freedom."""
LEAST = 1e-6
"""Least noise of a displacement, relative to the largest displacement: the rounding of six digits in a file."""
MACHINE = 0.01
"""Error of a force relative to the force: testing machines of class 1 of ISO 7500-1 are right within one per cent."""


def displacement_noise(experiment: PlaneExperiment, recording: PlaneRecording) -> float:
    """Estimate the standard deviation of the noise of a displacement [m], by local cubics over neighbouring nodes.

    The median over nodes and load steps keeps few places with steep strains from counting.

    Raises:
        UserError: There are too few nodes.
    """
    x = experiment.specimen.nodes.numpy()
    if len(x) < 2 * NEIGHBOURS:
        raise UserError(
            f"{experiment.folder / 'plane.yaml'}: {recording.name}: {len(x)} nodes are too few to estimate the noise of the displacements: "
            "give noise.displacement [m]"
        )
    near = cKDTree(x).query(x, NEIGHBOURS)[1]
    arms = x[near] - x[near].mean(1, keepdims=True)
    arms = arms / np.abs(arms).max(axis=(1, 2), keepdims=True)
    basis = np.stack([arms[..., 0] ** i * arms[..., 1] ** j for i in range(4) for j in range(4 - i)], -1)
    q = np.linalg.qr(basis)[0]
    squares = []
    for moved in recording.displacement:
        values = moved[near]  # (N, k, 2)
        values = values - values.mean(1, keepdims=True)
        left = values - np.einsum("nki,nic->nkc", q, np.einsum("nki,nkc->nic", q, values))
        squares.append((left**2).sum(1).reshape(-1))
    found = np.concatenate(squares)
    found = found[np.isfinite(found)]
    least = LEAST * float(np.nanmax(np.abs(recording.displacement)))
    if not len(found):
        raise UserError(
            f"{experiment.folder / 'plane.yaml'}: {recording.name}: too many displacements are missing to estimate their noise: give "
            "noise.displacement [m]"
        )
    return max(float(np.sqrt(np.median(found) / MEDIAN)), least)


def force_noise(recording: PlaneRecording) -> float:
    """Return the standard deviation of the error of a force [N]: as stated, or that of a machine of class 1 at the largest force."""
    if recording.force_noise is not None:
        return recording.force_noise
    seen = np.abs(recording.force[np.isfinite(recording.force)])
    return MACHINE * float(seen.max()) if len(seen) and seen.max() > 0 else 1.0
