"""What noise, nuisances and discretisation do where a model stands: the differences of the settings, before and after a refit."""

import math
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import replace

import numpy as np

from neuido.discrepancy.inference.floors import Floor, over_time, score
from neuido.discrepancy.inference.laboratory import Laboratory
from neuido.discrepancy.inference.least_squares import Fit
from neuido.discrepancy.problems.problem import Parameter, Point

ROUGH = 0.02
"""Relative gain that ends a fit which only says where floors are to be found, or what they are."""
UNSEEN = 0.1
"""Largest share of the differences of the settings that lies outside their directions: what a fit weighs the data by, beside the noise."""
ALIKE = 0.3
"""Share of what is left that a quick setting may differ by, so that a search there is for what is left."""


def quickly(lab: Laboratory, at: Point | None = None, floor: Floor | None = None) -> AbstractContextManager[None]:
    """While it is open, what moves about as the own setting does, for less, predicts in its place (`Problem.quick`).

    At a point that is given, unless that differs there by as much as is to be explained.
    """
    quick = lab.problem.quick(lab.own)
    return lab.under(quick if at is None or floor is None or about_alike(lab, at, floor, quick) else lab.own)


def about_alike(lab: Laboratory, point: Point, floor: Floor, setting: int) -> bool:
    """Whether a setting differs from the own one by a small part of what is left, past what the differences of the settings take up."""
    if not lab.bears(point, setting):
        return False
    with lab.memo.during("discretisation"):
        rows = lab.predicted([point], lab.fitted_recordings, (lab.own, setting))
    off = {n: rows[n, setting][0] - rows[n, lab.own][0] for n in lab.fitted_recordings}
    if not all(np.isfinite(row).all() for row in off.values()):
        return False
    squares = lab.left(off, floor, floor.amounts(off, lab.parts))[lab.fitted]
    with lab.under(lab.own):
        (here,) = lab.mean_squares([point], floor, fitted=True)
    return score(squares) < score(here) + 2.0 * math.log(ALIKE)


def floor_at(lab: Laboratory, point: Point, *, like: Floor | None = None, fitted: bool = False, of: Sequence[int] | None = None) -> Floor:
    """Noise and discretisation at a point: differences of the settings, and how large they are in the course of time.

    `like`: a floor whose nuisances serve here too. `fitted`: the differences of the fitted recordings alone, which is what fits read.
    `of`: the recordings, where these are not all that are scored. A setting that does not run there has a column of zeros, and is noted
    in `unable`.
    """
    plain = lab.noise(of)
    others = lab.problem.others(lab.setting)
    if not others:
        return replace(plain, nuisances=nuisance_directions(lab, point, list(plain.noise)))
    wanted = lab.fitted_recordings if fitted else list(plain.noise)
    with lab.memo.during("discretisation"):
        rows = lab.predicted([point], wanted, (lab.setting, *others))
    differences, spread = {}, {}
    for n in wanted:
        here, *there = (rows[n, s][0] for s in (lab.setting, *others))
        able = [bool(np.isfinite(t).all()) for t in there]
        lab.unable[n] = [s for s, ok in zip(others, able, strict=True) if not ok]
        D = np.stack([t - here if ok else np.zeros_like(here) for t, ok in zip(there, able, strict=True)], axis=1)
        differences[n] = D
        spread[n] = over_time(np.sqrt(np.sum(D**2, axis=1) / max(sum(able), 1)), lab.problem.recordings[n].times)
        lab.tell(f"discretisation of {lab.problem.recordings[n].name}")
    nuisances = nuisance_directions(lab, point, list(plain.noise)) if like is None else like.nuisances
    weight = {n: plain.weight[n] for n in wanted}
    return Floor(plain.noise, weight, differences, spread, nuisances).weighed(UNSEEN)


def sharpened(lab: Laboratory, floor: Floor, errors: np.ndarray) -> Floor:
    """The floor for fits about where `errors`, mean squares of all parts, are left: no more than that is unseen."""
    if lab.problem.settings == 1 or not np.isfinite(errors[lab.fitted]).all():
        return floor
    spread = np.mean(floor.spread_squares([p for p in lab.parts if p.fitted]))
    above = max(float(np.mean((errors - lab.noise_squares)[lab.fitted])), 0.0)
    return floor.weighed(min(UNSEEN, math.sqrt(above / max(float(spread), 1e-300))))


def foresee(lab: Laboratory, points: Sequence[Point], *, fitted: bool = False) -> None:
    """Run what `floor` and `stand` of several points will ask for, in one launch; the memo keeps it."""
    with lab.memo.during("discretisation"):
        wanted = lab.fitted_recordings if fitted else lab.scored_recordings
        lab.predicted(points, wanted, [lab.setting, *lab.problem.others(lab.setting)])


def stand(lab: Laboratory, point: Point, *, like: Floor | None = None, fitted: bool = False) -> tuple[Floor, np.ndarray]:
    """The floor at a point, sharpened by what is left there, and what that is, mean squares of the parts.

    `like` and `fitted` as for `floor`; infinite for parts that were not asked for.
    """
    floor = floor_at(lab, point, like=like, fitted=fitted)
    errors = np.full(len(lab.parts), np.inf)
    errors[np.array(lab.fitted) | (not fitted)] = lab.mean_squares([point], floor, fitted=fitted)[0]
    return sharpened(lab, floor, errors), errors


def refits(lab: Laboratory, point: Point, free: Sequence[Parameter], floor: Floor) -> list[tuple[Fit, np.ndarray]]:
    """The motions under the other settings fitted as if they had been measured: the fits, and what they leave.

    Each without its own difference. Most of what a grid or a step does a stiffness, or the difference of another grid, can do as well:
    how far a fit goes from `point` is the discretisation error of the parameters, and what it leaves, mean squares of the parts, the
    one that an effect could be mistaken for. The clock ends none of them: one that stops at once leaves the whole difference
    of the settings, and any residual lies within that.
    """
    others = lab.problem.others(lab.setting)
    with lab.memo.during("discretisation"):
        rows = lab.predicted([point], list(floor.noise), others)
        made = {s: {n: rows[n, s][0] for n in floor.noise} for s in others}
    made = {s: y for s, y in made.items() if all(np.isfinite(row).all() for row in y.values())}
    floors = [floor.without(others.index(s)) for s in made]
    requests = [lab.request(free, point, until=math.inf, iterations=8, tolerance=ROUGH) for _ in made]
    fits = lab.fits(requests, floors, to=list(made.values()), step="discretisation")
    with lab.memo.during("discretisation"):
        rows = lab.predicted([fit.point for fit in fits], list(floor.noise))
    out = []
    for i, (fit, own, y) in enumerate(zip(fits, floors, made.values(), strict=True)):
        left = {n: rows[n, lab.setting][i] - y[n] for n in y}
        out.append((fit, lab.left(left, own, own.amounts(left, lab.parts))))
    return out


def floors(lab: Laboratory, point: Point, free: Sequence[Parameter], floor: Floor) -> np.ndarray:
    """Noise, and what a refit leaves of the discretisation error, together as mean squares of the parts."""
    left = [squares for _, squares in refits(lab, point, free, floor)]
    return lab.noise_squares + np.nanmean(left, axis=0) if left else lab.noise_squares


def nuisance_directions(lab: Laboratory, point: Point, recordings: Sequence[int]) -> dict[int, np.ndarray]:
    """Directions of the nuisances of each recording, of one prior standard deviation, as a quick motion has them where it runs."""
    asks = {}
    for n in recordings:
        own = [(p, p.prior) for p in lab.problem.nuisances if p.prior is not None and p.name.endswith(f":{lab.problem.recordings[n].name}")]
        asks[n] = [point, *({**point, p.name: p.physical(p.coordinate(point.get(p.name, p.value)) + prior)} for p, prior in own)]
    quick, predicted = lab.problem.quick(lab.own), {}
    for setting in dict.fromkeys((quick, lab.own) if lab.bears(point, quick) else (lab.own,)):
        wanted = [n for n in recordings if n not in predicted or not np.isfinite(predicted[n][0]).all()]
        with lab.memo.during("nuisances"):
            predicted |= dict(zip(wanted, lab.memo.predict_several([(asks[n], n, setting) for n in wanted]), strict=True))
    out = {}
    for n, (here, *rows) in predicted.items():
        columns = [np.where(np.isfinite(row - here).all(), row - here, 0.0) for row in rows]
        out[n] = np.stack(columns, axis=1) if columns else np.empty((len(here), 0))
    return out
