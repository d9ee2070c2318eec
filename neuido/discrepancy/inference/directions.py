"""The linear picture about a point: the slopes of its parameters, the direction of every candidate, and what each promises."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from neuido.discrepancy.inference.floors import Floor
from neuido.discrepancy.inference.laboratory import Laboratory
from neuido.discrepancy.problems.problem import Candidate, Parameter, Point
from neuido.errors import UserError

LEAST_STEP = 1e-3
"""Of a slope, in typical steps of a parameter: below it no smaller one is tried."""


def candidate_columns(
    lab: Laboratory, point: Point, candidates: Sequence[Candidate], recordings: Sequence[int]
) -> dict[tuple[str, int], dict[int, np.ndarray]]:
    """Directions of each candidate and start in the data of recordings: (key, start) -> {recording: (n, sizes)}."""
    asked, places = [], []
    for c in candidates:
        for i, start in enumerate(c.starts):
            sizes = [p.name for p in c.size_parameters]
            shape = {k: v for k, v in start.items() if k not in sizes}
            for name in sizes:
                asked.append(dict(point) | shape | {name: start[name]})
                places.append((c.key, i))
    out: dict[tuple[str, int], dict[int, np.ndarray]] = {place: {} for place in places}
    with lab.memo.during("screening"):
        predicted = lab.memo.predict_several([([point, *asked], n, lab.setting) for n in recordings])
    for n, (here, *rows) in zip(recordings, predicted, strict=True):
        lab.tell(f"directions of {len(asked)} effects in {lab.problem.recordings[n].name}")
        for place in out:
            out[place][n] = np.stack([row - here for row, p in zip(rows, places, strict=True) if p == place], axis=1)
    return out


def around(lab: Laboratory, parameters: Sequence[Parameter], point: Point, step: float) -> tuple[list[Point], list[list[float]]]:
    """The points on both sides of one, a step in each coordinate, and how far they are from it, within the ranges."""
    asked: list[Point] = []
    spans = []
    for p in parameters:
        q = p.coordinate(point.get(p.name, p.value))
        ends = [p.physical(q + step), p.physical(q - step)]
        asked += [dict(point) | {p.name: end} for end in ends]
        spans.append([p.coordinate(ends[0]) - q, q - p.coordinate(ends[1])])
    return asked, spans


def slopes(
    lab: Laboratory, parameters: Sequence[Parameter], point: Point, recordings: Sequence[int], step: float = 0.3
) -> dict[int, np.ndarray]:
    """Derivatives of the data by coordinates of parameters, one typical step each; central where the range allows.

    One-sided where the model runs on one side alone; where it runs on neither, by smaller steps.

    Raises:
        UserError: The model runs at the point, but not even a small step away from it on either side.
    """
    out = {}
    asked, spans = around(lab, parameters, point, step)
    with lab.memo.during("slopes"):
        predicted = lab.memo.predict_several([([point, *asked], n, lab.setting) for n in recordings])
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
    """Starts of full fits, best first: (predicted share of the misfit that stays, candidate, start, point), and the directions."""
    fits = [p for p in lab.parts if p.fitted]
    columns = candidate_columns(lab, point, candidates, [p.recording for p in fits])
    past = past_slopes(lab, slopes, floor)
    left = past({p.recording: lab.residual(point, p.recording) for p in fits})
    ranked = []
    for c in candidates:
        for i, start in enumerate(c.starts):
            B = past(columns[c.key, i])
            if not np.isfinite(B).all():
                continue
            amount = -np.linalg.lstsq(B, left, rcond=1e-6)[0]
            sizes = c.size_parameters
            if not c.linear:
                amount = np.clip(amount, 0.0, 1.5)
            for k, p in enumerate(sizes):
                if start[p.name] == 0:  # its direction is nothing
                    amount[k] = 0.0
                    continue
                low, high = (p.lower / start[p.name], p.upper / start[p.name])
                amount[k] = np.clip(amount[k], min(low, high), max(low, high))
            stays = float(np.sum((left + B @ amount) ** 2) / max(np.sum(left**2), 1e-300))
            if c.linear:
                factor = np.clip(amount, -4.0, 4.0)
                factor = np.where(np.abs(factor) < 0.2, np.where(factor < 0, -0.2, 0.2), factor)
            else:
                factor = np.ones(len(sizes))
            ranked.append((stays, c, i, dict(point) | c.times(start, factor)))
    ranked.sort(key=lambda entry: entry[0])
    return ranked, columns


def past_slopes(lab: Laboratory, slopes: Mapping[int, np.ndarray], floor: Floor) -> Callable[[Mapping[int, np.ndarray]], np.ndarray]:
    """What columns of the fitted recordings, {recording: (n,) or (n, k)}, do past the parameters of the slopes, whitened."""
    whiten = floor.whitener(lab.parts)

    def rows(of: Mapping[int, np.ndarray]) -> np.ndarray:
        return np.concatenate([whiten(of[n], n) for n in lab.fitted_recordings])

    q, _ = np.linalg.qr(rows(slopes))

    def past(columns: Mapping[int, np.ndarray]) -> np.ndarray:
        A = rows(columns)
        return A - q @ (q.T @ A)

    return past
