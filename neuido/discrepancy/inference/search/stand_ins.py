"""Other candidates in the place of the leading effect, fitted from the point where its fit ended."""

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
"""Ratio to the cost of the leading fit from which a candidate counts as behind it."""
ALIKE = 0.3
"""Largest share of the leading effect's action on the data, beyond the declared parameters, that a candidate may fail to reproduce if it
is fitted from there."""
HALF = 0.5
"""Share of the base fit's cost below which the fit with the leading effect is trusted for the declared values."""
PROMISING = 0.75
"""Predicted share of the misfit below which a candidate is tried in the place of the leading one where simulations run one by one. The
limit can miss an effect: a true one, another stiffness in compression, left more than 0.82 by this measure."""
INSTEAD, INSTEAD_ONE_BY_ONE = 8, 2
"""Number of candidates that are fitted there; the second where simulations run one by one."""
SCANNED = 8
"""Number of candidates whose sizes are scanned there where simulations run one by one; otherwise all are."""
FROM_THERE = 20.0
"""Ratio to the cost of the leading fit up to which a scanned size is fitted. Three effects that were found so began at ratios of 0.4, 6
and 15."""
NO_MORE = 1.1
"""Ratio of mean squares to those of the noise up to which there is no reason to search further although the base fit is far from the
declared values."""
STEP, STEPS = 1.5, 9
"""Ratio between neighbouring scanned sizes, and their number: up to 26 times the size at which the candidate is screened."""


def leader(best: Mapping[str, tuple[Candidate, Fit]]) -> tuple[Candidate, Fit] | None:
    """Return the candidate of few parameters with the fit of least cost, or None."""
    return min((entry for entry in best.values() if len(entry[0].parameters) <= MANY), key=lambda entry: entry[1].cost, default=None)


def is_behind(c: Candidate, best: Mapping[str, tuple[Candidate, Fit]], fit: Fit) -> bool:
    """Return whether a candidate has no fit with about the cost of a leading one."""
    return c.key not in best or best[c.key][1].cost >= NEAR_IT * fit.cost


def limiting_cases(
    lab: Laboratory, free: Sequence[Parameter], best: Mapping[str, tuple[Candidate, Fit]], candidates: Sequence[Candidate], floor: Floor
) -> dict[str, tuple[Candidate, Fit]]:
    """Fit limiting cases of the leading candidate from its declared values, with sizes that act about as strongly.

    Their earlier fits may have ended elsewhere because the base fit was far off. Only fits better than those in `best` are returned, by
    key.
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


def similar_candidates(
    lab: Laboratory,
    free: Sequence[Parameter],
    best: Mapping[str, tuple[Candidate, Fit]],
    candidates: Sequence[Candidate],
    chosen: Mapping[str, int],
    columns: Mapping[tuple[str, int], Mapping[int, np.ndarray]],
    slopes: Mapping[int, np.ndarray],
    floor: Floor,
) -> dict[str, tuple[Candidate, Fit]]:
    """Fit candidates that act on the data as the leading one does, from its fit, with sizes that act as strongly.

    An earlier fit of such a candidate may have begun far away and been given up, and the class would lack a member. A candidate of many
    parameters is included if the leading one is a limiting case of it and leaves more than noise. Only fits better than those in `best` are
    returned, by key.
    """
    top = leader(best)
    if top is None:
        return {}
    lead, fit = top
    if not lead.linear or lead.size_parameters != lead.parameters:
        return {}
    at = chosen.get(lead.key, 0)  # a limiting case may lead without a rank in the screening
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


def candidates_in_place(
    lab: Laboratory,
    free: Sequence[Parameter],
    best: Mapping[str, tuple[Candidate, Fit]],
    candidates: Sequence[Candidate],
    base: Fit,
    floor: Floor,
) -> dict[str, tuple[Candidate, Fit]]:
    """Fit other candidates from the end of the leading fit, without the leading effect.

    The base fit may compensate for a missing effect by a wrong modulus. Fits that begin there may then all end in wrong local minima, but
    for one effect that resembles the true one and brings the declared values near their true values. These values are held while sizes of
    promising candidates are tried and fitted, because the minimum in size and modulus together is narrow; then all are fitted. All
    candidates are tried where that takes one launch. Only fits better than those in `best` are returned, by key.
    """
    top = leader(best)
    if top is None or lab.problem.settings == 1:
        return {}
    lead, fit = top
    before, squares = lab.mean_squares([base.point, fit.point], floor)
    if (
        fit.cost > HALF * lab.costs([base.point], floor)[0]
        or leaves_only_noise(lab, base, squares)
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


def leaves_only_noise(lab: Laboratory, base: Fit, squares: np.ndarray) -> bool:
    """Return whether only noise is left, so that no other effect is to be tried.

    Where the base fit is far from the declared values (`LED_AWAY`), the limit is stricter: a little more than noise may come from an effect
    that only resembles the true one.
    """
    return comparing.is_noise(lab, squares) and (
        comparing.moved(lab, base.point) < LED_AWAY or bool(np.all(squares < NO_MORE * lab.noise_squares))
    )


def scanned(lab: Laboratory, c: Candidate, start: Point) -> list[Point]:
    """Return copies of a candidate's start with increasing sizes of either sign; none unless it has one size and acts in proportion."""
    if len(c.size_parameters) != 1 or not c.linear:
        return []
    p = c.size_parameters[0]
    unit = abs(c.starts[0][p.name])
    sizes = [sign * unit * STEP**k for sign in p.signs for k in range(STEPS)]
    return [{**start, p.name: size} for size in sizes if p.lower < size < p.upper]
