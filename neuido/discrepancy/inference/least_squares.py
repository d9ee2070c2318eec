"""Least squares with a simulator: whitening of residuals, and Levenberg-Marquardt fits that share their launches."""

from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import lsq_linear

from neuido.discrepancy.problems.problem import Parameter, Point, Problem
from neuido.discrepancy.store import Memo
from neuido.errors import UserError

START_FACTORS = (0.5, 0.25, 0.12, 0.06)
"""Factors of the sizes of an effect that are tried if the start of a fit does not run, such as a viscosity too large for the time step."""
STEP = 0.02
"""Difference step, in typical steps of a parameter."""
OTHER_STEPS = (0.1, -1.0)
"""Factors that are applied one after another to a difference step that does not run: a tenth of it, and that on the other side."""
DAMPINGS = (0.1, 1.0, 10.0)
"""Factors of the present damping that are tried in each iteration."""
TRUSTED_GAIN = 0.7
"""Least share of the predicted gain with which a step is accepted without other dampings, and slopes are used again."""
NEAR_EDGE = 0.1
"""Margin (`Problem.margin`) below which difference steps keep to the stable side."""
EDGE_MARGIN = 0.02
"""Margin (`Problem.margin`) that a step keeps from the stability limit, so that differences of `STEP` still run there."""
NEGLIGIBLE = 2e-4
"""Relative gain, as the linear model predicts it, that is not worth a simulation."""
LOST_FACTOR = 2.5
"""A fit is given up if, at the pace of its last step, it would end above this many times the lowest cost of its race."""
TRAILING_FACTOR = 5.0
"""Factor of the tolerance of a fit whose cost is more than a tenth above the lowest of its race."""
PACE_ITERATIONS = 3
"""Most iterations over which the pace of the last step is extrapolated; gains get smaller."""


class NotFinite(UserError):
    """A prediction is not finite, but is needed for linear algebra."""


@dataclass(frozen=True, eq=False)
class Covariance:
    """Covariance of the data of one recording: sigma^2 I + U diag(s^2) U^T, with orthonormal columns U."""

    sigma: float
    """Standard deviation of the noise."""
    directions: np.ndarray
    """U, (n, k)."""
    spread: np.ndarray
    """s, (k,), standard deviations along U beside the noise."""

    @classmethod
    def of(cls, sigma: float, columns: np.ndarray) -> "Covariance":
        """Make the covariance sigma^2 I + L L^T from columns L (n, k).

        Raises:
            NotFinite: A column is not finite.
        """
        if not columns.size:
            return cls(sigma, np.empty((columns.shape[0], 0)), np.empty(0))
        if not np.isfinite(columns).all():
            raise NotFinite("predictions under different settings are not finite")
        values, vectors = np.linalg.eigh(columns.T @ columns)
        keep = values > max(1e-12 * values.max(), 1e-300)
        spread = np.sqrt(values[keep])
        return cls(sigma, (columns @ vectors[:, keep]) / spread, spread)

    def whiten(self, r: np.ndarray) -> np.ndarray:
        """Transform residuals (n,) or (n, m) so that their covariance becomes the identity."""
        inside = self.directions.T @ r
        factor = 1.0 - self.sigma / np.sqrt(self.sigma**2 + self.spread**2)
        return (r - self.directions @ (factor[:, None] * inside if r.ndim == 2 else factor * inside)) / self.sigma


@dataclass(frozen=True, eq=False)
class Fit:
    """The result of a fit."""

    point: Mapping[str, float]
    """Parameter values where the fit ended, by name."""
    names: tuple[str, ...]
    """Names of the parameters that were fitted."""
    cost: float
    """Sum of squares of the whitened residuals, priors included."""
    residual: np.ndarray
    """Whitened residual (n,), priors included; empty if the model did not run at any point."""
    evaluations: int
    """Number of points that were evaluated."""
    converged: bool
    """Whether the fit converged."""
    slopes: np.ndarray | None = None
    """Approximate derivatives of the whitened residual by the coordinates at the end, (n, p), without priors; None if not known."""
    setting: int = 0
    """Number of the setting of the discretisation that predicted."""


Whiten = Callable[[np.ndarray, int], np.ndarray]
"""(residual (n,) of a recording, its number) -> whitened residual of its fitted rows."""
Request = Generator[list[Point], list[np.ndarray | None], Fit]
"""A fit as a generator: it yields points, receives their whitened residuals (None: the model does not run there), and returns a `Fit`."""


class Race:
    """Competition between fits: a fit that cannot reach the lowest cost any more is stopped.

    Args:
        best: Lowest cost known so far.
    """

    def __init__(self, best: float = np.inf) -> None:
        self.best = best

    def lost(self, costs: Sequence[float], left: int) -> bool:
        """Return whether a fit has no chance any more, and keep the lowest cost.

        Args:
            costs: Cost of the fit after each iteration.
            left: Number of iterations left.
        """
        self.best = min(self.best, costs[-1])
        if len(costs) < 3:
            return False
        failed = costs[-1] == costs[-2]  # a single failed step only means that the damping was too small
        pace = (costs[-1] / max(costs[-3], 1e-300)) ** 0.5 if failed else costs[-1] / costs[-2]
        return costs[-1] * pace ** (left if failed else min(left, PACE_ITERATIONS)) > LOST_FACTOR * self.best


def levenberg_marquardt(
    parameters: Sequence[Parameter],
    start: Point,
    *,
    iterations: int = 12,
    tolerance: float = 2e-3,
    nothing: float = NEGLIGIBLE,
    damping: float = 1e-2,
    together: bool = True,
    race: Race | None = None,
    slopes: np.ndarray | None = None,
    sizes: Sequence[str] = (),
    margin: Callable[[Point], float] = lambda point: np.inf,
    halt: Callable[[], bool] = lambda: False,
) -> Request:
    """Fit parameters by the Levenberg-Marquardt method, as a generator that `run` drives; see `Request`.

    If points are evaluated one by one (not `together`), the slopes of one step are used for the next step after a rank-one update (Broyden
    1965). They are computed anew if a step gains less than `TRUSTED_GAIN` of the prediction, and before the fit ends.

    Args:
        parameters: Parameters to fit.
        start: Point to start from, with the values of all other parameters.
        iterations: Most iterations.
        tolerance: Relative gain of an iteration below which the fit ends.
        nothing: Relative gain, as the linear model predicts it, that is not worth a simulation.
        damping: Damping of the first step.
        together: Whether a launch of several points costs about as much as one of one point. If so, all slopes and dampings of a step are
            evaluated together.
        race: The competition that the fit takes part in.
        slopes: Approximate derivatives of the whitened residual by the coordinates at the start, (n, p), without rows for priors.
        sizes: Names of parameters that start smaller if the model does not run at the start.
        margin: `Problem.margin` of a point. A step past the stability limit is replaced by one along it.
        halt: Called once an iteration; the fit ends where it is if this returns True.

    Returns:
        The result, at the lowest cost that was found.
    """
    names = tuple(p.name for p in parameters)
    fixed = {k: v for k, v in start.items() if k not in names}
    q = np.array([p.coordinate(start.get(p.name, p.value)) for p in parameters])
    low = np.array([_coordinate_bound(p, p.lower) for p in parameters])
    high = np.array([_coordinate_bound(p, p.upper) for p in parameters])
    count = 0

    def point_at(at: np.ndarray) -> Point:
        return fixed | {p.name: p.physical(v) for p, v in zip(parameters, at, strict=True)}

    def evaluate(places: Sequence[np.ndarray]):
        """Return the whitened residual at each of several coordinates, priors included; None if the model does not run there."""
        nonlocal count
        count += len(places)
        answers = yield [point_at(a) for a in places]
        return [None if r is None else _with_priors(r, parameters, a) for r, a in zip(answers, places, strict=True)]

    (r,) = yield from evaluate([q])
    if r is None and sizes:
        starts = [_scale_sizes(q, parameters, sizes, factor) for factor in START_FACTORS]
        for batch in [starts] if together else [[one] for one in starts]:
            answers = yield from evaluate(batch)
            q, r = next(((one, a) for one, a in zip(batch, answers, strict=True) if a is not None), (q, None))
            if r is not None:
                break
    cost = np.inf if r is None else float(r @ r)
    converged, costs, n = r is not None and not names, [cost], 0
    # J: slopes of the whitened residual; `fresh`: they were computed where the fit is now
    J, fresh = None if slopes is None or together or r is None else _with_prior_rows(slopes, parameters), False
    while n < iterations and r is not None and names and not halt():
        converged = False
        if J is None:
            steps = np.where(q + STEP > high, -STEP, STEP)
            if margin(point_at(q)) < NEAR_EDGE:
                ends = [margin(point_at(q + step * e)) for step, e in zip(steps, np.eye(len(q)), strict=True)]
                steps = np.where(np.array(ends) < 0, -steps, steps)
            columns = yield from evaluate([q + np.eye(len(q))[i] * steps[i] for i in range(len(q))])
            for factor in OTHER_STEPS:  # a step that does not run does not mean that the parameter has no influence
                failed = [i for i, c in enumerate(columns) if c is None]
                if failed:
                    again = yield from evaluate([q + np.eye(len(q))[i] * factor * steps[i] for i in failed])
                    for i, c in zip(failed, again, strict=True):
                        columns[i], steps[i] = c, factor * steps[i]
            if any(c is None for c in columns):
                break
            J = np.stack([(c - r) / s for c, s in zip(columns, steps, strict=True)], axis=1)
            fresh = True
        A, g = J.T @ J, J.T @ r
        proposals = [np.clip(q + move, low, high) for move in _damped_steps(A, g, damping, low - q, high - q)]
        proposals = _follow_edge(lambda at: margin(point_at(at)), q, A, g, damping, proposals, (low, high))
        predicted_gains = [-float((t - q) @ (2 * g + A @ (t - q))) for t in proposals]
        if max(predicted_gains) < nothing * cost and np.abs(proposals[0] - q).max() < 0.5:
            if fresh:
                converged = True
                break
            J = None
            continue
        trials = yield from evaluate(proposals if together else proposals[:1])
        as_predicted = together or (trials[0] is not None and cost - float(trials[0] @ trials[0]) >= TRUSTED_GAIN * predicted_gains[0])
        if not as_predicted and fresh:
            trials += yield from evaluate(proposals[1:])
        trial_costs = [np.inf if f is None else float(f @ f) for f in trials]
        best = int(np.argmin(trial_costs))
        if trial_costs[best] >= cost and not fresh:
            J = None
            continue
        n += 1
        gain, moved = (cost - trial_costs[best]) / cost if cost > 0 else 0.0, np.abs(proposals[best] - q).max()
        if trial_costs[best] < cost:
            move, change = proposals[best] - q, trials[best] - r
            q, r, cost = proposals[best], trials[best], trial_costs[best]
            damping = max(damping * DAMPINGS[best], 1e-6)
            behind = race is not None and cost > 1.1 * race.best
            small = gain < tolerance * (TRAILING_FACTOR if behind else 1.0) and moved < 0.5
            converged = small and (fresh or behind)
            if together or (small and not converged) or not (as_predicted or fresh):
                J = None
            else:
                J = J + np.outer(change - J @ move, move) / max(float(move @ move), 1e-300)
            fresh = False
        else:
            converged = damping > 1e3 or np.abs(proposals[0] - q).max() < 1e-3
            damping *= 30.0
        costs.append(cost)
        if converged or (race is not None and race.lost(costs, iterations - n)):
            break
    known = None if J is None or r is None else J[: len(J) - sum(p.prior is not None for p in parameters)]
    return Fit(point_at(q), names, cost, np.empty(0) if r is None else r, count, converged, known)


def _scale_sizes(q: np.ndarray, parameters: Sequence[Parameter], names: Sequence[str], factor: float) -> np.ndarray:
    """Return coordinates in which the values of the named parameters are multiplied by a factor, not below their lower bounds."""
    values = [max(factor * p.physical(v), p.lower) if p.name in names else p.physical(v) for p, v in zip(parameters, q, strict=True)]
    return np.array([p.coordinate(value) for p, value in zip(parameters, values, strict=True)])


def _with_prior_rows(slopes: np.ndarray, parameters: Sequence[Parameter]) -> np.ndarray:
    """Append to slopes (n, p) the rows of the priors, as `_with_priors` does for residuals."""
    rows = [np.eye(len(parameters))[i] / p.prior for i, p in enumerate(parameters) if p.prior is not None]
    return np.concatenate([slopes, rows]) if rows else slopes


def _damped_steps(A: np.ndarray, g: np.ndarray, damping: float, low: np.ndarray, high: np.ndarray) -> list[np.ndarray]:
    """Return the step for each damping from the normal matrix A (p, p) and the gradient g (p,), limited by `_limit_step`.

    A step that would leave the range from `low` to `high`, (p,) each, is replaced by the best one within it. To cut it off would leave the
    other parameters where they make up for what is cut off, which is far away where several parameters act alike.
    """
    moves = []
    for H in _damped_matrices(A, damping):
        move = _limit_step(-np.linalg.lstsq(H, g, rcond=None)[0])
        if ((move < low) | (move > high)).any():
            move = _limit_step(_bounded(H, g, low, high))
        moves.append(move)
    return moves


def _bounded(H: np.ndarray, g: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the step x (p,) with the least x^T H x / 2 + g^T x between `low` and `high`."""
    values, vectors = np.linalg.eigh(H)
    root = np.sqrt(np.maximum(values, 1e-14 * max(values[-1], 1e-300)))
    low, high = np.minimum(low, 0.0), np.maximum(high, 0.0)  # rounding may leave a coordinate past its bound
    return bounded_least_squares(root[:, None] * vectors.T, -(vectors.T @ g) / root, low, high)


def bounded_least_squares(A: np.ndarray, b: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the x (p,) between `low` and `high` for which A x is nearest to b."""
    inside = high > low
    x = np.array(low, dtype=np.float64)
    if inside.any():
        x[inside] = lsq_linear(A[:, inside], b - A[:, ~inside] @ x[~inside], (low[inside], high[inside]), method="bvls").x
    return x


def _damped_matrices(A: np.ndarray, damping: float) -> list[np.ndarray]:
    """Return the normal matrix A (p, p) with each damping on its diagonal."""
    scale = np.maximum(np.diag(A), 1e-12 * max(A.diagonal().max(), 1e-300))
    return [A + damping * factor * np.diag(scale) for factor in DAMPINGS]


def _limit_step(move: np.ndarray) -> np.ndarray:
    """Shorten a step so that no parameter moves by more than five typical steps."""
    return move * min(1.0, 5.0 / max(np.abs(move).max(), 1e-30))


def _follow_edge(
    margin: Callable[[np.ndarray], float],
    q: np.ndarray,
    A: np.ndarray,
    g: np.ndarray,
    damping: float,
    tried: list[np.ndarray],
    bounds: tuple[np.ndarray, np.ndarray],
) -> list[np.ndarray]:
    """Replace steps past the stability limit by the best steps along it, to first order.

    Damping would only shorten such steps, and a fit would end wherever it meets the limit.

    Args:
        margin: `Problem.margin` at coordinates.
        q: Coordinates where the steps start, (p,).
        A: Normal matrix, (p, p).
        g: Gradient, (p,).
        damping: Present damping.
        tried: End of the step for each damping.
        bounds: Lower and upper bounds of the coordinates.
    """
    past = [margin(end) < EDGE_MARGIN for end in tried]
    here = margin(q) if any(past) else np.inf
    if not np.isfinite(here):
        return tried
    slope = np.array([(margin(q - STEP * e) - here) / -STEP for e in np.eye(len(q))])
    if not np.isfinite(slope).all():
        return tried
    out = []
    for end, H, beyond in zip(tried, _damped_matrices(A, damping), past, strict=True):
        if beyond:
            unconstrained, back = (-np.linalg.lstsq(H, b, rcond=None)[0] for b in (g, slope))
            along = float(slope @ back)
            if along < 0:
                end = np.clip(q + _limit_step(unconstrained - back * (slope @ unconstrained + here - EDGE_MARGIN) / along), *bounds)
        out.append(end)
    return out


def _with_priors(r: np.ndarray, parameters: Sequence[Parameter], q: np.ndarray) -> np.ndarray:
    """Append to a whitened residual (n,) the offset of each parameter from its prior mean, in prior standard deviations."""
    priors = [(v - p.coordinate(p.value)) / p.prior for p, v in zip(parameters, q, strict=True) if p.prior is not None]
    return np.concatenate([r, priors]) if priors else r


def _coordinate_bound(p: Parameter, value: float) -> float:
    """Return the coordinate of a bound of a parameter; minus infinity for the logarithm of a bound that is not positive."""
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
    """Run several fits together: the points that they need at one time are predicted by one call for each recording.

    Args:
        problem: The model.
        requests: The fits, from `levenberg_marquardt`.
        whiten: Whitens the residual of a recording; one for all fits, or one for each.
        recordings: Numbers of the recordings that are fitted.
        setting: Number of the setting of the discretisation.
        tick: Called with the number of points before each call for further ones.
        data: Data of each fit by recording, (n,); by default the recordings themselves.

    Returns:
        The result of each fit.
    """
    results: list[Fit | None] = [None] * len(requests)
    wanted: dict[int, list[Point]] = {}
    for i, request in enumerate(requests):
        wanted[i] = next(request)
    while wanted:
        points = [p for own in wanted.values() for p in own]
        owners = [i for i, own in wanted.items() for _ in own]
        targets = None if data is None else [data[i] for i in owners]
        white = whiten if callable(whiten) else [whiten[i] for i in owners]
        answers = residuals(problem, points, white, recordings, setting, targets)
        if tick is not None:
            tick(len(points))
        at, after = 0, {}
        for i, own in wanted.items():
            part = answers[at : at + len(own)]
            at += len(own)
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
    """Return the whitened residuals of all recordings, joined, at each point; None if one does not run. `whiten`, `data`: of each point."""
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
