"""The effects that a plane specimen could show, with ranges and starts scaled by modulus and strain."""

from collections.abc import Sequence

import numpy as np
import torch

from neuido.data.measured.plane_experiment import PlaneExperiment
from neuido.discrepancy.problems.problem import Candidate, Parameter
from neuido.physics.effects.library import LIBRARY

STAGES = {
    "volumetric": "change of the volume", "geometric_nonlinearity": "large deformation", "strain_stiffening": "large strain",
    "second_invariant": "biaxiality", "fibre": "direction", "stiffness_gradient": "place",
    "yield": "large strain and reversal",
}  # fmt: skip
"""Stage in which each effect shows."""
LARGE = 0.02
"""Largest I1 - 3 up to which stiffening and the second invariant act like a change of the modulus: a strain of a tenth."""
SMALL = "the strains are too small to tell it from another modulus"
MOST = 0.98
"""Quantile of the strains of the triangles that counts as the largest: noise and corners make single ones larger."""


def plane_candidates(experiment: PlaneExperiment) -> tuple[tuple[Candidate, ...], dict[str, str]]:
    """Return the effects that the recordings to fit could show, and those that they cannot tell, with the reason."""
    law = experiment.model["elasticity"]
    young, poisson = float(law["young"]), float(law["poisson"])
    mu, reach = young / (2 * (1 + poisson)), strain_reach(experiment)
    found: list[Candidate] = []
    excluded: dict[str, str] = {}
    linear = law["law"] == "linear"

    def add(
        name: str, starts: Sequence[dict[str, float]], *parameters: tuple[str, float, float, float], sizes: str = "", linear: bool = True,
        needs: str = "", saturates: bool = False, form: str = "", log: str = "",
    ) -> None:  # fmt: skip
        """Add a candidate with parameters (name, typical step, lower, upper); see `material_candidates`."""
        units = {p.name: p.unit for entry in LIBRARY if entry.name == name for p in entry.parameters}
        made = []
        for key, scale, lower, upper in parameters:
            value = experiment.effects.get(f"{name}.{key}", starts[0][key] if sizes and key not in sizes.split() else 0.0)
            bounds = min(lower, value), max(upper, value)
            made.append(Parameter(f"{name}.{key}", units[key], value, scale, *bounds, log=key in log.split(), saturates=saturates))
        points = tuple({f"{name}.{key}": float(value) for key, value in start.items()} for start in starts)
        own = tuple(f"{name}.{key}" for key in sizes.split())
        found.append(Candidate(name, tuple(made), points, STAGES[name], form=form, sizes=own, linear=linear, needs=needs))

    if linear:
        add("geometric_nonlinearity", [{"share": 0.5}, {"share": 1.0}], ("share", 0.3, 0.0, 1.0), saturates=True)
    add("volumetric", [{"share": 1.0}, {"share": 0.3}], ("share", 0.3, -1.0, 3.0), needs="geometric_nonlinearity" if linear else "")
    if reach > LARGE:
        k = 0.3 / reach
        add("strain_stiffening", [{"k": k}, {"k": k / 10}], ("k", k, -10 * k, 10 * k), linear=False)
        add("second_invariant", [{"c": 0.2}], ("c", 0.2, -0.5, 5.0))
    else:
        excluded |= dict.fromkeys(("strain_stiffening", "second_invariant"), SMALL)
    angles = [i * np.pi / 4 for i in range(4)]
    add("fibre", [{"c": 0.3 * mu, "elevation": float(a)} for a in angles], ("c", 0.2 * mu, 0.0, 30 * mu),
        ("elevation", 0.2, -2 * np.pi, 2 * np.pi), sizes="c")  # fmt: skip
    add("stiffness_gradient", [{"x": 0.3, "y": 0.3}], ("x", 0.3, -5.0, 5.0), ("y", 0.3, -5.0, 5.0), form="gradient")
    norm = 2 * mu * (reach / 2) ** 0.5  # I1 - 3 is twice the square of the deviator of a small strain
    add("yield", [{"inverse": f / norm} for f in (1.1, 1.5, 3.0, 10.0)], ("inverse", 0.3, 1e-3 / norm, 100 / norm),
        sizes="inverse", linear=False, log="inverse")  # fmt: skip
    return tuple(found), excluded


def strain_reach(experiment: PlaneExperiment) -> float:
    """Return the largest I1bar - 3 of the triangles in the recordings to fit, with the thickness held or that of a constant volume."""
    largest = 0.0
    for recording in experiment.recordings:
        if recording.role != "fit":
            continue
        for moved in recording.displacement:
            F = experiment.specimen.gradient(torch.from_numpy(moved)).numpy()
            F = F[np.isfinite(F).all(1)]
            area = F[:, 0] * F[:, 3] - F[:, 1] * F[:, 2]
            F, area = F[area > 0], area[area > 0]
            across = np.ones_like(area) if experiment.specimen.condition == "strain" else 1 / area
            I1 = (area * across) ** (-2 / 3) * ((F**2).sum(1) + across**2)
            if len(I1):
                largest = max(largest, float(np.quantile(I1 - 3, MOST)))
    return max(largest, 1e-6)
