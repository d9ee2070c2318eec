"""The best fits once more: with the floor where they stand, from where another one stands, and from further away."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from neuido.discrepancy.contests import IN_REACH, MANY, better
from neuido.discrepancy.fit import Fit, Race
from neuido.discrepancy.floors import Floor
from neuido.discrepancy.growing import Growing
from neuido.discrepancy.laboratory import LEAST_GAIN
from neuido.discrepancy.problem import Candidate, Parameter, Point
from neuido.discrepancy.starting import FAR, SMALL
from neuido.discrepancy.trials import Round, Stand, score
from neuido.physics.effect_library import LIMITS

POLISHED = 4
"""Candidates whose fits are refined from further starts."""
NEARBY = 2.5
"""Times the least error, that of what is held out too, up to which a fit is worth refining."""
BEYOND = 8.0
"""Times the error of what another solver named beyond which fits are not refined: that has gained up to 7-fold."""
MEASURED, NEAR = 6, 4.0
"""Fits whose errors are measured with the differences of the settings where they end: so many of the best, within this factor of their
errors."""
ONWARD = 3
"""Further fits of a candidate, each with the differences of the settings where the last one ended: while each gains `SOME_GAIN` or has
not come to its end."""
SOME_GAIN = math.log(1.2)
"""Smaller gains are no reason to look further."""
ALIKE = 0.3
"""Share of what the leading effect does to the data, past the declared parameters, that a candidate may leave to be fitted from there."""

HALF = 0.5
"""Share of the base fit's cost below which the leading effect says where the declared values are."""
PROMISING = 0.75
"""Share of the misfit that a candidate may leave there, as its directions say, to be tried in its place."""
INSTEAD, INSTEAD_ONE_BY_ONE = 4, 2
"""Candidates that are fitted there, and the same where every point costs."""
SCANNED = 8
"""Candidates whose sizes are tried there where every point costs; otherwise all that promise."""
FROM_THERE = 10.0
"""Times the cost of the leading fit up to which one of these sizes is fitted: the two that this has found began at 0.4 and 6 times."""
STEP, STEPS = 1.5, 9
"""Ratio of these sizes, and how many: up to 26 times the one that the candidate is screened at."""

Onset = tuple[Sequence[Parameter], Fit, Sequence[Point]]
"""What is fitted, a fit of it, and where further ones begin."""


class Refining(Growing):
    """The further fits of a step of a diagnosis."""

    def polish(
        self,
        free: Sequence[Parameter],
        best: Mapping[str, tuple[Candidate, Fit]],
        base: Fit,
        floor: Floor,
        rival: Round | None = None,
        other: tuple[Candidate, Fit] | None = None,
    ) -> dict[str, tuple[Candidate, Fit]]:
        """The best fits once more, from where they ended, from the declared values, and from those of the very best one.

        The base fit may have led all of them astray, and its weights too, for the settings differ most where the model is wrong: each is
        weighed by the floor where it stands. Which end is the best one is said by the errors, for weights differ. Where `rival`, the round
        of another solver, named an effect that leaves far less than any of them, none is refined. `other`, the leading candidate's fit of
        the other sign, is refined beside it.
        """
        ranked = sorted(best.values(), key=lambda entry: entry[1].cost)
        within = [entry for entry in ranked if entry[1].cost < IN_REACH * ranked[0][1].cost]
        top = [entry for entry in within if len(entry[0].parameters) <= MANY][:POLISHED]
        if not top:
            return {}
        before, *squares = self.mean_squares([base.point, *(fit.point for _, fit in top)], floor)
        near = min(map(score, squares)) + 2.0 * math.log(NEARBY)
        top, squares = zip(*((t, s) for t, s in zip(top, squares, strict=True) if t is top[0] or score(s) < near), strict=True)
        if rival is not None and rival.chosen is not None and min(map(score, squares)) > rival.chosen.score + 2.0 * math.log(BEYOND):
            return {}
        gains = max(self.gain(before, square) for square in squares)
        if (top[0][1].cost > 0.7 * self.costs([base.point], floor)[0] and gains < SOME_GAIN) or self.is_noise(squares[0]):
            return {}
        ends = (f"{c.key} ({self.typical(square):.3g})" for (c, _), square in zip(top, squares, strict=True))
        self.tell(f"refining {', '.join(ends)} of {self.typical(before):.3g} {self.problem.unit}")
        leading = ranked[0][1].point
        out: dict[str, tuple[Candidate, Fit]] = {}
        least: dict[str, float] = {}
        if other is not None and other[1].cost < IN_REACH * ranked[0][1].cost:
            top = (*top, other)
        able = self.able(top)  # elsewhere there is no floor
        entries = []
        for c, fit in able:
            starts = [fit.point, self.at_declared(fit.point)]
            if fit is not ranked[0][1]:
                starts.append({**fit.point, **{name: leading[name] for name in self.as_declared}})
            entries.append(((*free, *c.parameters), fit, starts))
        for (c, _), (found, own) in zip(able, self.onward(entries, floor), strict=True):
            left = score(self.mean_squares([found.point], own, fitted=True)[0])
            if left < least.get(c.key, math.inf):
                least[c.key] = left
                out[c.key] = (c, replace(found, cost=self.costs([found.point], floor)[0]))
        return out

    def able(self, fits: Sequence[tuple[Candidate, Fit]]) -> list[tuple[Candidate, Fit]]:
        """Those that end where every recording runs."""
        return [entry for entry, ok in zip(fits, self.which_run([fit.point for _, fit in fits]), strict=True) if ok]

    def onward(self, entries: Sequence[Onset], floor: Floor) -> list[tuple[Fit, Floor]]:
        """What `from_here` makes of each entry, and further from where that ends, up to `ONWARD` times."""
        ends = self.from_here(entries, floor)
        going = list(range(len(ends)))
        for _ in range(ONWARD):
            if self.deadline.over:
                break
            run = self.which_run([ends[i][0].point for i in going])
            left = {i: self.mean_squares([ends[i][0].point], ends[i][1], fitted=True)[0] for i in going}
            going = [i for i, ok in zip(going, run, strict=True) if ok and not self.is_noise(left[i], fitted=True)]
            if not going:
                break
            made = self.from_here([(entries[i][0], ends[i][0], [ends[i][0].point]) for i in going], floor)
            further = []
            for i, (fit, there) in zip(going, made, strict=True):
                gained = score(left[i]) - score(self.mean_squares([fit.point], there, fitted=True)[0])
                if gained > 0:
                    ends[i] = (fit, there)
                    further += [i] * (not fit.converged or gained >= 2.0 * SOME_GAIN)
            going = further
        return ends

    def from_here(self, entries: Sequence[Onset], like: Floor) -> list[tuple[Fit, Floor]]:
        """Of each entry the best of its fit and of those from its starts, and the floor of all of them: that where the fit stands.

        The fits of all entries run side by side.
        """
        self.foresee([fit.point for _, fit, _ in entries], fitted=True)
        owns, requests, of = [], [], []
        for k, (free, fit, starts) in enumerate(entries):
            (own, _), race = self.stand(fit.point, like=like, fitted=True), Race()
            moved = self.recentred(fit.point, own)
            follow = {name: value for name, value in moved.items() if value != fit.point.get(name)}
            begins = [{**start, **follow} if set(start) == set(fit.point) else start for start in starts]
            requests += [self.request(free, begin, race=race) for begin in begins]
            of += [k] * len(begins)
            owns.append(own)
        made = self.fits(requests, [owns[k] for k in of])
        out = []
        for k, (_, fit, _) in enumerate(entries):
            ends = [fit, *(end for end, its in zip(made, of, strict=True) if its == k)]
            left = [score(squares) for squares in self.mean_squares([end.point for end in ends], owns[k], fitted=True)]
            out.append((ends[int(np.argmin(left))], owns[k]))
        return out

    def measured(self, best: Mapping[str, tuple[Candidate, Fit]], floor: Floor) -> list[Stand]:
        """Each fit, in their order, with what it leaves by `floor`, or for the leading ones by that where they end, if it leaves less.

        What another grid does moves with the law: the differences at the base say little of it where a fit has gone far.
        """
        fits, points = [fit for _, fit in best.values()], [fit.point for _, fit in best.values()]
        squares: dict[int, np.ndarray] = {}
        for setting in {fit.setting for fit in fits}:  # those that came close have the own one
            own = [i for i, fit in enumerate(fits) if fit.setting == setting]
            with self.under(setting):
                squares |= zip(own, self.mean_squares([points[i] for i in own], floor), strict=True)
        found = [Stand(fit, floor, squares[i]) for i, fit in enumerate(fits)]
        if self.problem.settings == 1 or not points:
            return found
        order = sorted(range(len(points)), key=lambda i: score(found[i].errors))[:MEASURED]
        limit = score(found[order[0]].errors) + 2.0 * math.log(NEAR)
        leading = [i for i in order if score(found[i].errors) < limit and not self.is_noise(found[i].errors)]
        self.foresee([points[i] for i in leading])
        for i in leading:
            if self.runs(points[i]):
                there = Stand(found[i].fit, *self.stand(points[i], like=floor))
                found[i] = min(found[i], there, key=lambda stand: score(stand.errors))
        return found

    def alike(
        self,
        free: Sequence[Parameter],
        best: Mapping[str, tuple[Candidate, Fit]],
        candidates: Sequence[Candidate],
        chosen: Mapping[str, int],
        columns: Mapping[tuple[str, int], Mapping[int, np.ndarray]],
        slopes: Mapping[int, np.ndarray],
        floor: Floor,
    ) -> dict[str, tuple[Candidate, Fit]]:
        """Fits of the candidates that act on the data as the leading one does, from its fit, with the sizes that do as much.

        A fit that started far from there may have been given up, and a class would lack one of its members.
        """
        small = [entry for entry in best.values() if len(entry[0].parameters) <= MANY]
        if not small:
            return {}
        lead, fit = min(small, key=lambda entry: entry[1].cost)
        if not lead.linear or lead.size_parameters != lead.parameters:
            return {}
        at = chosen.get(lead.key, 0)  # what is a limit of another one may lead without a place in the screening
        past, start = self.past(slopes, floor), lead.starts[at]
        does = past(columns[lead.key, at]) @ np.array([fit.point[p.name] / start[p.name] for p in lead.parameters])
        if not np.isfinite(does).all():
            return {}
        requests, of = [], []
        without = {k: v for k, v in fit.point.items() if k not in start}
        for c in candidates:
            if c is lead or not c.linear or len(c.parameters) > MANY or (c.key in best and best[c.key][1].cost < 1.5 * fit.cost):
                continue
            for i, shape in enumerate(c.starts):
                A = past(columns[c.key, i])
                if not np.isfinite(A).all():
                    continue
                amount = np.linalg.lstsq(A, does, rcond=1e-6)[0]
                if np.sum((does - A @ amount) ** 2) < ALIKE * np.sum(does**2):
                    requests.append(self.request((*free, *c.parameters), without | c.times(shape, amount), race=Race(fit.cost)))
                    of.append(c)
                    break
        return better(zip(of, self.fits(requests, floor), strict=True), best)

    def limits(
        self, free: Sequence[Parameter], best: Mapping[str, tuple[Candidate, Fit]], candidates: Sequence[Candidate], floor: Floor
    ) -> dict[str, tuple[Candidate, Fit]]:
        """Fits of what the leading candidate is in a limit, from its declared values and with sizes that do about as much.

        The base fit may have led theirs astray.
        """
        if not best:
            return {}
        lead, fit = min(best.values(), key=lambda entry: entry[1].cost)
        own = [
            c for c in candidates if c.name in LIMITS.get(lead.name, ()) and not (c.key in best and best[c.key][1].cost < 1.5 * fit.cost)
        ]
        if not own:
            return {}
        begin, wanted = lead.without(fit.point), self.fitted_recordings
        does = np.concatenate([there - here for here, there in self.predicted([begin, fit.point], wanted).values()])
        columns = self.columns(begin, own, wanted)
        requests = []
        for c in own:
            A = np.concatenate([columns[c.key, 0][n] for n in wanted])
            amount = np.linalg.lstsq(A, does, rcond=1e-6)[0] if np.isfinite(A).all() and np.isfinite(does).all() else np.ones(A.shape[1])
            requests.append(self.request((*free, *c.parameters), begin | c.times(c.starts[0], amount)))
        return better(zip(own, self.fits(requests, floor), strict=True), best)

    def elsewhere(
        self, base: Fit, best: Mapping[str, tuple[Candidate, Fit]], starts: Mapping[str, Mapping[str, float]], floor: Floor
    ) -> dict[str, tuple[Candidate, Fit]]:
        """Fits of one size once more, from the declared values and a larger size: the slope at zero may have led into a side valley."""
        begins: list[tuple[Candidate, Point]] = []
        for key, (c, fit) in best.items():
            if not c.linear or len(c.size_parameters) > 1 or len(c.parameters) > SMALL:
                continue
            (p,) = c.size_parameters
            for sign in (1.0, -1.0) if p.lower < 0 else (1.0,):
                size = p.within(sign * FAR * abs(starts[key][p.name]))
                begins.append((c, dict(fit.point) | self.as_declared | {p.name: size}))
        self.tell(f"again from elsewhere: {', '.join(dict.fromkeys(c.key for c, _ in begins))}")
        with self.quickly(base.point, floor):
            race = Race(min((fit.cost for _, fit in best.values() if fit.setting == self.setting), default=np.inf))
            requests = [self.request((*self.problem.declared, *c.parameters), begin, race=race) for c, begin in begins]
            ended = list(zip((c for c, _ in begins), self.fits(requests, floor), strict=True))
        found = better((entry for entry in ended if entry[1].setting == self.own), best)  # the costs of quick ones are of another motion
        return found | self.ahead(ended, {**best, **found}, floor)

    def ahead(
        self, ended: Sequence[tuple[Candidate, Fit]], best: Mapping[str, tuple[Candidate, Fit]], floor: Floor
    ) -> dict[str, tuple[Candidate, Fit]]:
        """Ends of fits once more with the floor where they stand, those that leave least: candidates that then leave less than their best.

        What another grid does there may be another thing than at the base, and by the weights of that the truth stays behind.
        """
        ended = [entry for entry in ended if np.isfinite(entry[1].cost)]
        if self.problem.settings == 1 or not ended or self.deadline.over:
            return {}
        with self.under(ended[0][1].setting):
            left = [score(squares) for squares in self.mean_squares([fit.point for _, fit in ended], floor)]
        out: dict[str, tuple[Candidate, Fit]] = {}
        ends = self.able([ended[i] for i in np.argsort(left)[:POLISHED]])
        made = self.from_here([((*self.problem.declared, *c.parameters), fit, [fit.point]) for c, fit in ends], floor)
        for (c, _), (further, own) in zip(ends, made, strict=True):
            rival = (out.get(c.key) or best[c.key])[1]
            there = self.stand(rival.point, like=floor, fitted=True)[0]
            pairs = ((further, own), (rival, there))
            mine, its = (score(self.mean_squares([end.point], f, fitted=True)[0]) for end, f in pairs)
            if mine < its:
                out[c.key] = (c, replace(further, cost=self.costs([further.point], floor)[0]))
        return out

    def instead(
        self, free: Sequence[Parameter], best: Mapping[str, tuple[Candidate, Fit]], candidates: Sequence[Candidate], base: Fit, floor: Floor
    ) -> dict[str, tuple[Candidate, Fit]]:
        """Fits of other candidates from where the leading one ended, without it.

        The base fit makes up for what it lacks by a modulus far from the true one, and the fits that begin there may all miss their valleys
        but for one effect that stands in for the true one: with it the declared values come near theirs. They are held while sizes of what
        promises something there are tried and fitted, for the valleys of a size and a modulus together are narrow.
        """
        small = [entry for entry in best.values() if len(entry[0].parameters) <= MANY]
        if not small or self.problem.settings == 1:
            return {}
        lead, fit = min(small, key=lambda entry: entry[1].cost)
        before, squares = self.mean_squares([base.point, fit.point], floor)
        if fit.cost > HALF * self.costs([base.point], floor)[0] or self.is_noise(squares) or self.gain(before, squares) < LEAST_GAIN:
            return {}
        begin = lead.without(fit.point)
        if not self.runs(begin) or self.deadline.skips(f"effects in the place of {lead.key}"):
            return {}
        behind = [
            c for c in candidates if c.name != lead.name and not (c.key in best and best[c.key][1].cost < 1.5 * fit.cost)
            and len(c.parameters) <= (MANY if self.problem.together else SMALL)
        ]  # fmt: skip
        there, _ = self.stand(fit.point, like=floor, fitted=True)
        ranked, _ = self.screen(begin, behind, there, self.slopes(free, begin, self.fitted_recordings))
        starts: dict[str, tuple[Candidate, Point]] = {}
        for stays, c, _, start in ranked:
            if stays < PROMISING and (self.problem.together or len(starts) < SCANNED):
                starts.setdefault(c.key, (c, start))
        if not starts:
            return {}
        tried = [(c, point) for c, start in starts.values() for point in (start, *self.scanned(c, start))]
        found: dict[str, tuple[float, Candidate, Point]] = {}
        for (c, point), cost in zip(tried, self.costs([point for _, point in tried], there), strict=True):
            if np.isfinite(cost) and cost < found.get(c.key, (math.inf,))[0]:
                found[c.key] = (cost, c, point)
        limit = self.costs([fit.point], there)[0]
        leading = sorted((entry for entry in found.values() if entry[0] < FROM_THERE * limit), key=lambda entry: entry[0])
        leading = leading[: INSTEAD if self.problem.together else INSTEAD_ONE_BY_ONE]
        if not leading:
            return {}
        self.tell(f"in the place of {lead.key}: {', '.join(c.key for _, c, _ in leading)}")
        alone = self.fits([self.request(c.parameters, point) for _, c, point in leading], there)
        placed = [(c, end) for (_, c, _), end in zip(leading, alone, strict=True)]
        race = Race(limit)
        fits = self.fits([self.request((*free, *c.parameters), end.point, race=race) for c, end in placed], there)
        costs = self.costs([end.point for end in fits], floor)
        return better(((c, replace(end, cost=cost)) for (c, _), end, cost in zip(placed, fits, costs, strict=True)), best)

    def scanned(self, c: Candidate, start: Point) -> list[Point]:
        """A start of a candidate of one size with sizes of either sign from the one that it is screened at up."""
        if len(c.size_parameters) > 1 or not c.linear:
            return []
        (p,) = c.size_parameters
        unit, signs = abs(c.starts[0][p.name]), (1.0, -1.0) if p.lower < 0 else (1.0,)
        sizes = [sign * unit * STEP**k for sign in signs for k in range(STEPS)]
        return [{**start, p.name: size} for size in sizes if p.lower < size < p.upper]
