"""Tracks as `Problem`s, one per body: a point mass under gravity, measured with errors of clock and length scale."""

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.stats import chi2

from neuido.data.measured.track import AXES, Track, Tracks, read_tracks
from neuido.discrepancy.problems.noise import SeriesError, correlation, high_pass
from neuido.discrepancy.problems.problem import Candidate, Parameter, Point, Problem, Recording
from neuido.discrepancy.problems.released import Released, settle, settled_error
from neuido.physics.effects.library import KNOTS
from neuido.physics.effects.parameters import LIBRARY
from neuido.physics.points.point_mass import Forces

SURROUNDINGS = ("gravity", "uniform_acceleration", "position_force", "time_force")
"""Effects of the surroundings, which are the same for all bodies of a folder. All others belong to a body."""
EARLY = 0.4
"""Share of the frames of a held-out recording that determine its start and are not scored."""
AIR = 1.2
"""Density of air [kg/m^3]."""
LIGHTEST, SMALLEST = 30.0, 0.02
"""Least density [kg/m^3] and diameter [m] of a body, assumed where the folder does not give them."""
LARGEST_DRAG = 2.0
"""Upper limit of the drag coefficient of a compact body."""
IMPACT = 4.0
"""Loss of speed between two frames that counts as an impact, in standard deviations of the noise."""
DISAGREE = 1e-3
"""Level of the test whether the bodies of a folder disagree on an effect of their surroundings."""
LEAST_HALF_WIDTH = 0.3
"""Width added on each side to the range around a common estimate, in typical steps."""
HALF_WIDTH = 5.0
"""Half width of the range around a common estimate, in its standard deviations."""


class TrackProblem(Problem):
    """One body of a folder of the format `neuido-track/1`.

    The body is held until its release and then flies. Position, velocity, release time, length scale and time base of each recording are
    nuisances. `predict` fits them anew for every parameter set (`released.settle`), with the priors of the folder: to all frames of a
    `fit` recording, and to the first 40 % of a held-out one, of which only the later frames are scored. The inference has no nuisances.
    Frames after an impact at the end of a track are left out (`flight_of`). Times count from the first sample of each recording.

    Args:
        tracks: The folder's content.
        body: Name of the body.
    """

    def __init__(self, tracks: Tracks, body: str) -> None:
        tracks = from_first_samples(tracks)
        self.tracks, self.body = tracks, body
        self._flights = [flight_of(track, tracks.gravity) for track in tracks.recordings if track.body == body]
        self.error_model = tracking_error(tracks)
        self._starts = [Released(track, tracks.nuisances, tracks.gravity, self.error_model) for track in self._flights]
        candidates = track_candidates(tracks, body, self._flights)
        self.axes = tuple(sorted({a for track in self._flights for a in track.axes}))
        interval = max(float(np.ptp(track.t)) for track in tracks.recordings) / (KNOTS - 1)  # the same for all bodies
        self._partners = {p.name: p.value for c in candidates for p in c.parameters} | {"time_force.interval": interval} | tracks.effects
        super().__init__(
            name=f"{tracks.name}: {body}",
            measure="rmse",
            unit="m",
            declared=tuple(_declared(tracks, name) for name in tracks.free),
            nuisances=(),
            candidates=candidates,
            recordings=tuple(map(self._recording, self._flights, self._starts)),
            labels={"kind": "track", "body": body},
        )

    def _recording(self, track: Track, start: Released) -> Recording:
        """Return the scored frames of a track as a recording.

        The noise is the effect of the tracking error on these frames, for a held-out track also through the estimated start.
        """
        early = _early(track) if track.role == "held_out" else 0
        count, axes = track.x[early:].shape
        noise = settled_error(start, self.forces([{}], track), early) if early else start.variance**0.5
        groups, times = np.tile(np.arange(axes), count), np.repeat(track.t[early:], axes)
        known = "estimated" if track.noise is None else "stated"
        return Recording(track.name, track.role, track.x[early:].reshape(-1), noise, groups, times, known)

    def predict(self, points: Sequence[Point], recording: int, setting: int = 0) -> np.ndarray:
        if not points:
            return np.empty((0, len(self.recordings[recording].y)))
        seen, _ = self._profile(points, recording)
        return seen.reshape(len(points), -1)

    def _profile(self, points: Sequence[Point], recording: int) -> tuple[np.ndarray, np.ndarray]:
        """Predict the scored frames (P, n, A) [m] of P parameter sets along A axes; return them with the fitted nuisances (P, k)."""
        track, start, forces = self._flights[recording], self._starts[recording], self.forces(points, self._flights[recording])
        early = _early(track) if track.role == "held_out" else 0
        values = settle(start, forces, len(points), early or len(track.t))
        return start.seen(values, forces, track.t)[:, early:], values

    def nuisances_of(self, point: Point, recording: int) -> dict[str, float]:
        """Return the nuisances that `predict` fits to a recording for one parameter set, by name."""
        _, values = self._profile([point], recording)
        return {p.name: float(v) for p, v in zip(self._starts[recording].parameters, values[0], strict=True)}

    def forces(self, points: Sequence[Point], track: Track) -> Forces:
        """Build the forces on the body for several parameter sets, a row each."""

        def rows(name: str) -> np.ndarray | None:
            values = np.array([float(point.get(name, self._partners.get(name, 0.0))) for point in points])
            return values if values.any() else None

        def vectors(name: str, part: str = "{}") -> np.ndarray | None:
            values = [rows(f"{name}.{part.format(a)}") for a in AXES]
            return None if all(v is None for v in values) else np.stack([np.zeros(len(points)) if v is None else v for v in values], 1)

        gravity = np.array(self.tracks.gravity)
        size = float(np.linalg.norm(gravity))
        sizes = np.array([float(point.get("gravity", size)) for point in points])
        more = rows("gravity.g")
        down = gravity / size if size > 0 else np.zeros(3)
        magnus = vectors("magnus")
        lift = rows("magnus.coefficient")
        if lift is not None:
            magnus = (0.0 if magnus is None else magnus) + lift[:, None] * np.array(track.spin)
        knots = [vectors("time_force", f"{{}}{j}") for j in range(KNOTS)]
        force = None
        if any(k is not None for k in knots):
            force = np.stack([np.zeros((len(points), 3)) if k is None else k for k in knots], 1)
        return Forces(
            gravity=(sizes if more is None else sizes + more)[:, None] * down,
            uniform_acceleration=vectors("uniform_acceleration"),
            drag_linear=rows("drag_linear.k"),
            drag_quadratic=rows("drag_quadratic.k"),
            magnus=magnus,
            position_force=rows("position_force.k"),
            position_centre=vectors("position_force"),
            time_force=force,
            time_force_interval=float(self._partners.get("time_force.interval", 1.0)),
            added_mass=rows("added_mass.c"),
        )

    def surroundings_estimates(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Estimate each effect of the surroundings alone from the `fit` recordings of this body.

        The model is linearised about the declared one, and the residuals are weighted by the tracking error. The information is reduced
        where the residual is larger than the tracking error. The unknown place of `position_force` is replaced by a uniform acceleration
        along each axis.

        Returns:
            For each effect its sizes (k,) and their information matrix (k, k), in the units of the parameters.
        """
        asked: list[dict[str, float]] = [{}]
        spans: dict[str, tuple[int, list[float]]] = {}
        for candidate in self.candidates:
            if candidate.name in SURROUNDINGS:
                own = [(p.name, p.scale) for p in candidate.size_parameters]
                shape = {p.name: 0.0 for p in candidate.parameters if p not in candidate.size_parameters}
                if candidate.name == "position_force":
                    own += [(f"uniform_acceleration.{AXES[a]}", 0.3) for a in self._flights[0].axes]
                spans[candidate.name] = (len(asked), [step for _, step in own])
                asked += [shape | {name: step} for name, step in own]
        columns, left = [], []
        for n in self.roles["fit"] if spans else ():
            seen, values = self._profile(asked, n)
            start = self._starts[n]
            r = np.einsum("ij,pja->pia", start.whitener(self._flights[n].t), seen - self._flights[n].x).reshape(len(asked), -1)
            r = np.concatenate([r, start.off_prior(values)], axis=1)
            columns.append((r[1:] - r[0]).T)
            left.append(r[0])
        out: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        every, residual = (np.concatenate(columns), np.concatenate(left)) if spans else (np.empty((0, 0)), np.empty(0))
        for name, (first, steps) in spans.items():
            k = len(steps)
            # a weak prior: a size without influence on the data stays unknown, and the matrix regular
            J = np.concatenate([every[:, first - 1 : first - 1 + k], 1e-3 * np.eye(k)])
            r = np.concatenate([residual, np.zeros(k)])
            found = np.linalg.lstsq(J, -r, rcond=None)[0]
            after = r + J @ found
            information = J.T @ J / max(float(after @ after) / max(len(residual) - 2 * k, 1), 1.0)
            out[name] = (found * steps, information / np.outer(steps, steps))
        return out

    def model_after(self, values: Point, effects: Sequence[str]) -> dict[str, Any]:
        gravity = np.array(self.tracks.gravity)
        if "gravity" in values and np.linalg.norm(gravity) > 0:
            gravity = gravity / np.linalg.norm(gravity) * values["gravity"]
        own = {p.name: p.value for c in self.candidates if c.name in effects for p in c.parameters}
        own |= {name: float(value) for name, value in values.items() if name.partition(".")[0] in effects and "." in name}
        if any(name.startswith("time_force.") for name in own):
            own["time_force.interval"] = float(self._partners["time_force.interval"])
        return {"gravity": gravity.tolist(), "effects": self.tracks.effects | own, "free": list(self.tracks.free)}


def track_problems(folder: str | os.PathLike | Tracks) -> tuple[TrackProblem, ...]:
    """Build one problem for each body of a folder.

    An effect of the surroundings acts on every body. In a folder of several bodies, their estimates of it are compared by
    Cochran's Q at the level `DISAGREE`. If they agree, the range of the effect is restricted to their common estimate. If not,
    the effect is no candidate, with the reason in `labels["excluded"]`. A wind together with a drag on some bodies is therefore not found.
    """
    tracks = folder if isinstance(folder, Tracks) else read_tracks(folder)
    problems = tuple(TrackProblem(tracks, body) for body in tracks.bodies)
    if len(problems) > 1:
        votes = [problem.surroundings_estimates() for problem in problems]
        for axes in dict.fromkeys(problem.axes for problem in problems):  # only bodies with the same measured axes are compared
            group = [i for i, problem in enumerate(problems) if problem.axes == axes]
            for name in SURROUNDINGS:
                agreed = _agreement([votes[i][name] for i in group if name in votes[i]])
                for i in group:
                    _restrict(problems[i], name, agreed)
    return problems


def _agreement(votes: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the common estimate (k,) and its standard deviations (k,) of several estimates with their information matrices.

    None where there are no estimates, or where they differ by more than chance (Cochran's Q).
    """
    if not votes:
        return None
    total = sum(w for _, w in votes)
    scale = np.sqrt(np.diag(total))
    inverse = np.linalg.inv(total / np.outer(scale, scale)) / np.outer(scale, scale)
    mean = inverse @ sum(w @ found for found, w in votes)
    q = sum(float((found - mean) @ w @ (found - mean)) for found, w in votes)
    freedom = (len(votes) - 1) * len(mean)
    if freedom and float(chi2.sf(q, freedom)) < DISAGREE:
        return None
    return mean, np.sqrt(np.diag(inverse))


def _restrict(problem: TrackProblem, name: str, agreed: tuple[np.ndarray, np.ndarray] | None) -> None:
    """Restrict an effect of the surroundings to the range on which the bodies agree, or remove it where they do not (None)."""
    kept = []
    for candidate in problem.candidates:
        if candidate.name == name and agreed is None:
            problem.labels.setdefault("excluded", {})[name] = "acts on every body of the folder, and no one size of it suits them all"
            continue
        if candidate.name == name and agreed is not None:
            sizes = candidate.size_parameters
            made = {}
            for p, mean, deviation in zip(sizes, *agreed):  # further entries of position_force belong to its place
                half = HALF_WIDTH * float(deviation) + LEAST_HALF_WIDTH * p.scale
                made[p.name] = replace(p, lower=max(p.lower, min(mean - half, p.value)), upper=min(p.upper, max(mean + half, p.value)))
            parameters = tuple(made.get(p.name, p) for p in candidate.parameters)
            limits = {p.name: (p.lower, p.upper) for p in parameters}
            own = {p.name for p in sizes}
            starts = tuple({k: _inside(v, *limits[k], nonzero=k in own) for k, v in start.items()} for start in candidate.starts)
            candidate = replace(candidate, parameters=parameters, starts=starts)
        kept.append(candidate)
    object.__setattr__(problem, "candidates", tuple(kept))


def _inside(value: float, lower: float, upper: float, *, nonzero: bool) -> float:
    """Clip a value to a range; if the result must not be zero but is, return a third of the farther end of the range."""
    inside = min(max(value, lower), upper)
    return (lower if abs(lower) > abs(upper) else upper) / 3 if nonzero and inside == 0 else inside


def from_first_samples(tracks: Tracks) -> Tracks:
    """Shift the clocks of tracks to zero at the first sample of each recording."""
    return replace(tracks, recordings=tuple(replace(track, t=track.t - track.t[0]) for track in tracks.recordings))


def flight_of(track: Track, gravity: Sequence[float]) -> Track:
    """Remove the frames after an impact at the end of a track.

    An impact is a sudden loss of speed along the mean motion of the five frames before. It must exceed four standard deviations of the
    noise (`IMPACT`) and three times the loss that gravity could cause. Only the last six frames are searched.
    """
    step, dt = np.diff(track.x, axis=0), np.diff(track.t)
    sigma = track.noise or high_pass([(track.t, channel) for channel in track.x.T]) or 0.0
    velocity = step / dt[:, None]
    g = max(float(np.linalg.norm(gravity)), 1e-9)
    for i in range(max(len(velocity) - 5, 6), len(velocity)):
        mean = np.median(velocity[i - 5 : i], axis=0)
        speed = float(np.linalg.norm(mean))
        if speed == 0:
            continue
        lost = speed - float(velocity[i] @ mean) / speed
        if lost > max(IMPACT * math.sqrt(2) * sigma / dt[i], 3 * g * dt[i]):
            return _cut(track, i + 1)
    return track


def _cut(track: Track, n: int) -> Track:
    return Track(track.name, track.body, track.role, track.t[:n], track.x[:n], track.axes, track.spin, track.noise)


def _early(track: Track) -> int:
    """Return the number of frames of a held-out track that determine its start."""
    return max(math.ceil(EARLY * len(track.t)), 2)


def tracking_error(tracks: Tracks) -> SeriesError:
    """Estimate noise and slow error of the tracking from the `fit` recordings of all bodies (`noise.correlation`)."""
    flights = [flight_of(track, tracks.gravity) for track in tracks.of("fit")]
    return correlation([(track.t, channel) for track in flights for channel in track.x.T])


def track_candidates(tracks: Tracks, body: str, flights: Sequence[Track]) -> tuple[Candidate, ...]:
    """Return the effects that a body may lack, with ranges and starts scaled by its motion; vectors have the measured axes alone.

    Args:
        tracks: The folder's content.
        body: Name of the body.
        flights: Recordings of the body without impacts.
    """
    fits = [track for track in flights if track.role == "fit"]
    duration = max(float(np.ptp(track.t)) for track in flights)
    speed = max(float(np.linalg.norm(np.ptp(track.x, axis=0))) / float(np.ptp(track.t)) for track in fits)
    axes = sorted({a for track in fits for a in track.axes})
    names = [AXES[a] for a in axes]
    g = float(np.linalg.norm(tracks.gravity)) or 9.81
    figures = tracks.bodies[body]
    diameter = figures.get("diameter", SMALLEST)
    density = LIGHTEST
    if len(figures) == 2:
        density = figures["mass"] / (math.pi / 6 * diameter**3)
    most = 0.75 * AIR * LARGEST_DRAG / (density * diameter)  # drag per mass of a sphere [1/m]
    out: list[Candidate] = []

    def add(name: str, start: Mapping[str, float], *parameters: tuple, sizes: str = "", others: Sequence[Mapping[str, float]] = ()) -> None:
        """Add a candidate with parameters (name, typical step, lower, upper); `sizes` are zero when it is absent (all where empty)."""
        entry = next(entry for entry in LIBRARY if entry.name == name)
        units = {p.name: p.unit for p in entry.parameters} | {"coefficient": "1"}
        made = []
        for key, scale, lower, upper in parameters:
            value = tracks.effects.get(f"{name}.{key}", start[key] if sizes and key not in sizes.split() else 0.0)
            made.append(Parameter(f"{name}.{key}", units[key], value, scale, min(lower, value), max(upper, value)))
        starts = tuple({f"{name}.{k}": float(v) for k, v in one.items()} for one in (start, *others))
        out.append(Candidate(name, tuple(made), starts, entry.stage, sizes=tuple(f"{name}.{k}" for k in sizes.split())))

    if any(abs(tracks.gravity[a]) > 0 for a in axes) and "gravity" not in tracks.free:
        add("gravity", {"g": 0.05 * g}, ("g", 0.03 * g, -0.5 * g, 0.5 * g))
    add("uniform_acceleration", dict.fromkeys(names, 0.05 * g), *((a, 0.03 * g, -0.5 * g, 0.5 * g) for a in names))
    k = min(0.1 / (duration * speed), most / 2)
    add("drag_linear", {"k": k * speed}, ("k", k * speed, 0.0, 2 * most * speed), others=[{"k": min(4 * k, most) * speed}])
    add("drag_quadratic", {"k": k}, ("k", k, 0.0, most), others=[{"k": min(4 * k, most)}])
    if len(axes) > 1:
        w = 0.1 / duration
        rates = [float(np.linalg.norm(track.spin)) for track in flights if track.spin is not None]
        if len(rates) == len(flights) and min(rates) > 0:
            add("magnus", {"coefficient": w / max(rates)}, ("coefficient", w / max(rates), -1.0, 1.0))
        else:
            add("magnus", dict.fromkeys(AXES, w), *((a, w, -50 * w, 50 * w) for a in AXES))
    k = 0.1 / duration**2
    centre = np.mean([track.x.mean(axis=0) for track in fits], axis=0)
    extent = float(np.max([np.ptp(track.x, axis=0).max() for track in fits]))
    places = dict(zip(names, map(float, centre)))
    shape = [(a, 0.2 * extent, c - 3 * extent, c + 3 * extent) for a, c in places.items()]
    add("position_force", {"k": k} | places, ("k", k, -100 * k, 100 * k), *shape, sizes="k")
    knots = [f"{a}{j}" for j in range(KNOTS) for a in names]
    add("time_force", dict.fromkeys(knots, 0.05 * g), *((key, 0.03 * g, -g, g) for key in knots))
    c = 0.5 * AIR / density  # the added mass of a sphere in air
    add("added_mass", {"c": 0.5 * c}, ("c", min(0.03, c), 0.0, c))
    return tuple(out)


def _declared(tracks: Tracks, name: str) -> Parameter:
    if name == "gravity":
        g = float(np.linalg.norm(tracks.gravity))
        return Parameter("gravity", "m/s^2", g, 0.03 * max(g, 1.0), 0.0, 3 * max(g, 1.0))
    effect, _, part = name.partition(".")
    parameter = next(p for entry in LIBRARY if entry.name == effect for p in entry.parameters if p.name == part)
    value = tracks.effects[name]
    return Parameter(name, parameter.unit, value, max(0.1 * abs(value), 1e-4), min(parameter.low, value), max(parameter.high, value))
