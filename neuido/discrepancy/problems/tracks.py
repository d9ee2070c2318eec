"""Tracks as `Problem`s, one for each body: a point mass under gravity, what the instruments may have off, and the effects it may lack."""

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
"""Effects of the surroundings, the same for all bodies of a folder; the others belong to a body."""
EARLY = 0.4
"""Share of the frames of a held-out recording from which its start is estimated; they are not scored."""
AIR = 1.2
"""Density of air [kg/m^3]."""
LIGHTEST, SMALLEST = 30.0, 0.02
"""What a body whose figures are not given has at least: density [kg/m^3], diameter [m]."""
LARGEST_DRAG = 2.0
"""Drag coefficient that no body of compact shape exceeds."""
IMPACT = 4.0
"""Loss of speed from frame to frame that is an impact, in standard deviations of the noise."""
DISAGREE = 1e-3
"""Level at which the bodies of a folder disagree on an effect of their surroundings."""
LEAST_HALF = 0.3
"""Typical steps that the range about a common estimate has on either side at the least."""
WITNESS = 5.0
"""Standard deviations about their common estimate in which it may lie."""


class TrackProblem(Problem):
    """One body of a folder of the format `neuido-track/1`.

    The body is held until its release and then flies. Its position and velocity, the release time, length scale and time base of each
    recording are nuisances that `predict` estimates anew for every point (`released.settle`), with the folder's priors and in the metric
    of the tracking error: of a `fit` recording from all frames, of a held-out one from its first 40 %, the rest of which is scored.
    So predictions are profiles, and the inference has no nuisances left. Frames after an impact at the end of a track (`flight_of`) are
    left out. Times count from the first sample of each recording, whatever the origin of its clock.
    """

    def __init__(self, tracks: Tracks, body: str) -> None:
        tracks = from_first_samples(tracks)
        self.tracks, self.body = tracks, body
        self._flights = [flight_of(track, tracks.gravity) for track in tracks.recordings if track.body == body]
        self.error_model = tracking_error(tracks)
        self._starts = [Released(track, tracks.nuisances, tracks.gravity, self.error_model) for track in self._flights]
        candidates = track_candidates(tracks, body, self._flights)
        self.axes = tuple(sorted({a for track in self._flights for a in track.axes}))
        interval = max(float(np.ptp(track.t)) for track in tracks.recordings) / (KNOTS - 1)  # one for all: it is of the surroundings
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
        """The rows that are scored. Its noise is what the tracking error does to them, by way of the start too where that is held out."""
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
        """The scored frames (P, n, A) of several points, and the nuisances (P, k) that were settled on."""
        track, start, forces = self._flights[recording], self._starts[recording], self.forces(points, self._flights[recording])
        early = _early(track) if track.role == "held_out" else 0
        values = settle(start, forces, len(points), early or len(track.t))
        return start.seen(values, forces, track.t)[:, early:], values

    def nuisances_of(self, point: Point, recording: int) -> dict[str, float]:
        """What `predict` takes for the start and the instruments of a recording at one point, by name."""
        _, values = self._profile([point], recording)
        return {p.name: float(v) for p, v in zip(self._starts[recording].parameters, values[0], strict=True)}

    def forces(self, points: Sequence[Point], track: Track) -> Forces:
        """What acts on the body at several points, a row each."""

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

    def witness(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """What the `fit` recordings say of each effect of the surroundings by itself: its sizes (k,), and their information matrix (k, k).

        Linearised about the declared model, in the metric of the tracking error, scaled down to the residual that remains; in the units of
        the parameters. The place of `position_force` enters as one more uniform acceleration along each axis.
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
            J = np.concatenate([every[:, first - 1 : first - 1 + k], 1e-3 * np.eye(k)])  # what does not show is not known, not singular
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
    """One problem for each body of a folder.

    An effect of the surroundings acts on every body. In a folder of several, their estimates of it (`TrackProblem.witness`) must agree:
    Cochran's Q at the level `DISAGREE`. Where they do, its range is that about their common estimate; where they do not it is no candidate,
    and `labels["excluded"]` says so. A wind beside a drag on some of the bodies is thus not found.
    """
    tracks = folder if isinstance(folder, Tracks) else read_tracks(folder)
    problems = tuple(TrackProblem(tracks, body) for body in tracks.bodies)
    if len(problems) > 1:
        votes = [problem.witness() for problem in problems]
        for axes in dict.fromkeys(problem.axes for problem in problems):  # bodies with other axes do not vote together
            group = [i for i, problem in enumerate(problems) if problem.axes == axes]
            for name in SURROUNDINGS:
                agreed = _agreement([votes[i][name] for i in group if name in votes[i]])
                for i in group:
                    _restrict(problems[i], name, agreed)
    return problems


def _agreement(votes: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray] | None:
    """The common estimate and its standard deviations of estimates with their information; none where they differ by more than chance."""
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
    """Bring an effect of the surroundings into the range on which the bodies agree, or leave it out."""
    kept = []
    for candidate in problem.candidates:
        if candidate.name == name and agreed is None:
            problem.labels.setdefault("excluded", {})[name] = "acts on every body of the folder, and no one size of it suits them all"
            continue
        if candidate.name == name and agreed is not None:
            sizes = candidate.size_parameters
            made = {}
            for p, mean, deviation in zip(sizes, *agreed):  # position_force has more entries: those of its place
                half = WITNESS * float(deviation) + LEAST_HALF * p.scale
                made[p.name] = replace(p, lower=max(p.lower, min(mean - half, p.value)), upper=min(p.upper, max(mean + half, p.value)))
            parameters = tuple(made.get(p.name, p) for p in candidate.parameters)
            limits = {p.name: (p.lower, p.upper) for p in parameters}
            own = {p.name for p in sizes}
            starts = tuple({k: _inside(v, *limits[k], nonzero=k in own) for k, v in start.items()} for start in candidate.starts)
            candidate = replace(candidate, parameters=parameters, starts=starts)
        kept.append(candidate)
    object.__setattr__(problem, "candidates", tuple(kept))


def _inside(value: float, lower: float, upper: float, *, nonzero: bool) -> float:
    """The value within a range; for one that must not vanish, in a range that ends at zero, a third of the way to the other end."""
    inside = min(max(value, lower), upper)
    return (lower if abs(lower) > abs(upper) else upper) / 3 if nonzero and inside == 0 else inside


def from_first_samples(tracks: Tracks) -> Tracks:
    """Tracks whose clocks are zero at the first sample of each recording."""
    return replace(tracks, recordings=tuple(replace(track, t=track.t - track.t[0]) for track in tracks.recordings))


def flight_of(track: Track, gravity: Sequence[float]) -> Track:
    """A track without the frames after an impact at its end.

    An impact is a loss of speed, along the mean motion of the five frames before, from one frame to the next, of more than four standard
    deviations of the noise and more than three times what gravity could take. Only the last six frames are looked at.
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
    """How many frames of a held-out track its start is estimated from."""
    return max(math.ceil(EARLY * len(track.t)), 2)


def tracking_error(tracks: Tracks) -> SeriesError:
    """Noise and slow error of the tracking, from the `fit` recordings of all bodies; see `noise.correlation`."""
    flights = [flight_of(track, tracks.gravity) for track in tracks.of("fit")]
    return correlation([(track.t, channel) for track in flights for channel in track.x.T])


def track_candidates(tracks: Tracks, body: str, flights: Sequence[Track]) -> tuple[Candidate, ...]:
    """The effects that a body may lack, in the scales of its motion. Only components along measured axes are asked for."""
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
    most = 0.75 * AIR * LARGEST_DRAG / (density * diameter)  # k of a sphere: cross-section over mass
    out: list[Candidate] = []

    def add(name: str, start: Mapping[str, float], *parameters: tuple, sizes: str = "", others: Sequence[Mapping[str, float]] = ()) -> None:
        """Parameters as (name, typical step, lower, upper); `sizes` are those that vanish with the effect, all where empty."""
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
