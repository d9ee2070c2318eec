"""One step of a diagnosis: screen every candidate, fit the best, and test the best one's gain against chance and floors.

The order is that of protocols for model discrepancy: the base fit with its nuisances; the discretisation error from several settings;
every candidate's direction in the data and its gain once the declared parameters are refitted; full fits of the best; the gain on
recordings that were held out against a parametric bootstrap of the largest gain.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from neuido.discrepancy import evidence
from neuido.discrepancy.fit import Fit, Race, Request, levenberg_marquardt, run
from neuido.discrepancy.floors import Floor, Part, over_time, split
from neuido.discrepancy.memo import Memo
from neuido.discrepancy.problem import Candidate, Parameter, Point, Problem
from neuido.discrepancy.trials import Round, Start, Trial, times_over, unphysical

ALPHA = 0.05
"""Family-wise level of a named effect."""
CLASS_RATIO = 1.4
"""Candidates whose errors are within this factor of the best one's are not told from it."""
LEAST_GAIN = math.log(1.7)
"""Smaller gains are no reason to name anything: other solvers differ by as much in ways that no setting of one solver shows."""
LEAST_GAIN_EXACT = math.log(1.15)
"""The same where nothing is discretised."""
GAIN_IN_FLOOR = math.log(4.0)
"""What it takes where the residual is no larger than the floor: only an effect that the data show far below it."""
NOISE_ALONE = 1.8
"""Mean squares up to so many times that of the noise are noise."""
ROUGH = 0.02
"""Relative gain that ends the fit before the floors are known."""
SMALL = 2
"""Parameters up to which a candidate gets a fit in the first round whatever its place in the screening: a direction says little of what a
yield stress or a lossy floor does once it acts."""
VAIN = 0.98
"""Share of the misfit that even such a candidate may leave, as the screening predicts it, if small sizes of it act in proportion."""
MANY = 5
"""Parameters above which a candidate is fitted after the others, and not at all where one of those leaves noise alone."""
HOPELESS = 0.75
"""Share of the misfit that a candidate beyond the first few may leave, as the screening predicts it, and still get a fit."""
OWN = 3
"""Candidates that the screening of a second solver may add to those that led with the first one."""
LEADERS = 4
"""Candidates that are fitted before the others."""
SOME_GAIN = math.log(1.2)
"""Smaller gains are no reason to look further."""
FAR = 6.0
"""Times the size that a candidate is screened at, for a fit from elsewhere."""
WITHIN = 0.5
"""Share of the floor within which a residual that no effect explains is no reason to look further."""
POLISHED = 3
"""Candidates whose fits are refined from further starts."""

Tell = Callable[[str], None]


class Inference:
    """The steps of a diagnosis on one problem.

    Args:
        problem: What to diagnose.
        setting: Setting of the discretisation that predicts; the others tell its error.
        keep: Candidates that get a full fit by their place in the screening, at the least; in the first round all small ones do beside.
        draws: Of the bootstrap.
        seed: Of the draws.
        tell: Called with a line of progress.
        memo: Predictions that are shared with the inferences of other settings.
    """

    def __init__(
        self,
        problem: Problem,
        *,
        setting: int = 0,
        keep: int = 7,
        draws: int = 199,
        seed: int = 0,
        tell: Tell | None = None,
        memo: Memo | None = None,
    ) -> None:
        self.problem, self.setting, self.keep, self.draws, self.seed = problem, setting, keep, draws, seed
        self.tell = tell or (lambda line: None)
        self.memo = memo or Memo(problem)
        self.parts = split(problem)
        self.fitted = [p.fitted for p in self.parts]
        self.fitted_recordings = list(dict.fromkeys(p.recording for p in self.parts if p.fitted))
        self.noise_squares = np.array([self.noise_of(p.recording) ** 2 for p in self.parts])
        """Mean squares of the noise of each part."""

    # Fits.

    def fits(
        self, requests: Sequence, floor: Floor, *, to: Sequence[Mapping[int, np.ndarray]] | None = None, step: str = "fits"
    ) -> list[Fit]:
        """Run fits side by side, to the data or each to motions in their place; their work counts as that of `step`."""

        def tick(count: int) -> None:
            self.tell(f"{self.memo.simulations} simulations")

        with self.memo.during(step):
            whiten, rows = floor.whitener(self.parts), self.fitted_recordings
            return run(self.memo, requests, whiten, rows, setting=self.setting, data=to, tick=tick)

    def mean_squares(self, points: Sequence[Point], floor: Floor) -> list[np.ndarray]:
        """Of each part, at several points, the nuisances at their most probable values."""
        found = np.full((len(points), len(self.parts)), np.inf)
        for n in dict.fromkeys(p.recording for p in self.parts):
            with self.memo.during("errors of fits"):
                rows = self.memo.predict(points, n, self.setting) - self.problem.recordings[n].y
            for j, part in enumerate(self.parts):
                if part.recording == n:
                    for i, row in enumerate(rows):
                        if np.isfinite(row).all():
                            found[i, j] = np.mean(floor.settle(row, part)[part.rows] ** 2)
        return list(found)

    def noise(self) -> Floor:
        """The floor without any discretisation error."""
        noise = {n: self.noise_of(n) for n in range(len(self.problem.recordings))}
        ones = {n: np.ones(len(r.y)) for n, r in enumerate(self.problem.recordings)}
        return Floor(
            noise,
            {n: ones[n] / noise[n] for n in noise},
            {n: np.empty((len(ones[n]), 0)) for n in noise},
            {n: 0.0 * ones[n] for n in noise},
        )

    def noise_of(self, n: int) -> float:
        r = self.problem.recordings[n]
        return r.noise if r.noise else max(1e-3 * float(np.std(r.y)), 1e-12)

    def floor(self, point: Point) -> Floor:
        """Noise and discretisation at a point: differences of the settings, and how large they are in the course of time."""
        plain = self.noise()
        others = [s for s in range(self.problem.settings) if s != self.setting]
        if not others:
            return replace(plain, nuisances=self.nuisances(point, list(plain.noise)))
        differences, spread, weight = {}, {}, {}
        for n in plain.noise:
            with self.memo.during("discretisation"):
                here = self.memo.predict([point], n, self.setting)[0]
                there = [self.memo.predict([point], n, s)[0] for s in others]
            D = np.stack([t - here for t in there if np.isfinite(t).all()] or [np.zeros_like(here)], axis=1)
            differences[n] = D
            spread[n] = over_time(np.sqrt(np.mean(D**2, axis=1)), self.problem.recordings[n].times)
            weight[n] = 1.0 / np.sqrt(plain.noise[n] ** 2 + spread[n] ** 2)
            self.tell(f"discretisation of {self.problem.recordings[n].name}")
        return Floor(plain.noise, weight, differences, spread, self.nuisances(point, list(plain.noise)))

    def request(self, parameters: Sequence[Parameter], start: Point, **options: Any) -> Request:
        """A fit; options of `levenberg_marquardt`."""
        return levenberg_marquardt(parameters, start, together=self.problem.together, **options)

    def base(self, starts: Sequence[Point], floor: Floor, **options: Any) -> Fit:
        """The declared parameters fitted from several starts; the best one after a few iterations goes on, with options of the fit."""
        free = self.problem.declared
        if len(starts) > 1:
            short = self.fits([self.request(free, s, iterations=3) for s in starts], floor)
            starts = [min(short, key=lambda f: f.cost).point]
        return self.fits([self.request(free, starts[0], **options)], floor)[0]

    def starts(self, point: Point) -> list[Point]:
        """A point, and half and twice each parameter whose logarithm is fitted."""
        out = [dict(point)]
        for p in self.problem.declared:
            if p.log:
                value = point.get(p.name, p.value)
                out += [dict(point) | {p.name: min(max(value * f, p.lower), p.upper)} for f in (0.5, 2.0)]
        return out

    def start(self, near: Point | None = None) -> Start | None:
        """The base fit, with what noise and discretisation do to it; from about the declared values, or from them and from `near`.

        None: given `near`, the fit ends where not every recording can be predicted.
        """
        # the first fit only says where the floor is to be found
        fit = self.base([{}, near] if near else self.starts({}), self.noise(), iterations=6, tolerance=ROUGH)
        if near is not None and not self.runs(fit.point):
            return None
        floor = self.floor(fit.point)
        fit = self.base([fit.point], floor)
        return Start(fit, floor, self.mean_squares([fit.point], floor)[0])

    def runs(self, point: Point) -> bool:
        """Whether every recording can be predicted there: finite elements tangle where sand flows, and now and then elsewhere."""
        return all(bool(np.isfinite(self.memo.predict([point], p.recording, self.setting)).all()) for p in self.parts)

    def is_noise(self, errors: np.ndarray) -> bool:
        """Whether nothing but noise is left in any part."""
        return bool(np.all(errors < NOISE_ALONE * self.noise_squares))

    def is_settled(self, errors: np.ndarray) -> bool:
        """Whether no effect could be named any more: nothing is left but noise, or too little above it for any gain to be enough."""
        hopeless = self.problem.settings > 1 and evidence.gain(errors, self.noise_squares, self.fitted) < LEAST_GAIN
        return hopeless or self.is_noise(errors)

    # Screening.

    def columns(
        self, point: Point, candidates: Sequence[Candidate], recordings: Sequence[int]
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
        for n in recordings:
            with self.memo.during("screening"):
                here, *rows = self.memo.predict([point, *asked], n, self.setting)
            self.tell(f"directions of {len(asked)} effects in {self.problem.recordings[n].name}")
            for place in out:
                out[place][n] = np.stack([row - here for row, p in zip(rows, places, strict=True) if p == place], axis=1)
        return out

    def slopes(self, parameters: Sequence[Parameter], point: Point, recordings: Sequence[int], step: float = 0.3) -> dict[int, np.ndarray]:
        """Derivatives of the data by coordinates of parameters, one typical step each; central where the range allows."""
        out = {}
        asked, spans = [], []
        for p in parameters:
            q = p.coordinate(point.get(p.name, p.value))
            ends = [p.physical(q + step), p.physical(q - step)]
            asked += [dict(point) | {p.name: end} for end in ends]
            spans.append(max(p.coordinate(ends[0]) - p.coordinate(ends[1]), 1e-9))
        for n in recordings:
            with self.memo.during("slopes"):
                rows = self.memo.predict(asked, n, self.setting)
            parts = [(rows[2 * i] - rows[2 * i + 1]) / span for i, span in enumerate(spans)]
            out[n] = np.stack([np.where(np.isfinite(part), part, 0.0) for part in parts], axis=1) if parts else np.empty((rows.shape[1], 0))
        return out

    def screen(self, point: Point, candidates: Sequence[Candidate], floor: Floor, slopes: Mapping[int, np.ndarray]):
        """Starts of full fits, best first: (predicted share of the misfit that stays, candidate, start, point), and the directions."""
        fits = [p for p in self.parts if p.fitted]
        columns = self.columns(point, candidates, [p.recording for p in fits])
        residual = np.concatenate([self.weighted(floor.settle(self.residual(point, p.recording), p), p, floor) for p in fits])
        J = np.concatenate([self.weighted(slopes[p.recording], p, floor) for p in fits])
        q, _ = np.linalg.qr(J) if J.shape[1] else (np.empty((len(residual), 0)), None)
        left = residual - q @ (q.T @ residual)
        ranked = []
        for c in candidates:
            for i, start in enumerate(c.starts):
                A = np.concatenate([self.weighted(columns[c.key, i][p.recording], p, floor) for p in fits])
                if not np.isfinite(A).all():
                    continue
                B = A - q @ (q.T @ A)
                amount = -np.linalg.lstsq(B, left, rcond=1e-6)[0]
                sizes = c.size_parameters
                if not c.linear:
                    amount = np.clip(amount, 0.0, 1.5)
                for k, p in enumerate(sizes):
                    low, high = (p.lower / start[p.name], p.upper / start[p.name])
                    amount[k] = np.clip(amount[k], min(low, high), max(low, high))
                stays = float(np.sum((left + B @ amount) ** 2) / max(np.sum(left**2), 1e-300))
                if c.linear:
                    factor = np.clip(amount, -4.0, 4.0)
                    factor = np.where(np.abs(factor) < 0.2, np.where(factor < 0, -0.2, 0.2), factor)
                else:
                    factor = np.ones(len(sizes))
                begin = dict(point) | dict(start)
                for p, f in zip(sizes, factor, strict=True):
                    begin[p.name] = min(max(start[p.name] * f, p.lower), p.upper)
                ranked.append((stays, c, i, begin))
        ranked.sort(key=lambda entry: entry[0])
        return ranked, columns

    def residual(self, point: Point, n: int) -> np.ndarray:
        return self.memo.predict([point], n, self.setting)[0] - self.problem.recordings[n].y

    def weighted(self, columns: np.ndarray, part: Part, floor: Floor) -> np.ndarray:
        w = floor.weight[part.recording][part.rows]
        return columns[part.rows] * (w[:, None] if columns.ndim == 2 else w)

    # One round.

    def round(
        self, base: Fit, floor: Floor, found: Sequence[Trial], leaders: Sequence[str] | None = None, *, most: float = math.inf
    ) -> Round:
        """Look for one more effect beside those that were found.

        Args:
            base: Where the model stands.
            floor: Noise and discretisation there.
            found: The effects so far.
            leaders: Keys of the candidates that led with another solver, where it named one: they and the first of the screening get a fit.
            most: Parameters that a candidate may have.
        """
        taken = {t.candidate.name for t in found}
        extra = tuple(p for t in found for p in t.candidate.parameters)
        candidates = [c for c in self.problem.candidates if c.name not in taken and len(c.parameters) <= most]
        errors = self.mean_squares([base.point], floor)[0]
        free = (*self.problem.declared, *extra)
        everywhere = list(dict.fromkeys(p.recording for p in self.parts))
        slopes = self.slopes(free, base.point, everywhere)
        ranked, columns = self.screen(base.point, candidates, floor, slopes)
        chosen: dict[str, int] = {}
        starts = []
        # what many parameters could fit says little of how near the others are
        near = min(2.0 * min((stays for stays, c, *_ in ranked if len(c.parameters) <= MANY), default=0.0), HOPELESS)
        keep = self.keep if leaders is None else min(self.keep, OWN)
        first = leaders is None and not found
        for stays, c, i, begin in ranked:
            led = leaders is not None and c.key in leaders
            small = first and len(c.parameters) <= SMALL and (stays < VAIN or not c.linear)
            if c.key not in chosen and (keep > 0 or led or small or (leaders is None and stays < near)):
                keep -= not small
                chosen[c.key] = i
                starts.append((c, begin, self._first_slopes(c, i, free, slopes, columns, floor)))
                if not c.linear:
                    starts.append((c, begin | {p.name: p.value for p in self.problem.declared}, None))
            elif not c.linear and c.key in chosen and sum(s[0].key == c.key for s in starts) < 3:
                starts.append((c, begin, None))
        self.tell(f"fitting {', '.join(chosen)}")
        best = self.contest(free, starts, floor)
        best |= self.polish(free, best, base, floor)
        model = self._linear(base.point, floor, slopes, columns, chosen, everywhere, candidates)
        empty = Round(base.point, errors, [], None, [], 1.0, floor, self.floors(base.point, free, floor), null=model.null(self.draws))
        result = self.judge(empty, best, model, list(chosen))
        if first and result.chosen is None and result.over > WITHIN and any(t.gain > self.by_chance(result) for t in result.trials):
            best |= self.elsewhere(best, {key: c.starts[i] for c in candidates for key, i in chosen.items() if c.key == key}, floor)
            result = self.judge(empty, best, model, list(chosen))
        return result

    def judge(self, empty: Round, best: Mapping[str, tuple[Candidate, Fit]], model: evidence.LinearModel, asked: Sequence[str]) -> Round:
        """A round with the trials that fits make, and what is chosen of them; `asked` are the keys that were to be fitted."""
        errors = empty.errors
        squares = self.mean_squares([fit.point for _, fit in best.values()], empty.floor)
        trials = []
        for (c, fit), square in zip(best.values(), squares, strict=True):
            trial = Trial(c, fit, square, evidence.gain(errors, square, self.fitted))
            trial.reason = unphysical(c, fit.point)
            trials.append(trial)
        trials.sort(key=lambda t: t.score)
        good = [t for t in trials if not t.reason]
        top = min(good, key=lambda t: t.penalised) if good else None
        p = float((1 + np.sum(empty.null >= top.gain)) / (1 + len(empty.null))) if top else 1.0
        result = replace(empty, trials=trials, p_value=p, cosines={}, needless=[key for key in asked if key not in best])
        if top is None:
            return result
        for t in trials:
            if t.candidate.key in model.keys and top.candidate.key in model.keys:
                result.cosines[t.candidate.key] = model.cosine(t.candidate.key, top.candidate.key)
        if p <= ALPHA and top.gain > self.least_gain(errors, result.floors, top.errors):
            result.chosen = top
            result.members = [t for t in good if self.is_rival(t, top)]
        for t in trials:
            if not t.reason and t not in result.members:
                t.reason = self._why(t, top, result)
        return result

    def floors(self, point: Point, free: Sequence[Parameter], floor: Floor) -> np.ndarray:
        """Noise, and what a refit leaves of the discretisation error, together as mean squares of the parts.

        The motions under the other settings of the same method are fitted as if they had been measured: most of what a grid or a step does
        a stiffness can do as well, so that their differences as they are would hide effects several times larger than what matters.
        """
        everywhere = list(floor.noise)
        with self.memo.during("discretisation"):
            made = [{n: self.memo.predict([point], n, s)[0] for n in everywhere} for s in self.problem.refinements(self.setting)]
        made = [y for y in made if all(np.isfinite(row).all() for row in y.values())]
        if not made:
            return self.noise_squares
        requests = [self.request(free, point, iterations=8, tolerance=ROUGH) for _ in made]
        fits = self.fits(requests, floor, to=made, step="discretisation")
        with self.memo.during("discretisation"):
            seen = {n: self.memo.predict([fit.point for fit in fits], n, self.setting) for n in everywhere}
        left = [
            [np.mean(floor.settle(row - y[p.recording], p)[p.rows] ** 2) for row, y in zip(seen[p.recording], made, strict=True)]
            for p in self.parts
        ]
        return self.noise_squares + np.nanmean(left, axis=1)

    def least_gain(self, errors: np.ndarray, floors: np.ndarray, left: np.ndarray) -> float:
        """The gain that an effect must bring, from the residual over the floor and what it leaves, all as mean squares of the parts."""
        if self.problem.settings == 1:  # nothing is discretised: only chance is to be beaten
            return LEAST_GAIN_EXACT
        if self.is_noise(left):  # whatever the floor, no error of the discretisation is in there
            return LEAST_GAIN
        share = min(max(math.log(times_over(errors, floors)) / math.log(1.5), 0.0), 1.0)  # from the floor itself to half as much again
        return GAIN_IN_FLOOR + share * (LEAST_GAIN - GAIN_IN_FLOOR)

    def _first_slopes(
        self,
        c: Candidate,
        start: int,
        free: Sequence[Parameter],
        slopes: Mapping[int, np.ndarray],
        columns: Mapping[tuple[str, int], Mapping[int, np.ndarray]],
        floor: Floor,
    ) -> np.ndarray | None:
        """What the screening says of the slopes of a candidate's fit; none where it probed only sizes, or they do not act in proportion."""
        if not c.linear or c.size_parameters != c.parameters or any(p.log for p in c.parameters):
            return None
        whiten, coordinates = floor.whitener(self.parts), [p.coordinate(c.starts[start][p.name]) for p in c.parameters]
        parts = []
        for n in dict.fromkeys(p.recording for p in self.parts if p.fitted):
            both = (*slopes[n].T, *(columns[c.key, start][n] / coordinates).T)
            parts.append(np.stack([whiten(column, n) for column in both], axis=1))
        J = np.concatenate(parts)
        return J if np.isfinite(J).all() else None

    def contest(
        self, free: Sequence[Parameter], starts: Sequence[tuple[Candidate, Point, np.ndarray | None]], floor: Floor
    ) -> dict[str, tuple[Candidate, Fit]]:
        """The best fit of each candidate; fits that cannot catch up with the best one stop.

        Where every point costs, the first of the screening set the pace, and candidates of many parameters come last, if at all.
        """
        best: dict[str, tuple[Candidate, Fit]] = {}
        race = Race()
        small = [c.key for c, *_ in starts if len(c.parameters) <= MANY]
        first = list(dict.fromkeys(small))[:LEADERS]
        waves: list[list[tuple[Candidate, Point, np.ndarray | None]]] = [[], [], []]
        for entry in starts:
            key = entry[0].key
            waves[0 if self.problem.together or key in first else 1 if key in small else 2].append(entry)
        for own in waves:
            if own is waves[2] and best:
                leading = min((fit for _, fit in best.values()), key=lambda fit: fit.cost)
                if self.is_noise(self.mean_squares([leading.point], floor)[0]):
                    break
            fits = self.fits([self.request((*free, *c.parameters), begin, race=race, slopes=J) for c, begin, J in own], floor)
            for (c, *_), fit in zip(own, fits, strict=True):
                if c.key not in best or fit.cost < best[c.key][1].cost:
                    best[c.key] = (c, fit)
        return best

    def polish(
        self, free: Sequence[Parameter], best: Mapping[str, tuple[Candidate, Fit]], base: Fit, floor: Floor
    ) -> dict[str, tuple[Candidate, Fit]]:
        """The best fits once more, from where they ended and from the declared values: the base fit may have led all of them astray."""
        data = sum(len(p.rows) for p in self.parts if p.fitted)
        top = sorted(best.values(), key=lambda entry: entry[1].cost)[:POLISHED]
        if not top or top[0][1].cost < 1.2 * data or top[0][1].cost > 0.7 * base.cost:
            return {}
        requests, of, race = [], [], Race(top[0][1].cost)
        for c, fit in top:
            begin = dict(fit.point)
            for start in (begin, begin | {p.name: p.value for p in self.problem.declared}):
                requests.append(self.request((*free, *c.parameters), start, race=race))
                of.append((c, fit))
        self.tell(f"refining {', '.join(c.key for c, _ in top)}")
        out: dict[str, tuple[Candidate, Fit]] = {}
        for (c, before), fit in zip(of, self.fits(requests, floor), strict=True):
            least = out[c.key][1].cost if c.key in out else before.cost
            if fit.cost < least:
                out[c.key] = (c, fit)
        return out

    def by_chance(self, r: Round) -> float:
        """Gain up to which an effect is not worth another look, be it alone or with a second one."""
        return max(float(np.quantile(r.null, 1 - ALPHA)) if len(r.null) else 0.0, SOME_GAIN)

    def elsewhere(
        self, best: Mapping[str, tuple[Candidate, Fit]], starts: Mapping[str, Mapping[str, float]], floor: Floor
    ) -> dict[str, tuple[Candidate, Fit]]:
        """Fits of one size once more, from the declared values and a larger size: the slope at zero may have led into a side valley."""
        requests, of, race = [], [], Race(min(fit.cost for _, fit in best.values()))
        for key, (c, fit) in best.items():
            if not c.linear or len(c.size_parameters) > 1 or len(c.parameters) > SMALL:
                continue
            (p,) = c.size_parameters
            size = math.copysign(FAR * abs(starts[key][p.name]), fit.point[p.name])
            begin = dict(fit.point) | {d.name: d.value for d in self.problem.declared} | {p.name: min(max(size, p.lower), p.upper)}
            requests.append(self.request((*self.problem.declared, *c.parameters), begin, race=race))
            of.append(c)
        self.tell(f"again from elsewhere: {', '.join(c.key for c in of)}")
        fits = zip(of, self.fits(requests, floor), strict=True)
        return {c.key: (c, fit) for c, fit in fits if fit.cost < best[c.key][1].cost}

    def is_rival(self, t: Trial, top: Trial) -> bool:
        """Whether the data cannot tell `t` from the best one: about its errors, a gain of its own, and not by many more parameters."""
        more = len(t.candidate.size_parameters) - len(top.candidate.size_parameters)
        if more >= 3 and t.score > top.score - 0.1:
            return t is top
        return t is top or (t.score - top.score < 2.0 * math.log(CLASS_RATIO) and t.gain > 0.4 * top.gain)

    def _why(self, t: Trial, top: Trial, result: Round) -> str:
        if result.chosen is None:
            at_least = max(float(np.quantile(result.null, 1 - ALPHA)), self.least_gain(result.errors, result.floors, t.errors))
            return f"lowers the error {math.exp(t.gain):.2f}-fold; with nuisances and discretisation it takes {math.exp(at_least):.2f}-fold"
        return f"leaves {math.exp(0.5 * (t.score - top.score)):.1f} times the error of {top.candidate.name}"

    def _linear(self, point, floor, slopes, columns, chosen, everywhere, candidates) -> evidence.LinearModel:
        held = [p.recording for p in self.parts if not p.fitted]
        by_key = {c.key: c for c in candidates}
        best = {c.key: 0 for c in candidates} | chosen
        one = [replace(by_key[key], starts=(by_key[key].starts[i],)) for key, i in best.items()]
        new = [n for n in held if n not in [p.recording for p in self.parts if p.fitted]]
        there = self.columns(point, one, new) if new else {}
        nuisances = floor.nuisances or {n: np.empty((len(self.problem.recordings[n].y), 0)) for n in everywhere}
        made = []
        for part in self.parts:
            n, rows = part.recording, part.rows
            own = {}
            for key, i in best.items():
                c = columns[key, i][n] if n in columns[key, i] else there[key, 0][n]
                if np.isfinite(c).all():
                    own[key] = c[rows]
            scale = floor.spread[n][rows]
            smooth = 0.5 * scale[:, None] * self.problem.directions(n)[rows]
            settings = floor.differences[n][rows]
            made.append(evidence.Columns(floor.weight[n][rows], floor.noise[n], slopes[n][rows], nuisances[n][rows], settings, smooth, own))
        common = set.intersection(*(set(c.candidates) for c in made))
        made = [replace(c, candidates={k: v for k, v in c.candidates.items() if k in common}) for c in made]
        return evidence.LinearModel([c for c, p in zip(made, self.parts, strict=True) if p.fitted],
                                    [c for c, p in zip(made, self.parts, strict=True) if not p.fitted], seed=self.seed)  # fmt: skip

    def nuisances(self, point: Point, recordings: Sequence[int]) -> dict[int, np.ndarray]:
        """Directions of the nuisances of each recording, of one prior standard deviation."""
        out = {}
        for n in recordings:
            name = self.problem.recordings[n].name
            own = [p for p in self.problem.nuisances if p.prior is not None and p.name.endswith(f":{name}")]
            moved = [dict(point) | {p.name: p.physical(p.coordinate(point.get(p.name, p.value)) + p.prior)} for p in own]
            with self.memo.during("nuisances"):
                rows = self.memo.predict([point, *moved], n, self.setting)
            out[n] = (
                np.stack([np.where(np.isfinite(row).all(), row - rows[0], 0.0) for row in rows[1:]], axis=1)
                if own
                else np.empty((rows.shape[1], 0))
            )
        return out
