"""Linear approximation around a point: slopes of parameters, directions of candidates, and the screening of candidates by them."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from neuido.discrepancy.inference.floors import Floor
from neuido.discrepancy.inference.laboratory import Laboratory
from neuido.discrepancy.problems.problem import Candidate, Parameter, Point
from neuido.errors import UserError

LEAST_STEP = 1e-3
"""Smallest difference step of a slope, in typical steps of a parameter."""
NOTHING = 1e-9
"""Change of the predicted share of the misfit that counts as none: such changes are rounding, which other units round otherwise."""


def candidate_columns(
    lab: Laboratory, point: Point, candidates: Sequence[Candidate], recordings: Sequence[int]
) -> dict[tuple[str, int], dict[int, np.ndarray]]:
    """Return how the prediction changes by each start of each candidate.

    Returns:
        (key of the candidate, number of its start) -> {recording: (n, sizes)}, with a column for each size parameter.
    """
    points, places = [], []
    for c in candidates:
        for i, start in enumerate(c.starts):
            sizes = [p.name for p in c.size_parameters]
            shape = {k: v for k, v in start.items() if k not in sizes}
            for name in sizes:
                points.append(dict(point) | shape | {name: start[name]})
                places.append((c.key, i))
    out: dict[tuple[str, int], dict[int, np.ndarray]] = {place: {} for place in places}
    with lab.memo.during("screening"):
        predicted = lab.memo.predict_several([([point, *points], n, lab.setting) for n in recordings])
    for n, (here, *rows) in zip(recordings, predicted, strict=True):
        lab.tell(f"directions of {len(points)} effects in {lab.problem.recordings[n].name}")
        for place in out:
            out[place][n] = np.stack([row - here for row, p in zip(rows, places, strict=True) if p == place], axis=1)
    return out


def step_points(parameters: Sequence[Parameter], point: Point, step: float) -> tuple[list[Point], list[list[float]]]:
    """Return the points one step up and one step down in each coordinate, clipped to the ranges of the parameters.

    Args:
        parameters: Parameters to step along.
        point: Where to start.
        step: In typical steps of a parameter.

    Returns:
        Points (up and down of the first parameter, up and down of the second, ...), and the two distances of each parameter.
    """
    points: list[Point] = []
    spans = []
    for p in parameters:
        q = p.coordinate(point.get(p.name, p.value))
        ends = [p.physical(q + step), p.physical(q - step)]
        points += [dict(point) | {p.name: end} for end in ends]
        spans.append([p.coordinate(ends[0]) - q, q - p.coordinate(ends[1])])
    return points, spans


def slopes(
    lab: Laboratory, parameters: Sequence[Parameter], point: Point, recordings: Sequence[int], step: float = 0.3
) -> dict[int, np.ndarray]:
    """Return the derivatives (n, p) of each recording by the parameters, per typical step of each.

    Differences are central if the range allows it, and one-sided if the model runs on one side alone. If it runs on neither side, smaller
    steps are tried, down to `LEAST_STEP`.

    Raises:
        UserError: The model runs at the point, but not even a small step away from it on either side.
    """
    out = {}
    points, spans = step_points(parameters, point, step)
    with lab.memo.during("slopes"):
        predicted = lab.memo.predict_several([([point, *points], n, lab.setting) for n in recordings])
    for n, (here, *rows) in zip(recordings, predicted, strict=True):
        columns = [np.empty((len(here), 0))]
        for i, (up, down) in enumerate(spans):
            high, low = (bool(np.isfinite(row).all()) for row in rows[2 * i : 2 * i + 2])
            if not (high or low) and np.isfinite(here).all():
                if step < LEAST_STEP:
                    p = parameters[i]
                    at = f"{p.name} = {point.get(p.name, p.value):.6g} {p.unit}"
                    raise UserError(f"{lab.problem.recordings[n].name} cannot be simulated on either side of {at}: give another value")
                columns.append(slopes(lab, [parameters[i]], point, [n], step / 10)[n])
                continue
            change = (rows[2 * i] if high else here) - (rows[2 * i + 1] if low else here)
            columns.append((change / max(up * high + down * low, 1e-9))[:, None])
        out[n] = np.concatenate(columns, axis=1)
    return out


def screen(lab: Laboratory, point: Point, candidates: Sequence[Candidate], floor: Floor, slopes: Mapping[int, np.ndarray]):
    """Rank the starts of all candidates by how much of the misfit they remove in the linear approximation.

    The declared parameters of `slopes` adjust along with each candidate.

    Returns:
        Starts of full fits, the best first, as (predicted share of the squared misfit that is left, candidate, number of the start,
        point), and the directions of `candidate_columns`.
    """
    fits = [p for p in lab.parts if p.fitted]
    columns = candidate_columns(lab, point, candidates, [p.recording for p in fits])
    project = project_out_slopes(lab, slopes, floor)
    left = project({p.recording: lab.residual(point, p.recording) for p in fits})
    ranked = []
    for c in candidates:
        for i, start in enumerate(c.starts):
            B = project(columns[c.key, i])
            if not np.isfinite(B).all():
                continue
            amount = -np.linalg.lstsq(B, left, rcond=1e-6)[0]
            sizes = c.size_parameters
            if not c.linear:
                amount = np.clip(amount, 0.0, 1.5)
            for k, p in enumerate(sizes):
                if start[p.name] == 0:  # this size does nothing, so its column is zero
                    amount[k] = 0.0
                    continue
                low, high = (p.lower / start[p.name], p.upper / start[p.name])
                amount[k] = np.clip(amount[k], min(low, high), max(low, high))
            share_left = float(np.sum((left + B @ amount) ** 2) / max(np.sum(left**2), 1e-300))
            if abs(share_left - 1.0) < NOTHING:
                share_left = 1.0  # starts that do nothing keep their order, whatever the rounding
            if c.linear:
                factor = np.clip(amount, -4.0, 4.0)
                factor = np.where(np.abs(factor) < 0.2, np.where(factor < 0, -0.2, 0.2), factor)
            else:
                factor = np.ones(len(sizes))
            ranked.append((share_left, c, i, dict(point) | c.times(start, factor)))
    ranked.sort(key=lambda entry: entry[0])
    return ranked, columns


def project_out_slopes(lab: Laboratory, slopes: Mapping[int, np.ndarray], floor: Floor) -> Callable[[Mapping[int, np.ndarray]], np.ndarray]:
    """Return a function that whitens columns of the fitted recordings and removes what the slopes can explain.

    The function takes {recording: (n,) or (n, k)} and returns the rows of all fitted recordings together, (rows,) or (rows, k).
    """
    whiten = floor.whitener(lab.parts)

    def rows(of: Mapping[int, np.ndarray]) -> np.ndarray:
        return np.concatenate([whiten(of[n], n) for n in lab.fitted_recordings])

    q, _ = np.linalg.qr(rows(slopes))

    def project(columns: Mapping[int, np.ndarray]) -> np.ndarray:
        A = rows(columns)
        return A - q @ (q.T @ A)

    return project
