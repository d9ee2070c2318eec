"""Tracks as `Problem`s, one per body: a point mass that flies or is guided, measured with errors of clock and length scale."""

import copy
import math
import os
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.stats import chi2

from neuido.data.measured.track import AIR, AXES, Track, Tracks, read_tracks
from neuido.discrepancy.problems.noise import SeriesError, correlation, high_pass, strays
from neuido.discrepancy.problems.problem import Point, Problem, Recording
from neuido.discrepancy.problems.tracks.guides import guide_of, normal_of
from neuido.discrepancy.problems.tracks.released import Released, scale_gradient, settle, settled_error
from neuido.discrepancy.problems.tracks.scale_error import of_another_scale
from neuido.discrepancy.problems.tracks.track_candidates import declared_parameter, ordinary_sizes, track_candidates
from neuido.physics.effects.library import KNOTS
from neuido.physics.points.point_mass import Forces

SURROUNDINGS = ("gravity", "uniform_acceleration", "position_force", "time_force")
"""Effects of the surroundings, which are the same for all bodies of a folder. All others belong to a body."""
MOST_FRAMES = 3000
"""Frames of a recording that are fitted at the most, evenly spread: more add time and hardly any information."""
EARLY = 0.4
"""Share of the frames of a held-out recording that determine its start and are not scored."""
LEAST_STRAY = 1e-3
"""Noise below which no frame is taken for a stray, as a share of the path: without noise every corner of a motion would be one."""
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
    Frames after an impact at the end of a flight, and single frames far from their neighbours, are left out (`flight_of`). Times count
    from the first sample of each recording.

    Args:
        tracks: The folder's content.
        body: Name of the body.
    """

    def __init__(self, tracks: Tracks, body: str) -> None:
        tracks, lost = without_strays(from_first_samples(tracks))
        self.tracks, self.body = tracks, body
        self._flights = [flight_of(track, tracks) for track in tracks.recordings if track.body == body]
        self.error_model = tracking_error(tracks)
        candidates = track_candidates(tracks, body, self._flights)
        self.axes = tuple(sorted({a for track in self._flights for a in track.axes}))
        interval = max(float(np.ptp(track.t)) for track in tracks.recordings) / (KNOTS - 1)  # the same for all bodies
        self._partners = {p.name: p.value for c in candidates for p in c.parameters} | {"time_force.interval": interval} | tracks.effects
        self._starts = [self._released(track, {c.name for c in candidates}) for track in self._flights]
        super().__init__(
            name=f"{tracks.name}: {body}",
            measure="rmse",
            unit="rad" if self._flights[0].angle else "m",
            declared=tuple(declared_parameter(tracks, name, self._flights) for name in tracks.free),
            nuisances=(),
            candidates=candidates,
            recordings=tuple(map(self._recording, self._flights, self._starts)),
            labels={"kind": "track", "body": body, "ordinary": ordinary_sizes(tracks, body)} | _said(lost, self._flights, tracks),
        )

    def _released(self, track: Track, effects: set[str]) -> Released:
        """Return the nuisances of a recording."""
        tracks = self.tracks
        sigma = self.error_model.sigma if track.noise is None else track.noise
        kind = None if tracks.constraint is None else tracks.constraint.type
        pull = self._stiffness({})
        rate = math.sqrt(pull) if kind != "pendulum" else math.sqrt(np.linalg.norm(tracks.gravity) / tracks.constraint.figures["length"])
        guide = guide_of(track, tracks.constraint, sigma, tracks.gravity, pull)
        known = effects | {name.partition(".")[0] for name in tracks.effects}
        spins = "magnus" in known or (kind == "bounce" and track.spin is not None)
        spin = (0, 1, 2) if len(track.axes) == 3 else tuple(a for a in range(3) if a not in track.axes)
        level = [a for a in track.axes if not abs(normal_of(None, tracks.gravity)[a]) > 0.9]
        return Released(
            guide,
            tracks.nuisances,
            self.error_model,
            period=2 * math.pi / rate if rate > 0 else math.inf,
            spin=spin if spins else (),
            attitude=tuple(level) if "lift" in known else (),
        )

    def _stiffness(self, point: Point) -> float:
        """Return the squared angular frequency of a spring or an axis in a parameter set [1/s^2]; 0 without one."""
        constraint = self.tracks.constraint
        if constraint is None or "stiffness" not in constraint.figures:
            return 0.0
        mass = self.tracks.bodies[self.body]["mass"] if constraint.type == "spring" else 1.0
        return float(point.get("stiffness", constraint.figures["stiffness"])) / mass

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

    def noise_with(self, point: Point, recording: int) -> float | None:
        """Return the same as the noise of a recording, with the spin and attitude on which the effects of a point depend."""
        track, start = self._flights[recording], self._starts[recording]
        if track.role != "held_out":
            return self.recordings[recording].noise
        return settled_error(start, self.forces([point], track), _early(track))

    def instrument_errors(self, point: Point, recording: int) -> np.ndarray:
        track, start = self._flights[recording], self._starts[recording]
        if not any(name == "length_scale" for name in start.names) or track.role == "held_out":
            return super().instrument_errors(point, recording)
        return scale_gradient(start, self.forces([point], track)).reshape(-1, 1)

    def with_scale_error(self, sd: float) -> "TrackProblem":
        """Return this problem with a length scale of at least this standard deviation; noise and candidates stay as they are."""
        other = copy.copy(self)
        sd = max(sd, self.tracks.nuisances["length_scale"])
        other.tracks = replace(self.tracks, nuisances={**self.tracks.nuisances, "length_scale": sd})
        other._starts = [other._released(track, {c.name for c in self.candidates}) for track in self._flights]
        return other

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

    def misfit_by_scale(self, point: Point, recording: int) -> tuple[float, float]:
        """Return the sum of squares of `whitened` with a scale that may change along the path too, and its error at the far end.

        One standard deviation of the change is that of the scale (`released.scale_gradient`); what it explains is to first order.
        """
        start, left = self._starts[recording], self.whitened([point], recording)[0]
        column = scale_gradient(start, self.forces([point], self._flights[recording]))
        column = np.concatenate([start.whiten(column[None]).reshape(-1), np.zeros(len(left) - column.size)])
        along, square = float(column @ left), 1.0 + float(column @ column)
        own = next(p for p in start.parameters if p.name.startswith("length_scale"))
        far = self.nuisances_of(point, recording)[own.name] - along / square * own.scale * own.prior
        return float(left @ left) - along**2 / square, far

    def whitened(self, points: Sequence[Point], recording: int) -> np.ndarray:
        """Return the whitened residuals of a fitted recording and its nuisances in units of their priors, (P, m)."""
        seen, values = self._profile(points, recording)
        start = self._starts[recording]
        r = start.whiten(seen - self._flights[recording].x).reshape(len(points), -1)
        return np.concatenate([r, start.off_prior(values)], axis=1)

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
        coefficient = rows("magnus.coefficient")
        if coefficient is not None:
            magnus = (0.0 if magnus is None else magnus) + coefficient[:, None] * np.array(track.spin)
        knots = [vectors("time_force", f"{{}}{j}") for j in range(KNOTS)]
        force = None
        if any(k is not None for k in knots):
            force = np.stack([np.zeros((len(points), 3)) if k is None else k for k in knots], 1)
        sizes = sizes if more is None else sizes + more
        added, fluid = rows("added_mass.c"), rows("buoyancy.q")
        if fluid is not None:
            sizes, added = sizes * (1 - fluid), (1 + (0.0 if added is None else added)) * (1 + 0.5 * fluid) - 1
        attitude = normal_of(None, self.tracks.gravity) if track.attitude is None else np.array(track.attitude)
        lift, lift_drag = rows("lift.k"), rows("lift.d")
        local = rows("local_force.a0")
        free = Forces(
            gravity=sizes[:, None] * down,
            uniform_acceleration=vectors("uniform_acceleration"),
            drag_linear=rows("drag_linear.k"),
            drag_quadratic=rows("drag_quadratic.k"),
            magnus=magnus,
            position_force=rows("position_force.k"),
            position_centre=vectors("position_force"),
            time_force=force,
            time_force_interval=float(self._partners.get("time_force.interval", 1.0)),
            added_mass=added,
            dry_friction=rows("dry_friction.c"),
            local_force=local,
            local_centre=None if local is None else vectors("local_force"),
            local_width=None if local is None else rows("local_force.w"),
            lift=lift,
            lift_drag=lift_drag,
            disc_normal=None if lift is None and lift_drag is None else attitude / np.linalg.norm(attitude),
        )
        return free if self.tracks.constraint is None else self._guided(free, points, track, sizes)

    def _guided(self, free: Forces, points: Sequence[Point], track: Track, gravity: np.ndarray) -> Forces:
        """Return the forces on a body that its constraint guides, from those in flight and the size of gravity (P,)."""
        constraint = self.tracks.constraint
        given = {name: np.array([float(p.get(name, value)) for p in points]) for name, value in constraint.figures.items()}
        normal = normal_of(constraint, self.tracks.gravity)
        if constraint.type == "pendulum":
            return free._replace(gravity=(0.0, 0.0, 0.0), pendulum=np.stack([gravity, given["length"]], axis=1))
        if constraint.type in ("spring", "axis"):
            pull = np.array([self._stiffness(p) for p in points])
            more = 0.0 if free.position_force is None else free.position_force
            return free._replace(gravity=(0.0, 0.0, 0.0), position_force=pull + more, position_centre=None)
        if constraint.type == "plane":
            whole = np.broadcast_to(free.gravity, (len(points), 3))
            return free._replace(gravity=(whole - (whole @ normal)[:, None] * normal) / (1 + given["inertia"])[:, None])
        more = [
            np.array([float(p.get(name, self._partners.get(name, 0.0))) for p in points])
            for name in ("bounce_friction.mu", "bounce_speed.p")
        ]
        radius = 0.5 * self.tracks.bodies[self.body].get("diameter", 0.0)
        return free._replace(
            floor_normal=normal,
            floor_height=given["floor"],
            restitution=given["restitution"],
            restitution_speed=more[1],
            bounce_friction=given["friction"] + more[0],
            roundness=given["inertia"],
            surface_velocity=None if track.spin is None else radius * np.array(track.spin),
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
            r = self.whitened(asked, n)
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
        more: dict[str, Any] = {}
        if (constraint := self.tracks.constraint) is not None:
            figures = {name: float(values.get(name, figure)) for name, figure in constraint.figures.items()}
            normal = {} if constraint.normal is None else {"normal": list(constraint.normal)}
            more["constraint"] = {"type": constraint.type} | figures | normal
        if self.tracks.fluid_density != AIR:
            more["fluid_density"] = self.tracks.fluid_density
        own |= {name: float(value) for name, value in values.items() if name.partition(".")[0] in effects and "." in name}
        if any(name.startswith("time_force.") for name in own):
            own["time_force.interval"] = float(self._partners["time_force.interval"])
        return {"gravity": gravity.tolist(), "effects": self.tracks.effects | own, "free": list(self.tracks.free)} | more


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


def without_strays(tracks: Tracks) -> tuple[Tracks, dict[str, int]]:
    """Return tracks without the frames where a tracker lost the point (`noise.strays`), and their number in each recording.

    One frame that is off by a twentieth of the path would be more than all that a drag does.
    """
    kept, lost = [], {}
    for track in tracks.recordings:
        sigma = track.noise or high_pass([(track.t, channel) for channel in track.x.T]) or 0.0
        far = strays(track.t, track.x, max(sigma, LEAST_STRAY * float(np.ptp(track.x, axis=0).max())))
        lost[track.name] = int(far.sum())
        kept.append(replace(track, t=track.t[~far], x=track.x[~far]) if far.any() else track)
    return replace(tracks, recordings=tuple(kept)), lost


def _said(lost: dict[str, int], flights: Sequence[Track], tracks: Tracks) -> dict[str, str]:
    """Return the label that tells which frames of a body were left out, and which recordings have another scale; none if there is none."""
    own = [f"{lost[track.name]} of {track.name}" for track in flights if lost[track.name]]
    said = [f"Frames far from those before and after were left out: {', '.join(own)}."] if own else []
    for track, ratio in of_another_scale([track for track in tracks.recordings if track.angle == flights[0].angle]):
        if track.body == flights[0].body:
            times, word = max(ratio, 1 / ratio), "longer" if ratio > 1 else "shorter"
            said.append(f"The path of {track.name} is {times:.0f} times {word} than those of the other recordings: is it in the same unit?")
    return {"unseen": " ".join(said)} if said else {}


def flight_of(track: Track, tracks: Tracks) -> Track:
    """Return the frames of a recording that are fitted.

    At most `MOST_FRAMES` are taken, and in free flight the frames after an impact at the end of a track are removed. An impact is a sudden
    loss of speed along the mean motion of the five frames before. It must exceed four standard deviations of the noise (`IMPACT`) and three
    times the loss that gravity could cause. Only the last six frames are searched.
    """
    every = math.ceil(len(track.t) / MOST_FRAMES)
    if tracks.constraint is not None:
        return replace(track, t=track.t[::every], x=track.x[::every])
    step, dt = np.diff(track.x, axis=0), np.diff(track.t)
    sigma = track.noise or high_pass([(track.t, channel) for channel in track.x.T]) or 0.0
    velocity = step / dt[:, None]
    g = max(float(np.linalg.norm(tracks.gravity)), 1e-9)
    for i in range(max(len(velocity) - 5, 6), len(velocity)):
        mean = np.median(velocity[i - 5 : i], axis=0)
        speed = float(np.linalg.norm(mean))
        if speed == 0:
            continue
        lost = speed - float(velocity[i] @ mean) / speed
        if lost > max(IMPACT * math.sqrt(2) * sigma / dt[i], 3 * g * dt[i]):
            track = replace(track, t=track.t[: i + 1], x=track.x[: i + 1])
            break
    return replace(track, t=track.t[::every], x=track.x[::every])


def _early(track: Track) -> int:
    """Return the number of frames of a held-out track that determine its start."""
    return max(math.ceil(EARLY * len(track.t)), 2)


def tracking_error(tracks: Tracks) -> SeriesError:
    """Estimate noise and slow error of the tracking from the `fit` recordings of all bodies (`noise.correlation`)."""
    flights = [flight_of(track, tracks) for track in tracks.of("fit")]
    return correlation([(track.t, channel) for track in flights for channel in track.x.T])
