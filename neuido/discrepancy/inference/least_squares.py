"""Least squares through a simulator: a covariance of few directions, and Levenberg-Marquardt fits that share their launches."""

from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from neuido.discrepancy.problems.problem import Parameter, Point, Problem
from neuido.discrepancy.store import Memo
from neuido.errors import UserError

SMALLER = (0.5, 0.25, 0.12, 0.06)
"""Factors of sizes that are tried where a fit's start does not run: explicit steps bear only so much viscosity, say."""
STEP = 0.02
"""Difference step, in typical steps of a parameter."""
OTHER_STEPS = (0.1, -1.0)
"""Factors, one after another, of a difference step that does not run: a tenth of it, and that on the other side."""
DAMPINGS = (0.1, 1.0, 10.0)
"""Tried as factors of the present damping."""
KEPT_PROMISE = 0.7
"""Share of the gain that the linear model promises at which a step is taken without trying other dampings."""
NEAR = 0.1
"""Margin below which the differences of the slopes mind the edge."""
EDGE = 0.02
"""Margin that a step leaves where it would go past the edge of what runs: differences of `STEP` are to run there."""
NOTHING = 2e-4
"""Relative gain, as the linear model promises it, that is not worth a run."""
BEHIND = 2.5
"""A fit that would end above so many times the lowest cost of a race, at the pace of its last step, is given up."""
TRAILING = 5.0
"""What a fit multiplies its tolerance by while it is more than a tenth above the lowest cost of a race."""
KEPT_UP = 3
"""Iterations over which a fit is trusted to keep up the pace of its last step; gains get smaller."""


class NotFinite(UserError):
    """A prediction that is not finite where linear algebra would need it."""


@dataclass(frozen=True, eq=False)
class Covariance:
    """sigma^2 I + U diag(s^2) U^T of the data of one recording, with orthonormal columns U (n, k)."""

    sigma: float
    directions: np.ndarray
    spread: np.ndarray

    @classmethod
    def of(cls, sigma: float, columns: np.ndarray) -> "Covariance":
        """sigma^2 I + L L^T for columns L (n, k)."""
        if not columns.size:
            return cls(sigma, np.empty((columns.shape[0], 0)), np.empty(0))
        if not np.isfinite(columns).all():
            raise NotFinite("predictions under different settings are not finite")
        values, vectors = np.linalg.eigh(columns.T @ columns)
        keep = values > max(1e-12 * values.max(), 1e-300)
        spread = np.sqrt(values[keep])
        return cls(sigma, (columns @ vectors[:, keep]) / spread, spread)

    def whiten(self, r: np.ndarray) -> np.ndarray:
        """Residuals (n,) or (n, m) in units of their standard deviation."""
        inside = self.directions.T @ r
        factor = 1.0 - self.sigma / np.sqrt(self.sigma**2 + self.spread**2)
        return (r - self.directions @ (factor[:, None] * inside if r.ndim == 2 else factor * inside)) / self.sigma


@dataclass(frozen=True, eq=False)
class Fit:
    """The end of a fit."""

    point: Mapping[str, float]
    names: tuple[str, ...]
    cost: float
    """Sum of squares of the whitened residuals, priors included."""
    residual: np.ndarray
    """Whitened, (n,), priors included; empty where the model runs nowhere."""
    evaluations: int
    converged: bool
    slopes: np.ndarray | None = None
    """About the derivatives of the whitened residuals by the coordinates where it ended, (n, p), without priors; none where not known."""
    setting: int = 0
    """Of the discretisation that it was made with."""


Whiten = Callable[[np.ndarray, int], np.ndarray]
"""(residual (n,) of a recording, its number) -> whitened residual of its fitted rows."""
Request = Generator[list[Point], list[np.ndarray | None], Fit]


class Race:
    """Fits that are compared with each other; one that cannot catch up any more stops."""

    def __init__(self, best: float = np.inf) -> None:
        self.best = best

    def lost(self, costs: Sequence[float], left: int) -> bool:
        """Whether a fit with these costs, one an iteration, has lost with so many iterations left."""
        self.best = min(self.best, costs[-1])
        if len(costs) < 3:
            return False
        failed = costs[-1] == costs[-2]  # one step that fails says only that it was too bold
        pace = (costs[-1] / max(costs[-3], 1e-300)) ** 0.5 if failed else costs[-1] / costs[-2]
        return costs[-1] * pace ** (left if failed else min(left, KEPT_UP)) > BEHIND * self.best


def levenberg_marquardt(
    parameters: Sequence[Parameter],
    start: Point,
    *,
    iterations: int = 12,
    tolerance: float = 2e-3,
    nothing: float = NOTHING,
    damping: float = 1e-2,
    together: bool = True,
    race: Race | None = None,
    slopes: np.ndarray | None = None,
    sizes: Sequence[str] = (),
    margin: Callable[[Point], float] = lambda point: np.inf,
    halt: Callable[[], bool] = lambda: False,
) -> Request:
    """One fit as a generator: it yields the points that it wants and receives their whitened residuals (None: not runnable).

    Where every point costs, the slopes of one step serve the next one, corrected by what it did (Broyden 1965); they are measured anew when
    a step keeps less than `KEPT_PROMISE` of what they promise, and before a fit ends.

    Args:
        parameters: What moves.
        start: Where, with the values of all that does not move.
        iterations: At most.
        tolerance: Relative gain of an iteration that ends the fit.
        nothing: Relative gain, as the linear model promises it, that is not worth a run.
        damping: Of the first step.
        together: Ask for all dampings and slopes of a step at once, where a launch of several points costs as one; else for few.
        race: The fits that it is compared with.
        slopes: About the derivatives of the whitened residuals by the coordinates at the start, (n, p); without the priors' rows.
        sizes: Parameters that begin smaller where the start does not run.
        margin: `Problem.margin` of a point: steps that would go past it are led along it.
        halt: Whether to end where the fit is, asked once an iteration.
    """
    names = tuple(p.name for p in parameters)
    fixed = {k: v for k, v in start.items() if k not in names}
    q = np.array([p.coordinate(start.get(p.name, p.value)) for p in parameters])
    low = np.array([_bound(p, p.lower) for p in parameters])
    high = np.array([_bound(p, p.upper) for p in parameters])
    count = 0

    def point_at(at: np.ndarray) -> Point:
        return fixed | {p.name: p.physical(v) for p, v in zip(parameters, at, strict=True)}

    def ask(asked: Sequence[np.ndarray]):
        """Residuals at coordinates, priors included."""
        nonlocal count
        count += len(asked)
        answers = yield [point_at(a) for a in asked]
        return [None if r is None else _with_priors(r, parameters, a) for r, a in zip(answers, asked, strict=True)]

    (r,) = yield from ask([q])
    if r is None and sizes:
        begun = [_scaled(q, parameters, sizes, factor) for factor in SMALLER]
        for some in [begun] if together else [[one] for one in begun]:
            answers = yield from ask(some)
            q, r = next(((one, a) for one, a in zip(some, answers, strict=True) if a is not None), (q, None))
            if r is not None:
                break
    cost = np.inf if r is None else float(r @ r)
    converged, costs, n = r is not None and not names, [cost], 0
    J, fresh = None if slopes is None or together or r is None else _with_prior_rows(slopes, parameters), False
    while n < iterations and r is not None and names and not halt():
        converged = False
        if J is None:
            steps = np.where(q + STEP > high, -STEP, STEP)
            if margin(point_at(q)) < NEAR:
                ends = [margin(point_at(q + step * e)) for step, e in zip(steps, np.eye(len(q)), strict=True)]
                steps = np.where(np.array(ends) < 0, -steps, steps)
            columns = yield from ask([q + np.eye(len(q))[i] * steps[i] for i in range(len(q))])
            for factor in OTHER_STEPS:  # a parameter whose step does not run is no parameter that does nothing
                lost = [i for i, c in enumerate(columns) if c is None]
                if lost:
                    again = yield from ask([q + np.eye(len(q))[i] * factor * steps[i] for i in lost])
                    for i, c in zip(lost, again, strict=True):
                        columns[i], steps[i] = c, factor * steps[i]
            if any(c is None for c in columns):
                break
            J = np.stack([(c - r) / s for c, s in zip(columns, steps, strict=True)], axis=1)
            fresh = True
        A, g = J.T @ J, J.T @ r
        tried = [np.clip(q + move, low, high) for move in _moves(A, g, damping)]
        tried = _along(lambda at: margin(point_at(at)), q, A, g, damping, tried, (low, high))
        promise = [-float((t - q) @ (2 * g + A @ (t - q))) for t in tried]
        if max(promise) < nothing * cost and np.abs(tried[0] - q).max() < 0.5:
            if fresh:
                converged = True
                break
            J = None
            continue
        found = yield from ask(tried if together else tried[:1])
        kept = together or (found[0] is not None and cost - float(found[0] @ found[0]) >= KEPT_PROMISE * promise[0])
        if not kept and fresh:
            found += yield from ask(tried[1:])
        ends = [np.inf if f is None else float(f @ f) for f in found]
        best = int(np.argmin(ends))
        if ends[best] >= cost and not fresh:
            J = None
            continue
        n += 1
        gain, moved = (cost - ends[best]) / cost if cost > 0 else 0.0, np.abs(tried[best] - q).max()
        if ends[best] < cost:
            move, change = tried[best] - q, found[best] - r
            q, r, cost = tried[best], found[best], ends[best]
            damping = max(damping * DAMPINGS[best], 1e-6)
            behind = race is not None and cost > 1.1 * race.best
            small = gain < tolerance * (TRAILING if behind else 1.0) and moved < 0.5
            converged = small and (fresh or behind)
            if together or (small and not converged) or not (kept or fresh):
                J = None
            else:
                J = J + np.outer(change - J @ move, move) / max(float(move @ move), 1e-300)
            fresh = False
        else:
            converged = damping > 1e3 or np.abs(tried[0] - q).max() < 1e-3
            damping *= 30.0
        costs.append(cost)
        if converged or (race is not None and race.lost(costs, iterations - n)):
            break
    known = None if J is None or r is None else J[: len(J) - sum(p.prior is not None for p in parameters)]
    return Fit(point_at(q), names, cost, np.empty(0) if r is None else r, count, converged, known)


def _scaled(q: np.ndarray, parameters: Sequence[Parameter], names: Sequence[str], factor: float) -> np.ndarray:
    """Coordinates with the values of some parameters times a factor, within their bounds."""
    values = [max(factor * p.physical(v), p.lower) if p.name in names else p.physical(v) for p, v in zip(parameters, q, strict=True)]
    return np.array([p.coordinate(value) for p, value in zip(parameters, values, strict=True)])


def _with_prior_rows(slopes: np.ndarray, parameters: Sequence[Parameter]) -> np.ndarray:
    """Slopes with the rows that `_with_priors` adds to the residual."""
    rows = [np.eye(len(parameters))[i] / p.prior for i, p in enumerate(parameters) if p.prior is not None]
    return np.concatenate([slopes, rows]) if rows else slopes


def _moves(A: np.ndarray, g: np.ndarray, damping: float) -> list[np.ndarray]:
    """Steps with each damping for the normal matrix A and the slope g; at most five typical steps at once."""
    return [_short(-np.linalg.lstsq(H, g, rcond=None)[0]) for H in _damped(A, damping)]


def _damped(A: np.ndarray, damping: float) -> list[np.ndarray]:
    scale = np.maximum(np.diag(A), 1e-12 * max(A.diagonal().max(), 1e-300))
    return [A + damping * factor * np.diag(scale) for factor in DAMPINGS]


def _short(move: np.ndarray) -> np.ndarray:
    return move * min(1.0, 5.0 / max(np.abs(move).max(), 1e-30))


def _along(
    margin: Callable[[np.ndarray], float],
    q: np.ndarray,
    A: np.ndarray,
    g: np.ndarray,
    damping: float,
    tried: list[np.ndarray],
    bounds: tuple[np.ndarray, np.ndarray],
) -> list[np.ndarray]:
    """The ends of the steps from q, those past the edge of what runs replaced by the best ones on its tangent.

    Damping would shorten them instead, and a fit would end at the edge wherever it met it.
    """
    past = [margin(end) < EDGE for end in tried]
    here = margin(q) if any(past) else np.inf
    if not np.isfinite(here):
        return tried
    slope = np.array([(margin(q - STEP * e) - here) / -STEP for e in np.eye(len(q))])
    if not np.isfinite(slope).all():
        return tried
    out = []
    for end, H, beyond in zip(tried, _damped(A, damping), past, strict=True):
        if beyond:
            free, back = (-np.linalg.lstsq(H, b, rcond=None)[0] for b in (g, slope))
            along = float(slope @ back)
            if along < 0:
                end = np.clip(q + _short(free - back * (slope @ free + here - EDGE) / along), *bounds)
        out.append(end)
    return out


def _with_priors(r: np.ndarray, parameters: Sequence[Parameter], q: np.ndarray) -> np.ndarray:
    priors = [(v - p.coordinate(p.value)) / p.prior for p, v in zip(parameters, q, strict=True) if p.prior is not None]
    return np.concatenate([r, priors]) if priors else r


def _bound(p: Parameter, value: float) -> float:
    return p.coordinate(value) if not (p.log and value <= 0) else -np.inf


def run(
    problem: Problem | Memo,
    requests: Sequence[Request],
    whiten: Whiten | Sequence[Whiten],
    recordings: Sequence[int],
    *,
    setting: int = 0,
    tick: Callable[[int], None] | None = None,
    data: Sequence[Mapping[int, np.ndarray]] | None = None,
) -> list[Fit]:
    """Run several fits side by side: what they ask for at one time goes into one call of `predict` for each recording.

    Args:
        problem: What predicts.
        requests: The fits.
        whiten: (residual (n,) of a recording, its number) -> whitened residual; one for all fits or one for each.
        recordings: Numbers of the recordings that are fitted.
        setting: Setting of the discretisation.
        tick: Called with the number of points of each round.
        data: What each fit is to meet, by recording; the recordings themselves where absent.
    """
    results: list[Fit | None] = [None] * len(requests)
    wanted: dict[int, list[Point]] = {}
    for i, request in enumerate(requests):
        wanted[i] = next(request)
    while wanted:
        points = [p for asked in wanted.values() for p in asked]
        of = [i for i, asked in wanted.items() for _ in asked]
        own = None if data is None else [data[i] for i in of]
        white = whiten if callable(whiten) else [whiten[i] for i in of]
        answers = residuals(problem, points, white, recordings, setting, own)
        if tick is not None:
            tick(len(points))
        at, after = 0, {}
        for i, asked in wanted.items():
            part = answers[at : at + len(asked)]
            at += len(asked)
            try:
                after[i] = requests[i].send(part)
            except StopIteration as end:
                results[i] = replace(end.value, setting=setting)
        wanted = after
    return results  # type: ignore[return-value]


def residuals(
    problem: Problem | Memo,
    points: Sequence[Point],
    whiten: Whiten | Sequence[Whiten],
    recordings: Sequence[int],
    setting: int = 0,
    data: Sequence[Mapping[int, np.ndarray]] | None = None,
) -> list[np.ndarray | None]:
    """Whitened residuals of each point over the recordings (or over data of its own), joined; None where one of them cannot run."""
    parts: list[list[np.ndarray]] = [[] for _ in points]
    good = [True] * len(points)
    for n, rows in zip(recordings, problem.predict_several([(points, n, setting) for n in recordings]), strict=True):
        for i, row in enumerate(rows):
            if np.isfinite(row).all():
                own = whiten if callable(whiten) else whiten[i]
                parts[i].append(own(row - (problem.recordings[n].y if data is None else data[i][n]), n))
            else:
                good[i] = False
    return [np.concatenate(part) if ok else None for part, ok in zip(parts, good, strict=True)]
