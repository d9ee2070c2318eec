"""A deforming body with tracked points as a `Problem`.

A tracked point that names a particle is compared with that particle. A point with an anchor moves with the material around the anchor: it
is a weighted mean of the nearest particles (moving least squares, exact for affine motions).
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from neuido.data.measured.experiment import Experiment
from neuido.data.measured.experiment import Recording as Measured
from neuido.discrepancy.problems import body_launches
from neuido.discrepancy.problems.candidates import body_candidates, present
from neuido.discrepancy.problems.declared_model import CLASSICAL, classical, declared
from neuido.discrepancy.problems.problem import Ask, Parameter, Point, Recording, Rows
from neuido.discrepancy.problems.rollouts import BodyRollouts, Motions
from neuido.discrepancy.problems.settings import EVERY, SETTINGS, SOLVERS
from neuido.errors import UserError, is_out_of_memory
from neuido.physics.effects import stress_kernels
from neuido.physics.effects.library import KNOTS
from neuido.physics.fem.particle_weights import interpolation_weights
from neuido.physics.laws import classical_kernels
from neuido.physics.runtime.device import real_of
from neuido.physics.runtime.once import cached
from neuido.physics.runtime.threads import one_thread_each, scene_pool

POISSON = 0.0, 0.495
"""Range of Poisson's ratio in simulations. The speed of pressure waves grows without bound towards 0.5."""

NUISANCES = (  # name, unit, prior standard deviation: in frame intervals for the release, in typical speeds and spins for the launch
    ("release_time", "s", 0.1),
    ("time_base", "1", 0.003),
    ("length_scale", "1", 0.003),
    ("velocity_x", "m/s", 0.005),
    ("velocity_y", "m/s", 0.005),
    ("velocity_z", "m/s", 0.005),
    ("spin_x", "rad/s", 0.01),
    ("spin_y", "rad/s", 0.01),
    ("spin_z", "rad/s", 0.01),
)
INSTRUMENTS = ("release_time", "time_base", "length_scale")
NEIGHBOURS = 12
"""Number of particles that determine the place of a tracked point with an anchor."""
TOGETHER = 192
"""Number of motions that one launch on a GPU computes."""
WINDOWS = 6
"""Number of time windows of the patterns of an unknown discretisation error (`directions`)."""


class Run(NamedTuple):
    """A request for predictions of one recording, and their place in memory."""

    points: Sequence[Point]
    groups: list[list[int]]
    """Parameter sets with the same motion, by their numbers in `points`."""
    recording: int
    setting: int
    out: np.ndarray
    """Predictions, a row per parameter set, filled later."""

    @property
    def firsts(self) -> list[Point]:
        """First parameter set of each group."""
        return [self.points[group[0]] for group in self.groups]


@dataclass(frozen=True, eq=False)
class BodyProblem(BodyRollouts):
    """An experiment with tracked points."""

    batch: int = 0
    """Number of motions per launch on a GPU; 0: `TOGETHER`. On the CPU each motion is simulated alone, as many at a time as cores."""
    instruments: tuple[str, ...] = INSTRUMENTS
    """Nuisances of the measurement, which do not change the motion."""
    tracked: bool = True
    """Whether the data are positions of tracked points."""
    _maps: dict[int, Any] = field(default_factory=dict, init=False, repr=False)

    def predict(self, points: Sequence[Point], recording: int, setting: int = 0) -> np.ndarray:
        (rows,) = self.predict_several([(points, recording, setting)])
        return rows

    def predict_several(self, asks: Sequence[Ask]) -> Rows:
        with one_thread_each():  # on a GPU too: the preparation on the host is too small for several threads
            yield from (self._side_by_side if self.device == "cpu" else self._in_one_launch)(self._runs(asks))

    def _runs(self, asks: Sequence[Ask]) -> list[Run]:
        return [Run(points, self._groups(points, n), n, s, np.empty((len(points), len(self.recordings[n].y)))) for points, n, s in asks]

    def _side_by_side(self, runs: Sequence[Run]) -> Iterator[np.ndarray]:
        """Simulate each motion alone on the CPU, as many at a time as there are cores, and yield the predictions of each run."""
        waiting: list[list[Future]] = []
        try:
            for run in runs:
                waiting.append([_workers().submit(self._predict, [run._replace(groups=[group])]) for group in run.groups])
            for run, own in zip(runs, waiting, strict=True):
                for one in own:
                    one.result()
                yield run.out
        finally:
            for own in waiting:
                for one in own:
                    one.cancel()

    def _in_one_launch(self, runs: Sequence[Run]) -> Iterator[np.ndarray]:
        """Simulate on a GPU, and yield the predictions of each run.

        Recordings with the same setting share launches if their frames fall on the same substeps, and motions as `_kinds` says.
        """
        shared: dict[tuple, list[Run]] = {}
        keys, times = [], Counter()
        for run in runs:
            r, of = self.measured[run.recording], (run.setting, run.recording)
            s = EVERY[run.setting]
            keys.append((run.setting, times[of], *body_launches.substeps(r, r.scene.dt * s.dt, s.share)))
            times[of] += 1
            shared.setdefault(keys[-1], []).append(run)
        for key, run in zip(keys, runs, strict=True):
            for together in self._kinds(shared.pop(key, [])):  # none where an earlier run of the same launch has filled it
                size = max((self.batch or TOGETHER) // len(together), 1)
                for at in range(0, max(len(one.groups) for one in together), size):
                    parts = [one._replace(groups=one.groups[at : at + size]) for one in together]
                    self._predict([part for part in parts if part.groups])
            yield run.out

    def _kinds(self, runs: Sequence[Run]) -> list[list[Run]]:
        """Divide runs of one setting by the kernels and the inner steps of their motions; those that need too many become NaN."""
        kinds: dict[tuple[int, int], list[Run]] = {}
        for run in runs:
            own: dict[tuple[int, int], list[list[int]]] = {}
            elements = EVERY[run.setting].solver == "finite_elements"
            for group, point in zip(run.groups, run.firsts, strict=True):
                inner = self.inner_steps(point, run.setting) if elements else 1
                own.setdefault((body_launches.stage(self._full(point)), inner), []).append(group)
            for kind, groups in own.items():
                kinds.setdefault(kind, []).append(run._replace(groups=groups))
        for kind in [kind for kind in kinds if kind[1] == 0]:
            for run in kinds.pop(kind):
                run.out[[i for group in run.groups for i in group]] = np.nan
        return list(kinds.values())

    def _groups(self, points: Sequence[Point], recording: int) -> list[list[int]]:
        """Group parameter sets with the same motion, those that differ only in `instruments` or in nuisances of other recordings."""
        name = self.measured[recording].name
        instruments = tuple(f"{kind}:{name}" for kind in self.instruments)
        unique: dict[tuple, list[int]] = {}
        for i, point in enumerate(points):
            key = tuple(sorted((k, v) for k, v in point.items() if k not in instruments and (":" not in k or k.endswith(f":{name}"))))
            unique.setdefault(key, []).append(i)
        return list(unique.values())

    @property
    def together(self) -> bool:
        return self.device != "cpu"

    def coordinates(self, recording: int) -> int:
        """Return how many of the data are coordinates of tracked points: the first ones."""
        return len(self.recordings[recording].y)

    def error(self, residual: np.ndarray, recording: int) -> float:
        return float(np.sqrt(3.0 * np.mean(residual**2)))

    def directions(self, recording: int) -> np.ndarray:
        """Return affine motions of the body in windows of time, (n, k): patterns of a discretisation error that no setting shows."""
        r = self.measured[recording]
        seen = r.seen.numpy()[1:]
        place = r.x.double().numpy()[0]
        mean, size = np.nanmean(place, axis=0), np.nanstd(place, axis=0)
        X = np.where(np.isfinite(place), (place - mean) / np.maximum(size, 1e-9), 0.0)
        space = np.concatenate([np.ones((len(X), 1)), X], axis=1)
        t = r.t.numpy()[1:]
        knots = np.linspace(t[0], t[-1], WINDOWS)
        bumps = np.maximum(0.0, 1.0 - np.abs(t[:, None] - knots) / (knots[1] - knots[0]))
        columns = np.einsum("tk,ns,ab->tnakbs", bumps, space, np.eye(3)).reshape(*seen.shape, 3, -1)[seen].reshape(-1, WINDOWS * 12)
        return columns / np.sqrt(np.mean(np.sum(columns**2, axis=1)))

    def motion(self, point: Point, recording: int, setting: int = 0) -> np.ndarray:
        """Predict the tracked points [m], (T, N, 3), without errors of the instruments."""
        ((x, _),) = self._tracked_motion([([point], recording)], setting)
        return x[0]

    def simulated(self, recording: int) -> Measured:
        """Return the recording with the points that the declared model predicts, without noise."""
        r = self.measured[recording]
        x = torch.from_numpy(self.motion({}, recording)).float()
        return replace(r, x=x, noise=None, video=None, gaussians=None)

    def model_after(self, values: Point, effects: Sequence[str]) -> dict[str, Any]:
        model = {key: dict(value) if isinstance(value, Mapping) else value for key, value in self.experiment.model.items()}
        for p in self.declared:
            _set_value(model, p.name, values.get(p.name, p.value))
        own = {key: float(value) for key, value in values.items() if key.split(".")[0] in effects}
        if any(key.startswith("time_force.") and key[-1].isdigit() for key in own):
            own.setdefault("time_force.interval", self.duration / (KNOTS - 1))
        model["free"] = list(self.experiment.free)
        if own:
            model["effects"] = {**model.get("effects", {}), **own}
        return model

    # Forward runs.

    def _predict(self, runs: Sequence[Run], *, freed: bool = False) -> None:
        """Simulate runs of one setting in one launch and fill in their predictions; NaN where a simulation is impossible.

        If the launch fails, its halves are tried. If a GPU lacks memory, the simulators that are kept are given up first (`freed`: this
        has happened).

        Raises:
            UserError: There is no memory for a single motion.
        """
        moved, full = None, False
        try:
            moved = self._simulate([(run.firsts, run.recording) for run in runs], runs[0].setting)
        except UserError:
            pass
        except RuntimeError as error:
            if not is_out_of_memory(error):
                raise
            full = True
        if moved is not None:
            for run, own in zip(runs, moved, strict=True):
                self._fill(run, own)
            return
        halves = _halves(runs)
        if full:
            self.free()
            if not halves and freed:
                raise UserError(f"{self.device} has no memory left for one motion; end what else runs there, or use --device cpu")
            halves = halves or [list(runs)]
        for half in halves:
            self._predict(half, freed=full)
        if not halves:
            runs[0].out[runs[0].groups[0]] = np.nan

    def _simulate(self, runs: Sequence[Motions], setting: int) -> Sequence[Any]:
        """Simulate each recording, and return its motions in the form that `_fill` takes."""
        return self._tracked_motion(runs, setting)

    def _fill(self, run: Run, moved: Any) -> None:
        """Fill in the predictions of a run from its motions."""
        seen = self.measured[run.recording].seen.numpy()
        for group, xs, vs in zip(run.groups, *moved, strict=True):
            for i in group:
                run.out[i] = self._as_seen(run.points[i], run.recording, xs, vs)[1:][seen[1:]].reshape(-1)

    def _as_seen(self, point: Point, recording: int, x: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return positions (T, N, 3) [m] as measured with the errors of clock and length scale, to first order in the velocity `v`."""
        r = self.measured[recording]
        value = {name: point.get(f"{name}:{r.name}", 0.0) for name in ("release_time", "time_base", "length_scale")}
        if not any(value.values()):
            return x
        t = r.t.numpy()[:, None, None]
        centre = x[0].mean(axis=0)
        return centre + (1.0 + value["length_scale"]) * (x + (value["release_time"] + value["time_base"] * t) * v - centre)

    def _tracked_motion(
        self, runs: Sequence[Motions], setting: int, pushed: list[body_launches.Pushes] | None = None
    ) -> list[tuple[np.ndarray, np.ndarray]]:
        """Simulate, and return positions [m] and velocities [m/s] of the tracked points of each recording, (S, T, N, 3) each.

        What the clamps give to the body is added to `pushed`.
        """
        out = []
        for (_, recording), frames in zip(runs, self._move(runs, setting, pushed=pushed), strict=True):
            index, weight = self._map(recording)
            x, v = (_gather(t, index, weight).transpose(0, 1).double().cpu().numpy() for t in (frames.x, frames.v))
            out.append((x, v))
        return out

    def _map(self, recording: int) -> tuple[Tensor, Tensor | None]:
        """Return particles (N, k) and weights (N, k) of the tracked points; particles (N,) and None if each point is a particle."""
        if recording not in self._maps:
            r = self.measured[recording]
            x = r.body.x.double()
            if r.anchor is not None:
                places, known = r.anchor.double(), torch.full((len(r.anchor),), -1)
            else:
                assert r.track is not None  # points without an anchor follow particles
                places, known = _first_seen(r), r.track
            index, weight = interpolation_weights(x, places, near=NEIGHBOURS, falloff=2.0)
            for n in torch.nonzero(known >= 0)[:, 0].tolist():
                index[n], weight[n] = known[n], 0.0
                weight[n, 0] = 1.0
            alone = bool((weight[:, 1:] == 0).all())
            weight = None if alone else weight.float().to(self.device)
            self._maps[recording] = ((index[:, 0] if alone else index).to(self.device), weight)
        return self._maps[recording]


def body_problem(experiment: Experiment, *, device: str = "cpu", batch: int = 0) -> BodyProblem:
    """Build the problem of an experiment with tracked points.

    Args:
        experiment: The experiment.
        device: `cpu` or a CUDA device.
        batch: Number of motions per launch on a GPU; 0: `TOGETHER`.

    Raises:
        UserError: A recording has no tracked points or fewer than four frames, or none is to be fitted.
    """
    measured = experiment.recordings
    for r in measured:
        if r.x is None:
            raise UserError(f"recording {r.name} has no particles.npz: its tracked points are what is compared")
        if len(r.t) < 4:
            raise UserError(f"recording {r.name} has {len(r.t)} frames; a diagnosis needs at least 4")
    if not any(r.role == "fit" for r in measured):
        raise UserError("no recording has the role fit: set it on at least one in experiment.yaml")
    free = []
    for name in experiment.free:
        value = next(part[name] for part in _parts(experiment.model) if name in part)
        free.append(declared(name, value, within=POISSON if name == "poisson" else None))
    nuisances = []
    for r in measured:
        speed, spin = _typical(r)
        for name, unit, relative in NUISANCES:
            unit_size = {"release_time": r.frame_interval, "velocity": speed, "spin": spin}.get(
                name.split("_")[0] if name != "release_time" else name, 1.0
            )
            scale = relative * unit_size
            nuisances.append(Parameter(f"{name}:{r.name}", unit, 0.0, scale, -8 * scale, 8 * scale, prior=1.0))
    neural = CLASSICAL if "law" in experiment.model else {}
    candidates = tuple(c for c in body_candidates(classical(experiment)) if c.name not in neural)
    return BodyProblem(
        name=experiment.name,
        measure="rmse",
        unit="m",
        declared=tuple(free),
        nuisances=tuple(nuisances),
        candidates=present(candidates, experiment.model.get("effects", {})),
        recordings=tuple(_recording(r) for r in measured),
        settings=len(SETTINGS),
        solvers=SOLVERS,
        experiment=experiment,
        measured=tuple(measured),
        labels={"excluded": neural},
        device=device,
        batch=batch,
    )


@cached
def _workers() -> ThreadPoolExecutor:
    """Return threads for single scenes; the kernels are compiled first, because two threads must not compile the same ones."""
    for build in (stress_kernels.build, classical_kernels.kernels):
        build(real_of(torch.float32))
    return scene_pool()


def _halves(runs: Sequence[Run]) -> list[list[Run]]:
    """Divide runs into two parts, by parameter sets where there are several: an impossible one mostly fails in every recording.

    The list is empty where there is one motion alone.
    """
    most = max(len(run.groups) for run in runs)
    if most == 1:
        return [list(runs[: len(runs) // 2]), list(runs[len(runs) // 2 :])] if len(runs) > 1 else []
    parts = ([run._replace(groups=run.groups[own]) for run in runs] for own in (slice((most + 1) // 2), slice((most + 1) // 2, None)))
    return [[run for run in part if run.groups] for part in parts]


def _recording(r: Measured) -> Recording:
    seen = r.seen.numpy()
    y = r.x.double().numpy()[1:][seen[1:]].reshape(-1)
    frame, point = np.nonzero(seen[1:])
    groups = (point[:, None] * 3 + np.arange(3)).reshape(-1)
    times = np.repeat(r.t.numpy()[1:][frame], 3)
    return Recording(r.name, r.role, y, r.noise, groups, times)


def _typical(r: Measured) -> tuple[float, float]:
    """Return a typical speed [m/s] and spin [rad/s] of a recording: its fastest mean motion, and that over the size of the body."""
    x = r.x.double().numpy()
    step = np.linalg.norm(np.diff(np.nanmean(x, axis=1), axis=0), axis=1) / np.diff(r.t.numpy())
    speed = float(np.nanmax(step))
    extent = float(np.ptp(r.body.x.double().numpy(), axis=0).max())
    return max(speed, 1e-3), max(speed / extent, 1e-2)


def _gather(x: Tensor, index: Tensor, weight: Tensor | None) -> Tensor:
    """Return weighted sums over particles, (K, S, P, 3) -> (K, S, N, 3); without weights the particles themselves."""
    return x[:, :, index] if weight is None else torch.einsum("nk,tsnkc->tsnc", weight.to(x), x[:, :, index])


def _first_seen(r: Measured) -> Tensor:
    """Return the place of each point at t = 0, (N, 3) [m]; of a point seen later, its first place less the mean motion until then."""
    x = r.x.double()
    seen = r.seen
    first = seen.int().argmax(dim=0)
    place = x[first, torch.arange(x.shape[1])]
    centre = torch.stack(
        [x[k][seen[k] & seen[0]].mean(dim=0) if bool((seen[k] & seen[0]).any()) else x.new_full((3,), torch.nan) for k in range(len(x))]
    )
    shift = centre[first] - centre[0]
    place = place - torch.where(shift.isnan(), 0.0, shift)
    return torch.where(place.isnan(), r.body.x.double().mean(dim=0), place)


def _parts(model: Mapping[str, Any]) -> list[Any]:
    """Return the mappings of a model that contain values: elasticity, plasticity, neural law, and the model itself."""
    return [model["elasticity"], model["plasticity"], model.get("law", {}), model]


def _set_value(model: dict[str, Any], name: str, value: float) -> None:
    for part in _parts(model):
        if name in part:
            part[name] = float(value)
