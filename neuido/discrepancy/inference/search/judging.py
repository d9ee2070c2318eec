"""The judgement of one round of fits: which effect is named, and why the others are rejected."""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from neuido.discrepancy.inference import bootstrap, comparing
from neuido.discrepancy.inference.comparing import LEAST_GAIN
from neuido.discrepancy.inference.floors import PARSIMONY, Floor, Round, Stand, Trial, times_over, unphysical
from neuido.discrepancy.inference.journal import place
from neuido.discrepancy.inference.laboratory import Laboratory
from neuido.discrepancy.inference.least_squares import Fit
from neuido.discrepancy.inference.search import base_fits, refining
from neuido.discrepancy.inference.search.contests import SMALL
from neuido.discrepancy.inference.search.refining import SOME_GAIN
from neuido.discrepancy.inference.search.search_state import Search
from neuido.discrepancy.problems.problem import Candidate

LED_AWAY = 2.5
"""Ratio of a fitted to a declared value, or the reverse, above which the base fit is taken to compensate for a missing effect."""


ALPHA = 0.05
"""Family-wise significance level of a named effect."""
CLASS_RATIO, CLASS_RATIO_EXACT = 1.4, 1.15
"""Ratio to the error of the best candidate up to which another one belongs to its class. The smaller one holds where one simulation
leaves only noise (`EXACT`), so that discretisation plays no part."""
CLASS_RATIO_ABOVE = 1.8
"""The same where the best candidate leaves more than noise, because the errors are then those of discretisation. With 1.7 one of 30
blind cases loses a member of its class, with 1.96 another one gets a wrong leader."""
RIVAL = 0.4
"""Share of the best gain that a member of a class needs, so that an effect that hardly helps is none. With 0.5 one of 30 blind cases
loses a member."""
LEAST_GAIN_EXACT = math.log(CLASS_RATIO_EXACT)
"""`LEAST_GAIN` where nothing is discretised: the ratio at which two effects can be told apart."""
WITHIN = 0.5
"""Ratio to its floor up to which a residual that no effect explains is no reason to search further; its reciprocal is `ABOVE`."""
ABOVE = 1.0 / WITHIN
"""Ratio to its floor above which a residual that no effect explains is called unknown."""
CLEAR = 1.5
"""Ratio to its floor from which a residual is clearly above it. Then the least gain is enough to name an effect, a further effect is
searched for, and the suggested method's effects are searched before another method is asked. Eight searches for a further effect below
it found none."""
GAIN_IN_FLOOR = math.log(4.0)
"""Least gain where the residual is well within the floor, where the best candidates of blind nulls gained up to 3.3-fold. Only an effect
that the data show far below the floor passes."""
GAIN_AT_FLOOR = math.log(2.5)
"""Least gain where the residual is as large as the floor, where the best candidates of 55 blind nulls gained up to 1.9-fold."""
GAIN_TO_NOISE = 0.5 * GAIN_IN_FLOOR
"""Least gain (twofold) of an effect that leaves only noise, because a candidate may fit what the grid does; of an effect that
`stands_alone`; and, above the floor, where the base fit compensates for something (`LED_AWAY`), as none of 40 nulls' base fits did."""
EXACT = 1.05
"""Ratio of mean squares to those of the noise up to which one simulation alone leaves only noise, beside three standard deviations of
the estimate. No other grid then plays a part in the data."""
BROUGHT_BACK = 1.5
"""Ratio of a fitted to a declared value, or the reverse, up to which the value counts as declared. An effect that brings a base fit
beyond `LED_AWAY` back to it needs a gain of only `LEAST_GAIN`, or `BACK_GAIN` above the floor. Of 344 blind cases, 119 nulls among them,
the first changed one answer, to a right one. Well within the floor the usual gain is required: there grids led one null's base fit
36-fold away."""
BACK_GAIN = math.log(CLASS_RATIO)
"""Least gain of such an effect above the floor: the ratio at which effects can be told apart."""
FEW = 3
"""Number of parameters up to which an effect may be named by the fitted recordings: where it leaves only noise there, gains
`GAIN_IN_FLOOR` and leads every other effect by `GAIN_TO_NOISE`. In a blind seed ten of eleven such effects were named, all rightly, and
none occurred on its twenty nulls. A rival with as many parameters more than the best effect must have the smaller error."""
FORETELLS = 0.5 * LEAST_GAIN
"""Least gain in the held-out data of an effect that the fitted recordings name, and of each of several effects beside the others: half
of what a single effect needs."""
SEEN = 0.1
"""Share of the mean square of the noise that counts as the residual above the noise where less is left."""
IMPLAUSIBLE = 30.0
"""Ratio of a fitted figure to the declared one from which the data do not have the declared units or material."""
STANDS_OUT = 5.0
"""Ratio to the noise above which a residual within its floor does not allow the answer `none`: too large an effect could hide there."""
LIKE_A_GRID = WITHIN, math.exp(GAIN_AT_FLOOR)
"""Ratios of held-out errors to the difference that another grid makes without a refit. An effect is not named if it leaves more than the
first where less than the second was to be explained. Of 223 effects named in eight blind seeds one was like that, a wrong one."""


def stands_alone(r: Round, t: Trial) -> bool:
    """Return whether an effect of few parameters gains more than every other effect by at least `LEAST_GAIN`.

    Several effects compensate about equally well for a grid: in no step of 187 blind nulls did the best lead the next by so much with more
    than half of the error removed.
    """
    others = [o.gain for o in r.trials if o.candidate.name != t.candidate.name]
    return bool(others) and len(t.candidate.size_parameters) <= SMALL and t.gain - max(others) > LEAST_GAIN


def gain_over_floor(over: float) -> float:
    """Return the gain that an effect needs, given the ratio of the residual to its floor."""
    return float(np.interp(math.log(over), [math.log(WITHIN), 0.0, math.log(CLEAR)], [GAIN_IN_FLOOR, GAIN_AT_FLOOR, LEAST_GAIN]))


class SimulatedEnds:
    """Fit results (`search_state.Ends`) by simulations."""

    def __init__(self, lab: Laboratory) -> None:
        self.lab = lab

    def measured(self, best: Mapping[str, tuple[Candidate, Fit]], floor: Floor, *, every: bool = False) -> list[Stand]:
        return refining.measured(self.lab, best, floor, every=every)

    def finished(self, named: Stand) -> Stand:
        return base_fits.finished(self.lab, named)

    def alone(self, stand: Stand) -> np.ndarray:
        return errors_of_one_simulation(self.lab, stand)


def judge(
    search: Search, empty: Round, best: Mapping[str, tuple[Candidate, Fit]], model: bootstrap.LinearModel, *, every: bool = False
) -> Round:
    """Return a round with the trials of all fits and the effect that is named, if any.

    Args:
        search: The search by one method.
        empty: The round without trials: its base, floors and null hypothesis.
        best: The best fit of each candidate, by key.
        model: The linear model of the fits, for the null hypothesis and the cosines between effects.
        every: Whether all fits are measured with the floor at their ends, not the leading ones alone.
    """
    lab = search.lab
    errors = empty.errors
    trials = []
    stands = search.ends.measured(best, empty.floor, every=every)
    finished: dict[str, Stand] = {}
    exact_null = np.empty(0)
    for (c, fit), stand in zip(best.values(), stands, strict=True):
        trial = Trial(c, stand, comparing.gain(lab, errors, stand.errors))
        trial.reason = unphysical(c, fit.point) if np.isfinite(stand.errors).all() else "not every recording runs where its fit ends"
        trials.append(trial)
    trials.sort(key=lambda t: t.score)
    good = [t for t in trials if not t.reason]
    top = min(good, key=lambda t: t.penalised) if good else None
    p = float((1 + np.sum(empty.null >= top.gain)) / (1 + len(empty.null))) if top else 1.0
    unfitted = {key: why for key, why in empty.unfitted.items() if key not in best}
    result = replace(empty, trials=trials, p_value=p, cosines={}, unfitted=unfitted)
    judged = [(c, stand) for (c, _), stand in zip(best.values(), stands, strict=True)]
    if top is None:
        result.record = lab.journal.judged(lab.own, result, judged, lab.parts, finished, exact_null)
        return result
    for t in trials:
        if t.candidate.key in model.keys and top.candidate.key in model.keys:
            result.cosines[t.candidate.key] = model.cosine(t.candidate.key, top.candidate.key)
    named = p <= ALPHA and above_noise(lab, errors, top) > least_gain(lab, result, top)
    near = not named and top.gain > LEAST_GAIN_EXACT and comparing.is_noise(lab, top.errors)
    if near and not is_exact(search, top):  # a fit ends where a step gains little, which may be before it reaches the noise
        top.stand = finished[top.candidate.key] = search.ends.finished(top.stand)
        top.gain = comparing.gain(lab, errors, top.errors)
    if near and is_exact(search, top):  # the effect must only beat chance
        exact_null = model.null(errors, search.draws, exact=True)
        result.p_value = float((1 + np.sum(exact_null >= top.gain)) / (1 + len(exact_null)))
        named = result.p_value <= ALPHA
    if named and is_like_a_grid(lab, top, errors):
        named, top.reason = False, "leaves about what another grid does to the recordings that were held out"
    if named:
        result.chosen = top
        result.members = [t for t in good if is_rival(search, t, top)]
    for t in trials:
        if not t.reason and t not in result.members:
            t.reason = _why(lab, t, top, result)
    result.record = lab.journal.judged(lab.own, result, judged, lab.parts, finished, exact_null)
    return result


def is_exact(search: Search, t: Trial) -> bool:
    """Return whether one simulation of a fit, without differences between settings, leaves only noise that is stated in the folder."""
    lab = search.lab
    stated = all(lab.problem.recordings[p.recording].noise for p in lab.parts)
    if lab.problem.settings == 1 or not stated or not comparing.is_noise(lab, t.errors):
        return False
    alone = search.ends.alone(t.stand)
    sure = EXACT + 3.0 * np.sqrt([2.0 / int(p.rows.sum()) for p in lab.parts])
    return bool(np.all(alone < sure * lab.noise_squares))


def errors_of_one_simulation(lab: Laboratory, stand: Stand) -> np.ndarray:
    """Return the mean squares of the parts that one simulation leaves at the end of a fit, and record them in the journal."""
    squares = lab.mean_squares([stand.fit.point], stand.floor, plain=True)[0]
    lab.journal.alone[place(lab.own, stand)] = tuple(squares.tolist())
    return squares


def is_like_a_grid(lab: Laboratory, t: Trial, before: np.ndarray) -> bool:
    """Return whether the held-out error is about as large as differences between grids, both before and with the effect.

    The limits are `LIKE_A_GRID`. An effect that brings the fitted recordings down to noise, or gains `GAIN_IN_FLOOR`, does what no grid
    does and is exempt.
    """
    if t.gain > GAIN_IN_FLOOR or comparing.is_noise(lab, t.errors[lab.fitted], fitted=True):
        return False
    least, most = LIKE_A_GRID
    return over_grids(lab, t.errors, t) > least and over_grids(lab, before, t) < most


def over_grids(lab: Laboratory, errors: np.ndarray, at: Trial) -> float:
    """Return the ratio of the held-out errors to the differences between grids where a trial stands.

    Return NaN where nothing is held out or nothing is discretised. `errors` are mean squares of the parts.
    """
    out = ~np.array(lab.fitted)
    if lab.problem.settings == 1 or not out.any():
        return math.nan
    return times_over(errors[out], at.stand.floor.spread_squares(lab.parts)[out])


def verdict(lab: Laboratory, r: Round) -> str:
    """Return one line about the outcome of a round."""
    before = f"{comparing.typical_error(lab, r.errors):.3g} {lab.problem.unit}"
    if not r.trials:
        return f"{before} left, no candidate runs"
    top = r.chosen or r.trials[0]
    left = f"{top.candidate.key} leaves {comparing.typical_error(lab, top.errors):.3g} of {before}"
    return f"named: {left}" if r.chosen else f"nothing named: {left}"


def least_gain(lab: Laboratory, r: Round, t: Trial) -> float:
    """Return the gain that an effect needs to be named.

    It depends on the ratio of the residual to its floor, on what this and other effects leave, and on how far the declared values move.
    """
    if lab.problem.settings == 1:  # nothing is discretised: the effect must only beat chance
        return LEAST_GAIN_EXACT
    if comparing.is_noise(lab, t.errors):  # whatever the floor is, no discretisation error is left
        return GAIN_TO_NOISE
    if is_told_by_fit(lab, r, t):
        return FORETELLS
    away = comparing.moved(lab, r.base) > LED_AWAY
    if away and r.over > WITHIN and comparing.moved(lab, t.fit.point) < BROUGHT_BACK:
        return BACK_GAIN if r.over > 1.0 else LEAST_GAIN
    at_least = gain_over_floor(r.over)
    return min(at_least, GAIN_TO_NOISE) if (away and r.over > 1.0) or stands_alone(r, t) else at_least


def is_told_by_fit(lab: Laboratory, r: Round, t: Trial) -> bool:
    """Return whether an effect of few parameters alone brings the fitted recordings from far above the noise down to it.

    The held-out error may still lie within differences between grids, because it uses the amounts of the fitted recordings.
    """
    if all(lab.fitted) or not comparing.is_noise(lab, t.errors[lab.fitted], fitted=True) or len(t.candidate.parameters) > FEW:
        return False
    fitted = np.array(lab.fitted)
    leads = [bootstrap.ratio(o.errors, t.errors, fitted) for o in r.trials if o.candidate.name != t.candidate.name]
    return min(leads, default=math.inf) > GAIN_TO_NOISE and bootstrap.ratio(r.errors, t.errors, fitted) > GAIN_IN_FLOOR


def above_noise(lab: Laboratory, before: np.ndarray, t: Trial) -> float:
    """Return the gain of an effect, by the error above the noise where that is larger.

    Near the noise nothing lowers the whole error by much. So the gain of the fitted recordings is taken from their error above the noise,
    and counts up to the gain of the held-out ones. Of 531 steps of nine blind seeds this names one effect that was not named before, a
    right one.
    """
    if lab.problem.settings == 1:
        return t.gain
    above = [np.maximum(errors - lab.noise_squares, SEEN * lab.noise_squares) for errors in (before, t.errors)]
    fitted = np.array(lab.fitted)
    return max(t.gain, min(bootstrap.ratio(*above, fitted), comparing.held_out_gain(lab, before, t.errors)))


def by_chance(lab: Laboratory, r: Round) -> float:
    """Return the gain that chance alone may bring; an effect that gains less is fitted no further, neither alone nor with a second one."""
    return max(r.by_chance(ALPHA), SOME_GAIN)


def as_good(search: Search, t: Trial, top: Trial) -> bool:
    """Return whether a fit has about the error of the best one.

    With `FEW` or more parameters more than the best one, it must have a smaller error, by `PARSIMONY` for each. Where the floor is the
    scatter of specimens, this does not hold: a specimen is off as a whole, and its many rows are no evidence for fewer parameters.
    """
    lab = search.lab
    scattered = lab.problem.labels.get("scatter", False)
    more = 0 if scattered else len(t.candidate.size_parameters) - len(top.candidate.size_parameters)
    ratio = CLASS_RATIO if lab.problem.settings == 1 or comparing.is_noise(lab, top.errors) else CLASS_RATIO_ABOVE
    if is_exact(search, top):
        ratio = CLASS_RATIO_EXACT
    return t.score - top.score < (-PARSIMONY * more if more >= FEW else 2.0 * math.log(ratio))


def is_rival(search: Search, t: Trial, top: Trial) -> bool:
    """Return whether the data cannot tell a trial from the best one, so that it belongs to its class."""
    return t is top or (as_good(search, t, top) and t.gain > RIVAL * top.gain) or is_behind_by_a_grid(search.lab, t, top)


def is_behind_by_a_grid(lab: Laboratory, t: Trial, top: Trial) -> bool:
    """Return whether a trial is behind the best one only in the held-out data, and there within differences between grids.

    Another grid might then predict the held-out data as well. The trial must have no more parameters and leave no more of the fitted
    recordings than the best one, and the best one must leave more than noise there. Of 304 named steps of ten blind seeds this adds an
    effect to two classes, to one of them the true one.
    """
    if comparing.is_noise(lab, top.errors[lab.fitted], fitted=True):
        return False
    few = len(t.candidate.size_parameters) <= len(top.candidate.size_parameters)
    return few and comparing.fitted_score(lab, t.errors) <= comparing.fitted_score(lab, top.errors) and over_grids(lab, t.errors, top) < 1.0


def _why(lab: Laboratory, t: Trial, top: Trial, result: Round) -> str:
    if result.chosen is None:
        at_least = max(result.by_chance(ALPHA), least_gain(lab, result, t))
        return t.too_little(at_least, "with nuisances and discretisation")
    return f"leaves {math.exp(0.5 * (t.score - top.score)):.1f} times the error of {top.candidate.name}"
