"""What a step says of its fits: what is named, and why the others are rejected."""

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
"""Ratio of a declared parameter to what the model states at which a base fit is led away by what it lacks."""


ALPHA = 0.05
"""Family-wise level of a named effect."""
CLASS_RATIO, CLASS_RATIO_EXACT = 1.4, 1.15
"""Candidates whose errors are within this factor of the best one's are not told from it; the smaller one where the discretisation has no
part in them (`EXACT`)."""
CLASS_RATIO_ABOVE = 1.8
"""The same where the best one leaves more than noise, for then the errors are those of the discretisation. With 1.7 one of 30 blind cases
loses a member of its class, with 1.96 another one gets a wrong leader."""
RIVAL = 0.4
"""Share of the best gain that a member of a class needs, so that what gains next to nothing is none. With 0.5 one of 30 blind cases loses a
member."""
LEAST_GAIN_EXACT = math.log(CLASS_RATIO_EXACT)
"""`LEAST_GAIN` where nothing is discretised: what two effects are told apart by."""
WITHIN = 0.5
"""Share of the floor within which a residual that no effect explains is no reason to look further; as far above it is `ABOVE`."""
ABOVE = 1.0 / WITHIN
"""Times its floor from which a residual that no effect explains is unknown."""
CLEAR = 1.5
"""Times its floor from which a residual is clearly above it: the least gain is enough, and what an effect leaves is searched for another
one; eight searches below it found none. Above it what the suggested method leaves is searched before another one is asked."""
GAIN_IN_FLOOR = math.log(4.0)
"""What it takes well within the floor, where the best candidates of blind nulls gained up to 3.3 times: only an effect that the data show
far below it."""
GAIN_AT_FLOOR = math.log(2.5)
"""What it takes where the residual is as large as the floor; those of 55 blind nulls gained up to 1.9 times there."""
GAIN_TO_NOISE = 0.5 * GAIN_IN_FLOOR
"""What it takes where noise alone is left, for a candidate can take the place of what the grid does; of one that `stands_alone`; and above
the floor where the base fit is led away, as none of 40 nulls' was. Twofold."""
EXACT = 1.05
"""Mean squares up to so many times those of the noise, and three deviations of their own, that one simulation alone leaves where no other
grid has a part in the data."""
BROUGHT_BACK = 1.5
"""Ratio of a declared parameter to what the model states up to which it is as stated: what brings a base fit back there that is led away
(`LED_AWAY`) need gain no more than `LEAST_GAIN`, and `BACK_GAIN` above the floor. Of 344 blind cases, 119 nulls among them, the first
changed one answer, to a right one. Well within the floor it needs what all need there: grids led one null's base fit 36-fold away."""
BACK_GAIN = math.log(CLASS_RATIO)
"""What such an effect must gain above the floor: what effects are told apart by."""
FEW = 3
"""Parameters up to which an effect is told by the fitted recordings, where it leaves noise alone there, gains `GAIN_IN_FLOOR` and leads
every other by `GAIN_TO_NOISE`. In a blind seed ten of eleven like that were named, all rightly, and none came up on its twenty nulls. With
as many parameters more than the best one a rival must be better."""
FORETELLS = 0.5 * LEAST_GAIN
"""What such a one must gain in what is held out, and what each of several must add to the others there: half of what one alone must."""
SEEN = 0.1
"""Share of the noise, mean squares, that counts as above it where less is left."""
IMPLAUSIBLE = 30.0
"""Ratio of a fitted figure to the declared one from which the data are not those of the declared units or material."""
STANDS_OUT = 5.0
"""Times the noise above which a residual within its floor is no reason to say that nothing is missing: too much could hide there."""
LIKE_A_GRID = WITHIN, math.exp(GAIN_AT_FLOOR)
"""Times what another grid does, without a refit, in the held-out recordings: an effect that leaves more than the first where less than the
second was to be explained is not named. Of 223 named in eight blind seeds one was like that, a wrong one."""


def stands_alone(r: Round, t: Trial) -> bool:
    """Whether no other effect comes within `LEAST_GAIN` of what one of few parameters gains.

    What a grid does several make up for in part, about as well: in no step of 187 blind nulls did the best of them lead the next by so much
    with more than half of the error taken away.
    """
    others = [o.gain for o in r.trials if o.candidate.name != t.candidate.name]
    return bool(others) and len(t.candidate.size_parameters) <= SMALL and t.gain - max(others) > LEAST_GAIN


def gain_over_floor(over: float) -> float:
    """Return the gain that an effect must bring by how far the residual is above its floor, a ratio of errors."""
    return float(np.interp(math.log(over), [math.log(WITHIN), 0.0, math.log(CLEAR)], [GAIN_IN_FLOOR, GAIN_AT_FLOOR, LEAST_GAIN]))


class SimulatedEnds:
    """`search_state.Ends` by simulations of a laboratory."""

    def __init__(self, lab: Laboratory) -> None:
        self.lab = lab

    def measured(self, best: Mapping[str, tuple[Candidate, Fit]], floor: Floor, *, every: bool = False) -> list[Stand]:
        return refining.measured(self.lab, best, floor, every=every)

    def finished(self, named: Stand) -> Stand:
        return base_fits.finished(self.lab, named)

    def alone(self, stand: Stand) -> np.ndarray:
        return left_alone(self.lab, stand)


def judge(
    search: Search, empty: Round, best: Mapping[str, tuple[Candidate, Fit]], model: bootstrap.LinearModel, *, every: bool = False
) -> Round:
    """A round with the trials that fits make, and what is chosen of them; `every` as for `measured`."""
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
    if near and not is_exact(search, top):  # fits end where a step gains little, which may be short of the noise
        top.stand = finished[top.candidate.key] = search.ends.finished(top.stand)
        top.gain = comparing.gain(lab, errors, top.errors)
    if near and is_exact(search, top):  # only chance is to be beaten
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
    """Whether one simulation of a fit, without the differences of the settings, leaves nothing but a noise that is stated."""
    lab = search.lab
    stated = all(lab.problem.recordings[p.recording].noise for p in lab.parts)
    if lab.problem.settings == 1 or not stated or not comparing.is_noise(lab, t.errors):
        return False
    alone = search.ends.alone(t.stand)
    sure = EXACT + 3.0 * np.sqrt([2.0 / int(p.rows.sum()) for p in lab.parts])
    return bool(np.all(alone < sure * lab.noise_squares))


def left_alone(lab: Laboratory, stand: Stand) -> np.ndarray:
    """What one simulation leaves where a fit ended, mean squares of the parts."""
    squares = lab.mean_squares([stand.fit.point], stand.floor, plain=True)[0]
    lab.journal.alone[place(lab.own, stand)] = tuple(squares.tolist())
    return squares


def is_like_a_grid(lab: Laboratory, t: Trial, before: np.ndarray) -> bool:
    """Whether what is held out was off by about as much as grids differ by, `LIKE_A_GRID`, and still is with the effect.

    Not where the effect brings what is fitted to the noise, or gains what one within the floor needs: there it does what no grid does.
    """
    if t.gain > GAIN_IN_FLOOR or comparing.is_noise(lab, t.errors[lab.fitted], fitted=True):
        return False
    least, most = LIKE_A_GRID
    return over_grids(lab, t.errors, t) > least and over_grids(lab, before, t) < most


def over_grids(lab: Laboratory, errors: np.ndarray, at: Trial) -> float:
    """Errors of what is held out over what grids differ by where a trial stands; NaN where nothing is held out, or there is no grid."""
    out = ~np.array(lab.fitted)
    if lab.problem.settings == 1 or not out.any():
        return math.nan
    return times_over(errors[out], at.stand.floor.spread_squares(lab.parts)[out])


def verdict(lab: Laboratory, r: Round) -> str:
    """A line about what a round found."""
    before = f"{comparing.typical(lab, r.errors):.3g} {lab.problem.unit}"
    if not r.trials:
        return f"{before} left, no candidate runs"
    top = r.chosen or r.trials[0]
    left = f"{top.candidate.key} leaves {comparing.typical(lab, top.errors):.3g} of {before}"
    return f"named: {left}" if r.chosen else f"nothing named: {left}"


def least_gain(lab: Laboratory, r: Round, t: Trial) -> float:
    """The gain that an effect must bring, by the residual over the floor, what it and others leave, and where declared values go."""
    if lab.problem.settings == 1:  # nothing is discretised: only chance is to be beaten
        return LEAST_GAIN_EXACT
    if comparing.is_noise(lab, t.errors):  # whatever the floor, no error of the discretisation is in there
        return GAIN_TO_NOISE
    if is_told_by_fit(lab, r, t):
        return FORETELLS
    away = comparing.moved(lab, r.base) > LED_AWAY
    if away and r.over > WITHIN and comparing.moved(lab, t.fit.point) < BROUGHT_BACK:
        return BACK_GAIN if r.over > 1.0 else LEAST_GAIN
    at_least = gain_over_floor(r.over)
    return min(at_least, GAIN_TO_NOISE) if (away and r.over > 1.0) or stands_alone(r, t) else at_least


def is_told_by_fit(lab: Laboratory, r: Round, t: Trial) -> bool:
    """Whether an effect of few parameters, and no other one by far, brings the fitted recordings from far above the noise down to it.

    What is held out may lie within what grids differ by all the same, for there their amounts are those of the fitted ones.
    """
    if all(lab.fitted) or not comparing.is_noise(lab, t.errors[lab.fitted], fitted=True) or len(t.candidate.parameters) > FEW:
        return False
    fitted = np.array(lab.fitted)
    leads = [bootstrap.ratio(o.errors, t.errors, fitted) for o in r.trials if o.candidate.name != t.candidate.name]
    return min(leads, default=math.inf) > GAIN_TO_NOISE and bootstrap.ratio(r.errors, t.errors, fitted) > GAIN_IN_FLOOR


def above_noise(lab: Laboratory, before: np.ndarray, t: Trial) -> float:
    """The gain, that of the fitted recordings by what is above the noise: near it nothing lowers the whole of an error by much.

    Of 531 steps of nine blind seeds this names one effect that was not named before, a right one.
    """
    if lab.problem.settings == 1:
        return t.gain
    above = [np.maximum(errors - lab.noise_squares, SEEN * lab.noise_squares) for errors in (before, t.errors)]
    fitted = np.array(lab.fitted)
    return max(t.gain, min(bootstrap.ratio(*above, fitted), comparing.foretold(lab, before, t.errors)))


def by_chance(lab: Laboratory, r: Round) -> float:
    """Gain up to which an effect is not worth another look, be it alone or with a second one."""
    return max(r.by_chance(ALPHA), SOME_GAIN)


def as_good(search: Search, t: Trial, top: Trial) -> bool:
    """Whether a fit comes near the errors of the best one; with `FEW` parameters more it must be better, by `PARSIMONY` for each."""
    lab = search.lab
    more = len(t.candidate.size_parameters) - len(top.candidate.size_parameters)
    ratio = CLASS_RATIO if lab.problem.settings == 1 or comparing.is_noise(lab, top.errors) else CLASS_RATIO_ABOVE
    if is_exact(search, top):
        ratio = CLASS_RATIO_EXACT
    return t.score - top.score < (-PARSIMONY * more if more >= FEW else 2.0 * math.log(ratio))


def is_rival(search: Search, t: Trial, top: Trial) -> bool:
    """Whether the data cannot tell `t` from the best one: about its errors, a gain of its own, and not by many more parameters."""
    return t is top or (as_good(search, t, top) and t.gain > RIVAL * top.gain) or is_behind_by_a_grid(search.lab, t, top)


def is_behind_by_a_grid(lab: Laboratory, t: Trial, top: Trial) -> bool:
    """Whether `t` is behind in what is held out alone, where it leaves less than grids differ by: another grid may foretell it.

    With no more parameters it leaves no more of what is fitted, and the best one leaves more than noise there. Of 304 named steps of
    ten blind seeds that puts a further effect into two classes, in one of them the true one.
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
