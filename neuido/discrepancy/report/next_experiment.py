"""Proposal of the next experiment: the change that would best tell apart the members of a class.

The members (rivals) are simulated in a list of changed experiments. The best change has the largest distance between the two rivals that
are nearest to each other (T-optimal design: Box and Hill 1967, Atkinson and Fedorov 1975). The distance is weighted by noise and
discretisation, after a refit of the rival's parameters within their intervals. Half its square is the expected logarithm of the odds.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch

from neuido.data.measured.experiment import Recording as Measured
from neuido.data.measured.material_test import CURVES, MaterialTest
from neuido.discrepancy.inference.search.attribution import Diagnosis
from neuido.discrepancy.problems.problem import Point, Problem
from neuido.errors import UserError
from neuido.types import AttachedMass, Body, Box

MOST_RIVALS = 4
FINALISTS = 3
"""Number of changes whose distances are computed with a refit."""
RUNS = 2.0
"""Number of neighbouring data that count as one, because their errors are not independent."""
TELLS = 0.5 * math.log(10.0)
"""Expected logarithm of the odds below which evidence is "not worth more than a bare mention" (Jeffreys, Theory of Probability, 1961)."""


class Rival(NamedTuple):
    """A member of a class with its fitted parameters."""

    name: str
    point: Point
    names: tuple[str, ...]
    """Names of the parameters that a refit may change."""


def propose(d: Diagnosis) -> dict[str, Any] | None:
    """Propose the change that best tells apart the last class with several members.

    Returns:
        `change`, `tells_apart` (the two nearest rivals), `expected_log_odds` (natural logarithm), and `others`, the next best changes.
        None where there is no such class, no change can be simulated or tells more than `TELLS`, or the time is up.
    """
    rivals = rivals_of(d)
    if len(rivals) < 2:
        return None
    inner, quick = getattr(d.problem, "problem", d.problem), d.problem.quick(d.setting)
    setting = quick if all(d.problem.bears(r.point, quick) for r in rivals) else d.setting
    if any(r.clamps for r in getattr(inner, "measured", ())):  # no other path of a clamp is simulated
        return None
    if hasattr(inner, "motion"):
        catalogue = _bodies(inner if inner.tracked else inner.as_tracked(), rivals[0].point, setting)
    elif hasattr(inner, "tests"):
        catalogue = _materials(inner)
    elif hasattr(inner, "tracks"):
        catalogue = _tracks(inner)
    else:  # a plane specimen: no other loading is simulated
        return None
    first = []
    for name, problem, sigma in catalogue:
        if d.budget.skips("the next experiment"):
            return None
        rows = problem.predict([r.point for r in rivals], 0, setting)
        if np.isfinite(rows).all():
            first.append((*_nearest(rows, [np.empty((rows.shape[1], 0))] * len(rows), sigma(rows)), name, problem, sigma, rows))
    first.sort(key=lambda entry: -entry[0])
    final = []
    for _, _, name, problem, sigma, rows in first[:FINALISTS]:
        if d.budget.skips("the next experiment"):
            return None
        slopes = [_slopes(d, problem, rival, setting) for rival in rivals]
        odds, pair = _nearest(rows, slopes, sigma(rows))
        final.append((odds, pair, name))
    final.sort(key=lambda entry: -entry[0])
    if not final or final[0][0] < TELLS:
        return None
    odds, pair, name = final[0]
    return {
        "change": name,
        "tells_apart": [rivals[i].name for i in pair],
        "expected_log_odds": round(odds, 2),
        "others": [{"change": name, "expected_log_odds": round(odds, 2)} for odds, _, name in final[1:]],
    }


def rivals_of(d: Diagnosis) -> list[Rival]:
    """Return the best fit of each effect in the last class with several; an empty list where there is none."""
    for r in reversed(d.rounds):
        members = r.members if r.chosen is not None else []
        best: dict[str, Rival] = {}
        for t in members:
            own = tuple(p.name for p in (*d.problem.declared, *t.candidate.size_parameters))
            best.setdefault(t.candidate.name, Rival(t.candidate.name, t.fit.point, own))
        if len(best) > 1:
            return list(best.values())[:MOST_RIVALS]
    return []


def _nearest(rows: np.ndarray, slopes: Sequence[np.ndarray], sigma: np.ndarray) -> tuple[float, tuple[int, int]]:
    """Return the expected log odds of the two nearest rivals, after a refit of either to the other, and their numbers.

    Args:
        rows: Predictions of the rivals, (R, n).
        slopes: For each rival the change of its data by one standard deviation of each parameter, (n, p).
        sigma: Standard deviation of each value, (n,).
    """
    best = (math.inf, (0, 1))
    for i, j in itertools.combinations(range(len(rows)), 2):
        r = (rows[i] - rows[j]) / sigma
        left = []
        for J in (slopes[i], slopes[j]):
            A = np.concatenate([J / sigma[:, None], np.eye(J.shape[1])])  # parameters in standard deviations
            b = np.concatenate([r, np.zeros(J.shape[1])])
            rest = b - A @ np.linalg.lstsq(A, b, rcond=None)[0] if J.shape[1] else b
            left.append(float(rest @ rest))
        best = min(best, (0.5 * min(left) / RUNS, (i, j)))
    return best


def _slopes(d: Diagnosis, problem: Problem, rival: Rival, setting: int) -> np.ndarray:
    """Return the change of the data by one standard deviation of each parameter of a rival, (n, p)."""
    asked, here = [], dict(rival.point)
    for name in rival.names:
        p = d.problem.parameter(name)
        low, high = d.intervals.get(name, (0.0, 0.0))
        q = p.coordinate(here.get(name, p.value))
        sd = (p.coordinate(high) - p.coordinate(low)) / 3.29 if low < high else 1.0
        asked.append(here | {name: p.physical(q + sd)})
    rows = problem.predict([here, *asked], 0, setting)
    change = (rows[1:] - rows[0]).T
    return np.where(np.isfinite(change), change, 0.0)


# Bodies.


def _bodies(problem: Problem, point: Point, setting: int) -> Iterator[tuple[str, Problem, Any]]:
    """Yield changed experiments of a body: name, problem, and function from predictions to their standard deviations (n,).

    They are changes of the first fitted recording. The discretisation error is the difference of another setting at `point`.
    """
    n = problem.roles["fit"][0]
    base = problem.measured[n]
    noise = problem.recordings[n].noise or 1e-3
    _, frame = np.unique(problem.recordings[n].times, return_inverse=True)
    for name, changed in changes(base, problem.experiment.model["density"]):
        made = replace(problem, measured=(changed,), recordings=(problem.recordings[n],), nuisances=())

        def sigma(rows: np.ndarray, made: Problem = made) -> np.ndarray:
            other = made.predict([point], 0, 0 if setting else 1)[0] if made.settings > 1 else rows[0]
            spread = np.where(np.isfinite(other), other - rows[0], 0.0)
            return np.sqrt(noise**2 + (np.bincount(frame, spread**2) / np.bincount(frame))[frame])

        yield name, made, sigma


def changes(r: Measured, density: float) -> Iterator[tuple[str, Measured]]:
    """Yield changes of a recording with their names: other launches, poses, loads or lengths; turned bodies must fit the scene."""
    x = r.body.x.double()
    centre = x.mean(dim=0)
    velocity = r.body.v.double()
    mean = velocity.mean(dim=0)
    extent = float((x.amax(dim=0) - x.amin(dim=0)).max())
    swing = float((velocity - mean).norm(dim=1).max())
    yield "launch it at twice the speed", _moved(r, velocity + mean)
    yield "launch it at half the speed", _moved(r, velocity - 0.5 * mean)
    if swing > 0.02 * max(float(mean.norm()), 0.1):
        yield "spin it the other way round", _moved(r, 2 * mean - velocity)
        yield "launch it without a spin", _moved(r, mean.expand_as(velocity))
    rate = max(float(mean.norm()), 1.0) / extent
    for axis, name in ((0, "x"), (2, "z")):
        spin = torch.zeros(3, dtype=x.dtype)
        spin[axis] = rate
        yield f"spin it about {name} at {rate:.2g} rad/s", _moved(r, velocity + torch.cross(spin.expand_as(x), x - centre, dim=1))
    for axis, name in ((0, "x"), (2, "z")):
        turned = _turned(r, axis)
        if turned is not None:
            yield f"turn the body by 90 degrees about {name} before the launch", turned
    whole = float(r.body.volume.double().sum()) * density
    top = x[:, 1] > x[:, 1].max() - 0.25 * (x[:, 1].max() - x[:, 1].min())
    box = Box(tuple((x[top].amin(dim=0) - 1e-6).tolist()), tuple((x[top].amax(dim=0) + 1e-6).tolist()))
    loaded = replace(r.scene, attached_masses=(*r.scene.attached_masses, AttachedMass(box, 0.5 * whole)))
    yield f"attach {0.5 * whole:.3g} kg to its upper quarter", replace(r, scene=loaded)
    if any(p.contact == "separate" and p.friction < 0.3 for p in r.scene.colliders):
        planes = tuple(replace(p, friction=0.6) if p.contact == "separate" else p for p in r.scene.colliders)
        yield "give the floor a friction of 0.6", replace(r, scene=replace(r.scene, colliders=planes))
    if r.t is not None:
        longer = r.t * 1.8
        yield f"record for {float(longer[-1]):.2g} s", replace(r, t=longer, frame_interval=1.8 * r.frame_interval)


def _moved(r: Measured, velocity: torch.Tensor) -> Measured:
    return replace(r, body=r.body._replace(v=velocity.to(r.body.v.dtype)))


def _turned(r: Measured, axis: int) -> Measured | None:
    """Turn the body of a recording by a right angle about its centre; None if it then leaves the domain or meets a collider.

    The mean velocity stays, and the spin turns with the body.
    """
    R = torch.eye(3, dtype=torch.float64)
    i, j = [a for a in range(3) if a != axis]
    R[i, i], R[i, j], R[j, i], R[j, j] = 0.0, -1.0, 1.0, 0.0
    x, v = r.body.x.double(), r.body.v.double()
    centre = x.mean(dim=0)

    def turned(p: torch.Tensor) -> torch.Tensor:
        return centre + (p.double() - centre) @ R.T

    place = turned(x)
    low, high = (place.new_tensor(c) for c in (r.scene.lower, r.scene.upper))
    if bool(((place < low) | (place > high)).any()):
        return None
    for plane in r.scene.colliders:
        normal = place.new_tensor(plane.normal) / place.new_tensor(plane.normal).norm()
        if float(((place - place.new_tensor(plane.point)) @ normal).min()) < 0:
            return None
    mean = v.mean(dim=0)
    F = None if r.body.F is None else (R @ r.body.F.double() @ R.T).float()
    body = Body(place.float(), (mean + (v - mean) @ R.T).float(), r.body.volume, F)
    return replace(r, body=body, x=turned(r.x).float(), anchor=None if r.anchor is None else turned(r.anchor).float())


# Tracks and material tests.


class _Launches(Problem):
    """A point mass that starts in another way, with data from which the part that a change of the start would explain is removed."""

    def __init__(self, problem: Problem, velocity: np.ndarray, t: np.ndarray, place: float = 0.0) -> None:
        super().__init__("", "rmse", "m", (), (), (), ())
        self.inner, self.velocity, self.t, self.place = problem, velocity, t, place

    def predict(self, points: Sequence[Point], recording: int, setting: int = 0) -> np.ndarray:
        from neuido.physics.points.point_mass import fly

        track = self.inner._flights[self.inner.roles["fit"][0]]
        count = len(points)
        forces, begun = self.inner.forces(points, track), np.zeros((count, 3))
        begun[:, 0] = self.place
        if forces.floor_normal is not None:  # from the floor
            begun += np.asarray(forces.floor_height)[:, None] * forces.floor_normal
        x = fly(self.t, begun, np.tile(self.velocity, (count, 1)), np.zeros(count), forces)
        basis = np.linalg.qr(np.stack([np.ones_like(self.t), self.t], axis=1))[0]
        return (x - np.einsum("tk,sk,psa->pta", basis, basis, x)).reshape(count, -1)


def _tracks(problem: Problem) -> Iterator[tuple[str, Problem, Any]]:
    """Yield throws of a point mass: name, problem, and function from predictions to their standard deviations (n,)."""
    t = np.linspace(0.0, max(float(r.times.max()) for r in problem.recordings), 60)
    speed = max(float(np.ptp(r.y)) / max(float(np.ptp(r.times)), 1e-9) for r in problem.recordings)
    noise = problem.error_model
    constraint = problem.tracks.constraint
    if constraint is not None and constraint.type != "bounce":
        yield from _guided(problem, constraint.type, t)
        return
    for name, v, scale in (
        ("drop it from rest, twice as long", (0.0, 0.0, 0.0), 2.0),
        (f"throw it up at {speed:.2g} m/s", (0.0, speed, 0.0), 1.0),
        (f"throw it level at {2 * speed:.2g} m/s", (2 * speed, 0.0, 0.0), 1.0),
        (f"throw it level at {0.5 * speed:.2g} m/s", (0.5 * speed, 0.0, 0.0), 1.0),
        (f"throw it down at {2 * speed:.2g} m/s", (0.0, -2 * speed, 0.0), 1.0),
    ):
        size = math.hypot(noise.sigma, noise.amplitude)
        yield name, _Launches(problem, np.array(v), scale * t), lambda rows, size=size: np.full(rows.shape[1], size)


def _guided(problem: Problem, kind: str, t: np.ndarray) -> Iterator[tuple[str, Problem, Any]]:
    """Yield other starts of a guided body: name, problem, and function from predictions to their standard deviations (n,)."""
    track = problem._flights[problem.roles["fit"][0]]
    reach = 0.5 * float(np.ptp(track.x)) * (problem.tracks.constraint.figures["length"] if track.angle and kind == "pendulum" else 1.0)
    swings = kind in ("pendulum", "spring")
    speed = 0.0 if swings else float(np.ptp(track.x)) / max(float(np.ptp(track.t)), 1e-9)
    size = math.hypot(problem.error_model.sigma, problem.error_model.amplitude)
    dense = np.linspace(0.0, t[-1], 400)
    for factor, longer in ((0.5, 1.0), (2.0, 1.0), (1.0, 2.0)):
        far = "half as" if factor < 1 else "twice as" if factor > 1 else "as"
        name = f"start it {far} {'far' if swings else 'fast'}" + (" and record twice as long" if longer > 1 else "")
        start = np.array([factor * speed, 0.0, 0.0])
        yield name, _Launches(problem, start, longer * dense, factor * reach * swings), lambda rows: np.full(rows.shape[1], size)


class _Loads(Problem):
    """Another test of the same material."""

    def __init__(self, problem: Problem, mode: str, path: np.ndarray, time: np.ndarray | None) -> None:
        super().__init__("", "rmse", "Pa", (), (), (), ())
        self.inner, self.mode, self.path, self.time = problem, mode, path, time

    def predict(self, points: Sequence[Point], recording: int, setting: int = 0) -> np.ndarray:
        from neuido.physics.points.material_point import stress_along

        path = torch.from_numpy(self.path)
        time = None if self.time is None else torch.from_numpy(self.time)
        try:
            out = stress_along(self.inner._specimen(points), self.mode, path, time=time)
        except UserError:  # outside of what the law admits
            return np.full((len(points), path.numel()), np.nan)
        return out.reshape(len(points), -1).numpy()


class _Curve(Problem):
    """Another curve of the same material, which begins anew."""

    def __init__(self, problem: Problem, test: MaterialTest) -> None:
        super().__init__("", "rmse", "1", (), (), (), ())
        self.inner, self.test = problem, test

    def predict(self, points: Sequence[Point], recording: int, setting: int = 0) -> np.ndarray:
        return self.inner.along(points, [self.test])


def _curves(problem: Problem, tests: Sequence[MaterialTest]) -> Iterator[tuple[str, Problem, Any]]:
    """Yield curves at lower and at higher rates or frequencies, and rates that are held longer, as `_materials`."""
    test = tests[0]
    what = "shear rates" if test.mode == "flow_curve" else "frequencies"
    noise = max([r.noise or 0.0 for r in problem.recordings]) or 0.01  # of logarithms
    changes = [(f"{what} ten times as low", 0.1, 1.0), (f"{what} ten times as high", 10.0, 1.0)]
    if test.time is not None:
        changes += [(f"the same {what}, each held ten times as long", 1.0, 10.0), (f"the same {what}, ten times as fast through", 1.0, 0.1)]
    for name, factor, longer in changes:
        time = None if test.time is None else longer * test.time
        other = replace(test, path=factor * test.path, time=time)
        yield name, _Curve(problem, other), lambda rows: np.full(rows.shape[1], noise)


def _materials(problem: Problem) -> Iterator[tuple[str, Problem, Any]]:
    """Yield material tests: name, problem, and function from predictions to their standard deviations (n,).

    They are of all modes, up to the measured stretch and beyond it, with and without the way back. Flow curves and small oscillations are
    of other rates and frequencies.
    """
    tests = [t for t in problem.tests.tests if t.role == "fit"]
    if tests[0].mode in CURVES:
        yield from _curves(problem, tests)
        return
    largest = max(float(np.abs(t.path if t.mode == "simple_shear" else np.log(t.path)).max()) for t in tests)
    timed = all(t.time is not None for t in tests)
    duration = max(float(np.ptp(t.time)) for t in tests) if timed else 0.0
    stress = max(float(np.abs(t.stress).max()) for t in tests)
    noise = max([r.noise or 0.0 for r in problem.recordings]) + 0.01 * stress
    up = np.linspace(0.0, 1.0, 16)[1:]
    modes, paces = ("uniaxial", "equibiaxial", "pure_shear", "biaxial", "simple_shear"), (1.0, 0.1) if timed else (1.0,)
    for mode, factor, back, pace in itertools.product(modes, (1.0, 1.3), (False, True), paces):
        course = np.concatenate([up, up[-2::-1]]) if back else up
        e = factor * largest * course
        path = e[:, None] if mode == "simple_shear" else np.exp(np.stack([e, 0.5 * e], 1) if mode == "biaxial" else e[:, None])
        time = pace * duration * np.arange(1, len(e) + 1) / len(e) if timed else None
        span = f"shear {e.max():.2g}" if mode == "simple_shear" else f"stretch {math.exp(e.max()):.3g}"
        name = f"{mode.replace('_', ' ')} to {span}{' and back' if back else ''}{', ten times as fast' if pace < 1 else ''}"
        yield name, _Loads(problem, mode, path, time), lambda rows: np.full(rows.shape[1], noise)
