"""Other candidates in the place of the leading effect, fitted from where that one ended."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from neuido.discrepancy.inference import comparing, directions, discretisation
from neuido.discrepancy.inference.comparing import LEAST_GAIN
from neuido.discrepancy.inference.floors import Floor
from neuido.discrepancy.inference.laboratory import Laboratory
from neuido.discrepancy.inference.least_squares import Fit, Race
from neuido.discrepancy.inference.search.contests import MANY, SMALL, better
from neuido.discrepancy.inference.search.judging import LED_AWAY
from neuido.discrepancy.problems.problem import Candidate, Parameter, Point
from neuido.physics.effects.library import LIMITS

NEAR_IT = 1.5
"""Times the cost of the leading fit from which on a candidate is behind it."""
ALIKE = 0.3
"""Share of what the leading effect does to the data, past the declared parameters, that a candidate may leave to be fitted from there."""
HALF = 0.5
"""Share of the base fit's cost below which the leading effect says where the declared values are."""
PROMISING = 0.75
"""Share of the misfit that a candidate may leave there, as its directions say, to be tried in its place where every point costs: another
stiffness in compression left more than 0.82 by them, and was the true effect."""
INSTEAD, INSTEAD_ONE_BY_ONE = 8, 2
"""Candidates that are fitted there, and the same where every point costs."""
SCANNED = 8
"""Candidates whose sizes are tried there where every point costs; otherwise all."""
FROM_THERE = 20.0
"""Times the cost of the leading fit up to which one of these sizes is fitted: three that this has found began at 0.4, 6 and 15 times."""
NO_MORE = 1.1
"""Mean squares up to so many times those of the noise that are no reason to look further where a base fit is led away."""
STEP, STEPS = 1.5, 9
"""Ratio of these sizes, and how many: up to 26 times the one that the candidate is screened at."""


def leader(best: Mapping[str, tuple[Candidate, Fit]]) -> tuple[Candidate, Fit] | None:
    """The candidate of few parameters with the fit of least cost, if there is one."""
    return min((entry for entry in best.values() if len(entry[0].parameters) <= MANY), key=lambda entry: entry[1].cost, default=None)


def is_behind(c: Candidate, best: Mapping[str, tuple[Candidate, Fit]], fit: Fit) -> bool:
    """Whether a candidate has no fit that comes near a leading one."""
    return c.key not in best or best[c.key][1].cost >= NEAR_IT * fit.cost


def limits(
    lab: Laboratory, free: Sequence[Parameter], best: Mapping[str, tuple[Candidate, Fit]], candidates: Sequence[Candidate], floor: Floor
) -> dict[str, tuple[Candidate, Fit]]:
    """Fits of what the leading candidate is in a limit, from its declared values and with sizes that do about as much.

    The base fit may have led theirs astray.
    """
    if not best:
        return {}
    lead, fit = min(best.values(), key=lambda entry: entry[1].cost)
    own = [c for c in candidates if c.name in LIMITS.get(lead.name, ()) and is_behind(c, best, fit)]
    if not own:
        return {}
    begin, wanted = lead.without(fit.point), lab.fitted_recordings
    does = np.concatenate([there - here for here, there in lab.predicted([begin, fit.point], wanted).values()])
    columns = directions.candidate_columns(lab, begin, own, wanted)
    requests = []
    for c in own:
        A = np.concatenate([columns[c.key, 0][n] for n in wanted])
        amount = np.linalg.lstsq(A, does, rcond=1e-6)[0] if np.isfinite(A).all() and np.isfinite(does).all() else np.ones(A.shape[1])
        requests.append(lab.request((*free, *c.parameters), begin | c.times(c.starts[0], amount)))
    return better(zip(own, lab.fits(requests, floor), strict=True), best)


def alike(
    lab: Laboratory,
    free: Sequence[Parameter],
    best: Mapping[str, tuple[Candidate, Fit]],
    candidates: Sequence[Candidate],
    chosen: Mapping[str, int],
    columns: Mapping[tuple[str, int], Mapping[int, np.ndarray]],
    slopes: Mapping[int, np.ndarray],
    floor: Floor,
) -> dict[str, tuple[Candidate, Fit]]:
    """Fits of the candidates that act on the data as the leading one does, from its fit, with the sizes that do as much.

    A fit that started far from there may have been given up, and a class would lack one of its members. One of many parameters is
    among them if the leading one is a limit of it and leaves more than noise.
    """
    top = leader(best)
    if top is None:
        return {}
    lead, fit = top
    if not lead.linear or lead.size_parameters != lead.parameters:
        return {}
    at = chosen.get(lead.key, 0)  # what is a limit of another one may lead without a place in the screening
    past, start = directions.project_out_slopes(lab, slopes, floor), lead.starts[at]
    does = past(columns[lead.key, at]) @ np.array([fit.point[p.name] / start[p.name] for p in lead.parameters])
    if not np.isfinite(does).all():
        return {}
    requests, of = [], []
    without = {k: v for k, v in fit.point.items() if k not in start}
    enough = comparing.is_noise(lab, lab.mean_squares([fit.point], floor)[0])
    for c in candidates:
        wider = lead.name in LIMITS.get(c.name, ()) and not enough
        if c is lead or not c.linear or not (wider or len(c.parameters) <= MANY) or not is_behind(c, best, fit):
            continue
        for i, shape in enumerate(c.starts):
            A = past(columns[c.key, i])
            if not np.isfinite(A).all():
                continue
            amount = np.linalg.lstsq(A, does, rcond=1e-6)[0]
            if np.sum((does - A @ amount) ** 2) < ALIKE * np.sum(does**2):
                requests.append(lab.request((*free, *c.parameters), without | c.times(shape, amount), race=Race(fit.cost)))
                of.append(c)
                break
    return better(zip(of, lab.fits(requests, floor), strict=True), best)


def instead(
    lab: Laboratory,
    free: Sequence[Parameter],
    best: Mapping[str, tuple[Candidate, Fit]],
    candidates: Sequence[Candidate],
    base: Fit,
    floor: Floor,
) -> dict[str, tuple[Candidate, Fit]]:
    """Fits of other candidates from where the leading one ended, without it.

    The base fit makes up for what it lacks by a modulus far from the true one, and the fits that begin there may all miss their valleys
    but for one effect that stands in for the true one: with it the declared values come near theirs. They are held while sizes of what
    promises something there, or of all where that is one launch, are tried and fitted: the valleys of a size and a modulus together are
    narrow.
    """
    top = leader(best)
    if top is None or lab.problem.settings == 1:
        return {}
    lead, fit = top
    before, squares = lab.mean_squares([base.point, fit.point], floor)
    if (
        fit.cost > HALF * lab.costs([base.point], floor)[0]
        or leaves_no_more(lab, base, squares)
        or comparing.gain(lab, before, squares) < LEAST_GAIN
    ):
        return {}
    begin = lead.without(fit.point)
    if not lab.runs(begin) or lab.budget.skips(f"effects in the place of {lead.key}"):
        return {}
    most = MANY if lab.problem.together else SMALL
    behind = [c for c in candidates if c.name != lead.name and len(c.parameters) <= most and is_behind(c, best, fit)]
    there, _ = discretisation.stand(lab, fit.point, like=floor, fitted=True)
    ranked, _ = directions.screen(lab, begin, behind, there, directions.slopes(lab, free, begin, lab.fitted_recordings))
    starts: dict[str, tuple[Candidate, Point]] = {}
    for stays, c, _, start in ranked:
        if lab.problem.together or (stays < PROMISING and len(starts) < SCANNED):
            starts.setdefault(c.key, (c, start))
    if not starts:
        return {}
    tried = [(c, point) for c, start in starts.values() for point in (start, *scanned(lab, c, start))]
    found: dict[str, tuple[float, Candidate, Point]] = {}
    for (c, point), cost in zip(tried, lab.costs([point for _, point in tried], there), strict=True):
        if np.isfinite(cost) and cost < found.get(c.key, (math.inf,))[0]:
            found[c.key] = (cost, c, point)
    limit = lab.costs([fit.point], there)[0]
    leading = sorted((entry for entry in found.values() if entry[0] < FROM_THERE * limit), key=lambda entry: entry[0])
    leading = leading[: INSTEAD if lab.problem.together else INSTEAD_ONE_BY_ONE]
    if not leading:
        return {}
    lab.tell(f"in the place of {lead.key}: {', '.join(c.key for _, c, _ in leading)}")
    alone = lab.fits([lab.request(c.parameters, point) for _, c, point in leading], there)
    placed = [(c, end) for (_, c, _), end in zip(leading, alone, strict=True)]
    race = Race(limit)
    fits = lab.fits([lab.request((*free, *c.parameters), end.point, race=race) for c, end in placed], there)
    costs = lab.costs([end.point for end in fits], floor)
    return better(((c, replace(end, cost=cost)) for (c, _), end, cost in zip(placed, fits, costs, strict=True)), best)


def leaves_no_more(lab: Laboratory, base: Fit, squares: np.ndarray) -> bool:
    """Whether noise alone is left; a little more than that may be what a stand-in leaves, where the base fit is led away."""
    return comparing.is_noise(lab, squares) and (
        comparing.moved(lab, base.point) < LED_AWAY or bool(np.all(squares < NO_MORE * lab.noise_squares))
    )


def scanned(lab: Laboratory, c: Candidate, start: Point) -> list[Point]:
    """A start of a candidate of one size with sizes of either sign from the one that it is screened at up."""
    if len(c.size_parameters) != 1 or not c.linear:
        return []
    p = c.size_parameters[0]
    unit = abs(c.starts[0][p.name])
    sizes = [sign * unit * STEP**k for sign in p.signs for k in range(STEPS)]
    return [{**start, p.name: size} for size in sizes if p.lower < size < p.upper]
