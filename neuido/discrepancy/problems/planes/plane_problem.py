"""A plane specimen as a `Problem`: displacements of the free nodes and reaction forces under the measured motion of the boundary."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from neuido.data.measured.plane_experiment import PlaneExperiment, PlaneRecording
from neuido.discrepancy.problems.declared_model import declared
from neuido.discrepancy.problems.planes.plane_candidates import plane_candidates
from neuido.discrepancy.problems.planes.plane_noise import displacement_noise, force_noise
from neuido.discrepancy.problems.problem import Point, Problem, Recording
from neuido.errors import UserError
from neuido.physics.plane.plane_law import PlaneLaw
from neuido.physics.plane.plane_specimen import Solution

LEAST_SHARE = 1e-6
"""Variance by errors of the boundary, relative to the noise, below which a direction is left out."""


class Step(NamedTuple):
    """A load step: what was prescribed, what was measured, and how errors of the one reach the other."""

    motion: Tensor
    """Prescribed displacements [m], (N, 2)."""
    rows: np.ndarray
    """Degrees of freedom whose displacement is a datum, (n,)."""
    parts: np.ndarray
    """Parts of the boundary whose force is a datum, (k,)."""
    known: Solution
    """Equilibrium of the declared model."""
    along: np.ndarray
    """Orthonormal directions in which errors of the prescribed motion change the data, (n + k, m)."""
    shrink: np.ndarray
    """Factor on each direction that makes its variance that of the noise, less one, (m,)."""


class PlaneProblem(Problem):
    """A plane specimen, read by `read_plane_experiment`.

    The data of a load step are the measured displacements of nodes that may move, and forces in units of length: a force is multiplied by
    the ratio of the noise of a displacement to that of a force. The boundary moves as it was measured, with noise, which the equilibrium
    carries into the specimen. The data are therefore multiplied by the root of the inverse of their whole covariance, as it is with the
    declared model; all of them have the noise of a displacement then. The mesh is that of the measurement: there is one setting.
    """

    def __init__(self, experiment: PlaneExperiment) -> None:
        self.experiment = experiment
        self._forces_scale = []
        self._steps: list[list[Step]] = []
        made = []
        fixed = torch.from_numpy(experiment.prescribed)
        law = self._law({}, known=True)
        names = [recording.name for recording in experiment.recordings]
        self._earlier = [names.index(r.continues) if r.continues else None for r in experiment.recordings]
        for n, recording in enumerate(experiment.recordings):
            sigma = recording.displacement_noise or displacement_noise(experiment, recording)
            scale = sigma / force_noise(recording)
            steps: list[Step] = []
            own, u = self._begun(law, n)
            for t in range(len(recording.displacement)):
                motion = prescribed_motion(experiment, recording, t)
                try:
                    known, before, own = experiment.specimen.followed(own, fixed, u, motion, t)
                except UserError as error:
                    raise UserError(f"{experiment.folder / 'plane.yaml'}: {recording.name}: {error}") from error
                u = known.displacement
                steps.append(self._step(recording, t, motion, fixed, known, before, sigma, scale))
            self._steps.append(steps)
            self._forces_scale.append(scale)
            y = np.concatenate([self._seen(recording.displacement[t], recording.force[t], step, scale) for t, step in enumerate(steps)])
            groups = np.concatenate([np.concatenate([step.rows % 2, 2 + step.parts]) for step in steps])
            times = np.concatenate([np.full(len(step.rows) + len(step.parts), float(t + 1)) for t, step in enumerate(steps)])
            known_noise = "stated" if recording.displacement_noise is not None else "estimated"
            made.append(Recording(recording.name, recording.role, y, sigma, groups, times, known_noise))
        candidates, excluded = plane_candidates(experiment)
        self._partners = {p.name: p.value for c in candidates for p in c.parameters}
        super().__init__(
            name=experiment.name,
            measure="rmse",
            unit="m",
            declared=tuple(declared(name, experiment.model["elasticity"][name]) for name in experiment.free),
            nuisances=(),
            candidates=candidates,
            recordings=tuple(made),
            labels={"kind": "plane specimen"} | ({"excluded": excluded} if excluded else {}),
        )

    def _law(self, point: Point, *, known: bool = False) -> PlaneLaw:
        """Return the law of a parameter set."""
        elasticity = {key: point.get(key, value) for key, value in self.experiment.model["elasticity"].items()}
        effects: dict[str, float] = dict(self.experiment.effects)
        if not known:
            named = {name.partition(".")[0] for name in point if "." in name}
            partners = {key: value for key, value in self._partners.items() if key.partition(".")[0] in named}
            effects = partners | effects | {name: float(value) for name, value in point.items() if "." in name}
        return PlaneLaw(elasticity, effects, centres=self.experiment.specimen.centres)

    def _begun(self, law: PlaneLaw, recording: int) -> tuple[PlaneLaw, Tensor]:
        """Return the law and the displacements (N, 2) [m] at the start of a recording: after the one that it continues, or at rest.

        Raises:
            UserError: A load step before has no equilibrium.
        """
        earlier = self._earlier[recording]
        if earlier is None or not law.yields:
            return law, torch.zeros_like(self.experiment.specimen.nodes)
        last, law = list(self._path(*self._begun(law, earlier), earlier))[-1]
        return law, last.displacement

    def _path(self, law: PlaneLaw, begun: Tensor, recording: int) -> Iterator[tuple[Solution, PlaneLaw]]:
        """Yield the equilibrium of each load step, and the law after it.

        Raises:
            UserError: A load step has no equilibrium.
        """
        fixed = torch.from_numpy(self.experiment.prescribed)
        for t, step in enumerate(self._steps[recording]):
            solution, _, law = self.experiment.specimen.followed(law, fixed, begun, step.motion, t)
            begun = solution.displacement
            yield solution, law

    def _step(
        self, recording: PlaneRecording, t: int, motion: Tensor, fixed: Tensor, known: Solution, law: PlaneLaw, sigma: float, scale: float
    ) -> Step:
        measured = np.isfinite(recording.displacement[t]) & ~fixed.numpy()
        rows, parts = np.flatnonzero(measured.reshape(-1)), np.flatnonzero(np.isfinite(recording.force[t]))
        moved = self._by_boundary(recording, t, fixed, known, law)
        columns = np.concatenate([moved[0][rows], scale * moved[1][parts]])
        U, sizes, _ = np.linalg.svd(columns, full_matrices=False)
        kept = sizes**2 > LEAST_SHARE
        return Step(motion, rows, parts, known, U[:, kept], 1 / np.sqrt(1 + sizes[kept] ** 2) - 1)

    def _by_boundary(
        self, recording: PlaneRecording, t: int, fixed: Tensor, known: Solution, law: PlaneLaw
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the change of displacements (2 N, m) and of forces (B, m) by one standard deviation of each error of the boundary.

        The error of a displacement is one unit. A part that moves as a whole has the error of its mean.
        """
        own, size = self.experiment, 2 * len(self.experiment.specimen.nodes)
        directions = []
        for part in own.boundary:
            degrees = 2 * part.nodes + part.axis
            if part.motion == "measured":
                directions += [(degrees[i : i + 1], 1.0) for i in range(len(degrees))]
            elif part.motion == "rigid":
                seen = int(np.isfinite(recording.displacement[t, part.nodes, part.axis]).sum())
                directions.append((degrees, seen**-0.5))
        errors = np.zeros((size, len(directions)))
        for i, (degrees, amount) in enumerate(directions):
            errors[degrees, i] = amount
        stiffness = own.specimen.assembled(law, known.displacement)[1]
        free = ~fixed.reshape(-1).numpy()
        moved = errors.copy()
        if errors.size:
            moved[free] = -known.factor.solve(torch.from_numpy((stiffness @ errors)[free])).numpy()
        reaction = stiffness @ moved
        forces = np.array([reaction[2 * part.nodes + part.axis].sum(0) for part in own.boundary])
        return moved, forces.reshape(len(own.boundary), len(directions))

    def _seen(self, displacement: np.ndarray, force: np.ndarray, step: Step, scale: float) -> np.ndarray:
        """Return the data of a load step, whitened, from displacements (N, 2) and forces of the parts (B,)."""
        values = np.concatenate([displacement.reshape(-1)[step.rows], scale * force[step.parts]])
        return values + step.along @ (step.shrink * (step.along.T @ values))

    def forces_of(self, internal: np.ndarray) -> np.ndarray:
        """Return the force of each part of the boundary along its axis (B,) [N] from internal forces (2 N,)."""
        return np.array([internal[2 * part.nodes + part.axis].sum() for part in self.experiment.boundary])

    def predict(self, points: Sequence[Point], recording: int, setting: int = 0) -> np.ndarray:
        out = np.full((len(points), len(self.recordings[recording].y)), np.nan)
        steps, before = self._steps[recording], None
        for i, point in enumerate(points):
            found = self._solved(point, recording, before)
            if found is not None:
                before = found
                scale = self._forces_scale[recording]
                made = [self._seen(s.displacement.numpy(), self.forces_of(s.force.numpy()), step, scale) for s, step in zip(found, steps)]
                out[i] = np.concatenate(made)
        return out

    def _solved(self, point: Point, recording: int, before: Sequence[Solution] | None = None) -> list[Solution] | None:
        """Return the equilibrium of each load step at a parameter set, from that of another one if it is given; None without one."""
        own, fixed = self.experiment.specimen, torch.from_numpy(self.experiment.prescribed)
        try:
            law = self._law(point)
            if law.yields:
                return [solution for solution, _ in self._path(*self._begun(law, recording), recording)]
            found: list[Solution] = []
            for t, step in enumerate(self._steps[recording]):
                begun = found[-1].displacement if found else torch.zeros_like(own.nodes)
                near = None if before is None else own.near(law, fixed, before[t])
                found.append(near or own.near(law, fixed, step.known) or own.towards(law, fixed, begun, step.motion, t))
        except UserError:
            return None
        return found

    def fields(self, point: Point, recording: int) -> dict[str, np.ndarray]:
        """Return displacements (T, N, 2) [m] and forces of the parts of the boundary (T, B) [N] at a parameter set; NaN where it fails."""
        found, measured = self._solved(point, recording), self.experiment.recordings[recording]
        if found is None:
            return {"displacement": np.full_like(measured.displacement, np.nan), "force": np.full_like(measured.force, np.nan)}
        return {
            "displacement": np.stack([s.displacement.numpy() for s in found]),
            "force": np.stack([self.forces_of(s.force.numpy()) for s in found]),
        }

    def pictured(self, points: Mapping[str, Point], recording: int) -> dict[str, np.ndarray]:
        """Return what pictures of a recording show: the mesh, and measured and predicted displacements and forces.

        Args:
            points: Parameter sets by name, `before` and `after`.
            recording: Number of the recording.

        Returns:
            `nodes` (N, 2) [m], `triangles` (E, 3), `moved_measured` (T, N, 2) [m], `force_measured` (T, B) [N], and for each parameter set
            `moved_<name>` and `force_<name>`.
        """
        own = self.experiment.recordings[recording]
        out = {"nodes": self.experiment.specimen.nodes.numpy(), "triangles": self.experiment.specimen.triangles.numpy()}
        out |= {"moved_measured": own.displacement, "force_measured": own.force}
        for name, point in points.items():
            found = self.fields(point, recording)
            out |= {f"moved_{name}": found["displacement"], f"force_{name}": found["force"]}
        return out

    def effort(self, recording: int, setting: int = 0) -> float:
        return float(len(self.experiment.specimen.triangles) * len(self._steps[recording]))

    def model_after(self, values: Point, effects: Sequence[str]) -> dict[str, Any]:
        model: dict[str, Any] = {"elasticity": dict(self.experiment.model["elasticity"]), "free": list(self.experiment.free)}
        model["elasticity"] |= {p.name: float(values.get(p.name, p.value)) for p in self.declared}
        own = {p.name: p.value for c in self.candidates if c.name in effects for p in c.parameters}
        own |= {name: float(value) for name, value in values.items() if name.partition(".")[0] in effects}
        if self.experiment.effects or own:
            model["effects"] = self.experiment.effects | own
        return model


def prescribed_motion(experiment: PlaneExperiment, recording: PlaneRecording, t: int) -> Tensor:
    """Return the prescribed displacements of a load step [m], (N, 2); zero at nodes that may move."""
    out = np.zeros(tuple(experiment.specimen.nodes.shape))
    for part in experiment.boundary:
        seen = recording.displacement[t, part.nodes, part.axis]
        out[part.nodes, part.axis] = seen if part.motion == "measured" else np.nanmean(seen) if part.motion == "rigid" else 0.0
    return torch.from_numpy(out)
