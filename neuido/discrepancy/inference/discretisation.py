"""Error floor of a model at one point: noise, nuisances, and differences between settings before and after a refit."""

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
"""Relative gain that ends a fit which serves only to compute a floor."""
UNSEEN = 0.1
"""Largest share of the discretisation error outside the directions of the differences: data are weighted by noise and this share."""
ALIKE = 0.3
"""Largest difference between a quick setting and the suggested one, as a share of the residual, with which a search uses it."""


def quickly(lab: Laboratory, at: Point | None = None, floor: Floor | None = None) -> AbstractContextManager[None]:
    """Predict by a quicker setting (`Problem.quick`) while the context is open.

    Given a point and its floor, the quick setting is used only if its motion there is close enough to that of the suggested setting.
    """
    quick = lab.problem.quick(lab.own)
    return lab.under(quick if at is None or floor is None or is_close(lab, at, floor, quick) else lab.own)


def is_close(lab: Laboratory, point: Point, floor: Floor, setting: int) -> bool:
    """Return whether a setting differs little from the suggested one, compared with the residual.

    The part of the difference along the differences between settings is subtracted first.
    """
    if not lab.bears(point, setting):
        return False
    with lab.memo.during("discretisation"):
        rows = lab.predicted([point], lab.fitted_recordings, (lab.own, setting))
    difference = {n: rows[n, setting][0] - rows[n, lab.own][0] for n in lab.fitted_recordings}
    if not all(np.isfinite(row).all() for row in difference.values()):
        return False
    squares = lab.left(difference, floor, floor.amounts(difference, lab.parts))[lab.fitted]
    with lab.under(lab.own):
        (here,) = lab.mean_squares([point], floor, fitted=True)
    return score(squares) < score(here) + 2.0 * math.log(ALIKE)


def floor_at(lab: Laboratory, point: Point, *, like: Floor | None = None, fitted: bool = False, of: Sequence[int] | None = None) -> Floor:
    """Return the floor at a point, by a simulation under each setting.

    A setting that does not run there gets a column of zeros, and is added to `lab.unable`.

    Args:
        lab: Runs the simulations.
        point: Where to compute the floor.
        like: A floor whose nuisances are used here too, to save simulations.
        fitted: Whether to compute differences of the fitted recordings alone, which is enough for a fit.
        of: Numbers of the recordings; all scored ones by default.
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
    """Return the floor with a smaller share of discretisation error outside the differences, if the fit leaves less than that.

    Args:
        lab: Gives the parts and their noise.
        floor: The floor.
        errors: Mean square that a fit leaves of each part, (parts,).
    """
    if lab.problem.settings == 1 or not np.isfinite(errors[lab.fitted]).all():
        return floor
    spread = np.mean(floor.spread_squares([p for p in lab.parts if p.fitted]))
    above = max(float(np.mean((errors - lab.noise_squares)[lab.fitted])), 0.0)
    return floor.weighed(min(UNSEEN, math.sqrt(above / max(float(spread), 1e-300))))


def prefetch(lab: Laboratory, points: Sequence[Point], *, fitted: bool = False) -> None:
    """Run the simulations that `floor_at` and `stand` of several points need, in one launch, and keep them in the memo."""
    with lab.memo.during("discretisation"):
        wanted = lab.fitted_recordings if fitted else lab.scored_recordings
        lab.predicted(points, wanted, [lab.setting, *lab.problem.others(lab.setting)])


def stand(lab: Laboratory, point: Point, *, like: Floor | None = None, fitted: bool = False) -> tuple[Floor, np.ndarray]:
    """Return the floor at a point, sharpened by the errors there, and these errors as mean squares of the parts, (parts,).

    `like` and `fitted` are those of `floor_at`. With `fitted`, the errors of the other parts are infinite.
    """
    floor = floor_at(lab, point, like=like, fitted=fitted)
    errors = np.full(len(lab.parts), np.inf)
    errors[np.array(lab.fitted) | (not fitted)] = lab.mean_squares([point], floor, fitted=fitted)[0]
    return sharpened(lab, floor, errors), errors


def refits(lab: Laboratory, point: Point, free: Sequence[Parameter], floor: Floor) -> list[tuple[Fit, np.ndarray]]:
    """Fit the motion under each other setting as if it had been measured; settings that do not run are left out.

    A different grid or step moves the body much as a different stiffness does. The distance of a fit from `point` is therefore the
    discretisation error of the parameters, and what the fit leaves is the discretisation error that an effect could be mistaken for.
    Each fit may use the differences of all settings but its own. No time limit ends these fits: a fit that stopped at once would leave
    the whole difference, and any residual would seem to lie within the floor.

    Args:
        lab: Runs the fits.
        point: Where the fits start.
        free: Parameters to fit.
        floor: The floor at the point.

    Returns:
        Each fit, and the mean square that it leaves of each part, (parts,).
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
    """Return the mean square of noise and of the discretisation error after a refit, together, for each part, (parts,)."""
    left = [squares for _, squares in refits(lab, point, free, floor)]
    return lab.noise_squares + np.nanmean(left, axis=0) if left else lab.noise_squares


def nuisance_directions(lab: Laboratory, point: Point, recordings: Sequence[int]) -> dict[int, np.ndarray]:
    """Return the change (n, k) of each recording by one prior standard deviation of each of its nuisances.

    They are computed under the quick setting, and under the suggested one for recordings where the quick one does not run.
    """
    points = {}
    for n in recordings:
        own = [(p, p.prior) for p in lab.problem.nuisances if p.prior is not None and p.name.endswith(f":{lab.problem.recordings[n].name}")]
        points[n] = [point, *({**point, p.name: p.physical(p.coordinate(point.get(p.name, p.value)) + prior)} for p, prior in own)]
    quick, predicted = lab.problem.quick(lab.own), {}
    for setting in dict.fromkeys((quick, lab.own) if lab.bears(point, quick) else (lab.own,)):
        wanted = [n for n in recordings if n not in predicted or not np.isfinite(predicted[n][0]).all()]
        with lab.memo.during("nuisances"):
            predicted |= dict(zip(wanted, lab.memo.predict_several([(points[n], n, setting) for n in wanted]), strict=True))
    out = {}
    for n, (here, *rows) in predicted.items():
        columns = [np.where(np.isfinite(row - here).all(), row - here, 0.0) for row in rows]
        out[n] = np.stack(columns, axis=1) if columns else np.empty((len(here), 0))
    return out
