"""Full fits of candidates side by side: who is fitted, who is given up, and what of the other sign of the one that leads."""

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from neuido.discrepancy.fit import Fit, Race
from neuido.discrepancy.floors import Floor
from neuido.discrepancy.problem import Candidate, Parameter
from neuido.discrepancy.starting import Start, Starting
from neuido.discrepancy.trials import score

MANY = 5
"""Parameters above which a candidate is fitted after the others, and not at all where one of those leaves noise alone."""
LEADERS = 4
"""Candidates that are fitted before the others."""
IN_REACH = 4.0
"""Times the lowest cost up to which that of a fit is worth refining: twice its error."""
CLOSELY = 8
"""Quick fits, at the most, that are made once more under the own setting."""
AT_MOST = 6
"""Iterations of these."""

NO_TIME = "there was no time for its fit"
FAR_BEHIND = "by the method that fits best it was not fitted, by the other one the first few fits leave far more"
FEWER_DO = "an effect of fewer parameters leaves nothing but noise"
OTHERS_DO = "another effect leaves nothing but noise, and its direction in the data promises little"


class PutOff(NamedTuple):
    """Candidates whose fits wait until another method was asked, and the fits that were made before them."""

    ended: tuple[tuple[Candidate, Fit], ...]
    starts: tuple[Start, ...]

    @property
    def keys(self) -> list[str]:
        """Of the candidates that wait."""
        return list(dict.fromkeys(c.key for c, *_ in self.starts))


class Contest(NamedTuple):
    """What fits of candidates came to; those that came close ended under the own setting, others may be quick ones (`Fit.setting`)."""

    best: dict[str, tuple[Candidate, Fit]]
    """Of each candidate, by its key."""
    other: tuple[Candidate, Fit] | None
    """The leading candidate's of the other sign."""
    unfitted: dict[str, str]
    """Why a candidate got no fit, by its key."""
    put_off: PutOff | None = None
    """What goes on later."""


def better(fits: Iterable[tuple[Candidate, Fit]], than: Mapping[str, tuple[Candidate, Fit]]) -> dict[str, tuple[Candidate, Fit]]:
    """The fit of least cost of each candidate, by its key, where it beats the one there is."""
    out: dict[str, tuple[Candidate, Fit]] = {}
    for c, fit in fits:
        rival = out.get(c.key) or than.get(c.key)
        if rival is None or fit.cost < rival[1].cost:
            out[c.key] = (c, fit)
    return out


class Contests(Starting):
    """The first fits of a step of a diagnosis."""

    def contest(
        self,
        free: Sequence[Parameter],
        starts: Sequence[Start],
        floor: Floor,
        hopeful: Collection[str] | None = None,
        then: Callable[[Sequence[tuple[Candidate, Fit]]], Sequence[Start]] = lambda led: (),
        beyond: float = math.inf,
        until: float = 1.0,
        between: Callable[[np.ndarray], Iterable[tuple[Candidate, Fit]]] = lambda remains: (),
        puts_off: bool = False,
        before: Sequence[tuple[Candidate, Fit]] = (),
    ) -> Contest:
        """Fit the candidates side by side; fits that cannot catch up with the best one stop.

        Where every point costs, the first of the screening set the pace, and candidates of many parameters come last, if at all. Where the
        first ones leave noise alone, those of the others that are not `hopeful` get no fit, and the rest one each.

        All of it quickly; what came close goes on under the own setting.

        Args:
            free: What is fitted beside a candidate's parameters.
            starts: Of the fits.
            floor: What weighs the residuals.
            hopeful: Keys of candidates that could take something off by the screening; all where absent.
            then: Further starts, given the best fit of each candidate in the order of their costs.
            beyond: Score of the leading one after the first ones beyond which there are no others: another method does far better.
            until: Share of the time for the search at which fits end where they are and no others begin: the rest is for other steps.
            between: Further fits after the first ones, given what the leading one of these leaves, where there are others to come.
            puts_off: Whether the others wait where the first ones leave more than may be noise: it may be the wrong method.
            before: Fits that were made before `starts` were put off (`PutOff.ended`).
        """
        ended = list(before)
        best = better(ended, {})
        unfitted: dict[str, str] = {}
        race = Race(min((fit.cost for _, fit in ended), default=math.inf))

        def fitted(own: Sequence[Start]) -> None:
            requests = []
            for c, begin, J in own:
                sizes = [p.name for p in c.size_parameters] if c.linear else []
                requests.append(self.request((*free, *c.parameters), begin, until=until, race=race, slopes=J, sizes=sizes))
            fits = list(zip((c for c, *_ in own), self.fits(requests, floor), strict=True))
            ended.extend(fits)
            best.update(better(fits, best))

        def left() -> tuple[tuple[Candidate, Fit], np.ndarray]:
            (leading,) = self.wholly(free, [min(best.values(), key=lambda entry: entry[1].cost)], floor, until)
            with self.under(self.own):
                return leading, self.mean_squares([leading[1].point], floor)[0]

        small = [c.key for c, *_ in starts if len(c.parameters) <= MANY]
        first = list(dict.fromkeys(small))[:LEADERS] if not before else []
        waves: list[list[Start]] = [[], [], []]
        for entry in starts:
            key = entry[0].key
            waves[0 if (self.problem.together and beyond == math.inf) or key in first else 1 if key in small else 2].append(entry)
        for i, own in enumerate(waves):
            if best and own and self.deadline.skips(f"fits of {', '.join(dict.fromkeys(c.key for c, *_ in own))}", until):
                unfitted |= {c.key: NO_TIME for wave in waves[i:] for c, *_ in wave}
                break
            leading, remains = left() if own and best else (None, None)
            if remains is not None and i == 1 and (further := better(between(remains), best)):
                best |= further
                race.best = min(race.best, *(fit.cost for _, fit in further.values()))
                leading, remains = left()
            if remains is not None and score(remains) > beyond:
                unfitted = {c.key: FAR_BEHIND for wave in waves[i:] for c, *_ in wave}
                return Contest(*self.closely(free, best, None, floor, until), unfitted)
            if puts_off and remains is not None and not self.may_be_noise(remains):
                waiting = tuple(start for wave in waves[i:] for start in wave)
                unfitted = {c.key: NO_TIME for c, *_ in waiting}
                return Contest({**best, leading[0].key: leading}, None, unfitted, PutOff(tuple(ended), waiting))
            if remains is not None and self.is_noise(remains):
                if own is waves[2]:
                    unfitted |= {c.key: FEWER_DO for c, *_ in own}
                    break
                if hopeful is not None:
                    unfitted |= {c.key: OTHERS_DO for c, *_ in own if c.key not in hopeful}
                    once = {entry[0].key: entry for entry in reversed(own) if entry[0].key in hopeful}
                    own = [entry for entry in own if once.get(entry[0].key) is entry]
            fitted(own)
        if further := then(sorted(best.values(), key=lambda entry: entry[1].cost)):
            fitted(further)
        other = self.other_sign(free, best, ended, floor)
        if other is not None and other[1].cost < best[other[0].key][1].cost:
            best[other[0].key], other = other, best[other[0].key]
        return Contest(*self.closely(free, best, other, floor, until), unfitted)

    def closely(
        self,
        free: Sequence[Parameter],
        best: Mapping[str, tuple[Candidate, Fit]],
        other: tuple[Candidate, Fit] | None,
        floor: Floor,
        until: float,
    ) -> tuple[dict[str, tuple[Candidate, Fit]], tuple[Candidate, Fit] | None]:
        """Quick fits that came close once more under the own setting, from where they ended; the best first, and not all of many."""
        fits = sorted(best.values(), key=lambda entry: entry[1].cost)
        near = [entry for entry in fits if entry[1].cost < IN_REACH * fits[0][1].cost][:CLOSELY]
        ended = self.wholly(free, near if other is None else [*near, other], floor, until)
        again = None if other is None else ended.pop()
        return {**best, **{c.key: (c, fit) for c, fit in ended}}, again

    def wholly(
        self, free: Sequence[Parameter], fits: Sequence[tuple[Candidate, Fit]], floor: Floor, until: float
    ) -> list[tuple[Candidate, Fit]]:
        """Quick fits once more under the own setting, from where they ended; as they are where nothing runs there.

        Without a race: who is in a class is said by where they end.
        """
        if self.setting == self.own:
            return list(fits)
        with self.under(self.own):
            options = {"until": until, "iterations": AT_MOST}
            requests = [self.request((*free, *c.parameters), fit.point, slopes=fit.slopes, **options) for c, fit in fits]
            ends = self.fits(requests, floor)
        return [(c, end if np.isfinite(end.cost) else fit) for (c, fit), end in zip(fits, ends, strict=True)]

    def other_sign(
        self, free: Sequence[Parameter], best: Mapping[str, tuple[Candidate, Fit]], ended: Sequence[tuple[Candidate, Fit]], floor: Floor
    ) -> tuple[Candidate, Fit] | None:
        """The leading candidate's best fit of the other sign, where its signs are apart.

        A stiff end of a body is much like a soft rest of it, and the one that comes down faster has the other given up: it goes on alone.
        """
        if not best:
            return None
        lead, first = min(best.values(), key=lambda entry: entry[1].cost)
        beyond = [fit for c, fit in ended if lead.apart and c.key == lead.key and fit.point[lead.apart] * first.point[lead.apart] < 0]
        if not beyond:
            return None
        fit = min(beyond, key=lambda fit: fit.cost)
        if not fit.converged and np.isfinite(fit.cost):
            (fit,) = self.fits([self.request((*free, *lead.parameters), fit.point)], floor)
        return lead, fit
