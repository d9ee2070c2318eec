"""Which candidates a round fits, and which floor it weighs their gain against."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import t as student

from neuido.discrepancy.inference import comparing, directions, discretisation
from neuido.discrepancy.inference.comparing import LEAST_GAIN
from neuido.discrepancy.inference.floors import Round, Stand, Trial, score, unphysical
from neuido.discrepancy.inference.laboratory import Laboratory
from neuido.discrepancy.inference.least_squares import Fit, Race, levenberg_marquardt, run
from neuido.discrepancy.inference.search import (
    attribution,
    base_fits,
    choosing,
    contests,
    judging,
    next_effect,
    pairs,
    prospects,
    refining,
    search_state,
    stand_ins,
)
from neuido.discrepancy.inference.search.attribution import diagnose, drop
from neuido.discrepancy.inference.search.intervals import intervals
from neuido.discrepancy.inference.search.judging import ABOVE, BACK_GAIN, FORETELLS, GAIN_AT_FLOOR, GAIN_IN_FLOOR, GAIN_TO_NOISE, WITHIN
from neuido.discrepancy.inference.search.search_state import Look, Promising
from neuido.discrepancy.problems.problem import Candidate, Parameter, Problem, Recording
from neuido.discrepancy.report.answer import trace
from neuido.discrepancy.report.answer_content import rejected
from neuido.discrepancy.store import Budget

T = np.linspace(0.0, 1.0, 120)
NOISE = 0.01
WAVES = 3
WAVE = np.array([[np.sin((k + 1 + 0.3 * n) * T) for k in range(8)] for n in range(WAVES)])
SIZES = [[f"wave{n}.c{k}" for k in range(8)] for n in range(WAVES)]
SQUARE, CUBE = T**2, T**3


class Line(Problem):
    """y = a t, and what a candidate adds: a clip at `1 / inverse` (nothing near zero says where it will act), waves, a bend.

    Setting 1 has another slope, which `a` makes good, and a wiggle, which nothing does. `turns`: the wiggle's phase goes with `a`, so that
    the difference of the settings at one place says nothing of it at another.
    """

    def __init__(self, y, *, wiggle: float = 0.02, solvers: tuple[int, ...] = (0,), together: bool = False, turns: bool = False) -> None:
        def bent(name):
            return Candidate(name, (Parameter(f"{name}.c", "1", 0.0, 0.3, -5.0, 5.0),), ({f"{name}.c": 0.3},), "flight")

        clip = Parameter("clip.inverse", "1", 0.0, 0.3, 1e-3, 10.0, log=True)
        candidates = [bent("square"), bent("cube")]
        for n in range(WAVES):
            sizes = tuple(Parameter(f"wave{n}.c{k}", "1", 0.0, 0.1, -5.0, 5.0) for k in range(8))
            candidates.append(Candidate(f"wave{n}", sizes, ({p.name: 0.1 for p in sizes},), "flight"))
        starts = {"clip.inverse": 0.05}, {"clip.inverse": 0.5}  # nothing is clipped at the first
        candidates.append(Candidate("clip", (clip,), starts, "rest", sizes=("clip.inverse",), linear=False))
        rng = np.random.default_rng(0)
        recordings = tuple(
            Recording(name, role, y(T) + NOISE * rng.normal(size=len(T)), NOISE, np.zeros(len(T), int), T)
            for name, role in (("one", "fit"), ("two", "held_out"))
        )
        declared = (Parameter("a", "1", 1.0, 0.3, -20.0, 20.0),)
        super().__init__("line", "rmse", "1", declared, (), tuple(candidates), recordings, settings=2, solvers=solvers)
        self.__dict__ |= {"_together": together, "_wiggle": wiggle, "_turns": turns}

    @property
    def together(self):
        return self._together

    def predict(self, points, recording, setting=0):
        out = []
        for p in points:
            y = (p.get("a", 1.0) + 2.0 * setting) * T
            if setting:
                phase = 3.0 * p.get("a", 1.0) if self._turns else 0.0
                y = y + self._wiggle * setting * np.sin(40 * T + phase)
            for names, wave in zip(SIZES, WAVE):
                if sizes := [(size, row) for name, row in zip(names, wave) if (size := p.get(name, 0.0))]:
                    y = y + sum(size * row for size, row in sizes)
            for name, power in (("square.c", SQUARE), ("cube.c", CUBE)):
                if size := p.get(name, 0.0):
                    y = y + size * power
            out.append(np.minimum(y, 1.0 / p["clip.inverse"]) if p.get("clip.inverse") else y)
        return np.stack(out)


def clipped(t):
    return np.minimum(3.0 * t, 1.6)


class Method:
    """A method of prediction as `first_rounds` asks it: nothing that it leaves is noise alone, and each of its rounds is `result`."""

    problem = SimpleNamespace(together=True)

    def __init__(self, result=None):
        self.result, self.budget, self.asked, self.seen, self.lab = result, Budget(), None, None, self

    def is_noise(self, errors):
        return False

    def first_look(self, fit, floor, led=None, beyond=np.inf, until=1.0, grows=True):
        return SimpleNamespace(least=[])

    def gain(self, before, after):
        return 0.5 * float(np.log(before.mean() / after.mean()))

    def over_floor(self, at):
        return 0.5

    def find(self, *_):
        return self.result

    def leaves_much(self, errors):
        return True

    def floors(self, point, free, floor):
        return np.full(2, 1e-4)


@pytest.fixture
def scripted(monkeypatch):
    """What is asked of a `Method` is what that answers, in the place of fits."""
    asked = {
        "is_noise": comparing,
        "gain": comparing,
        "leaves_much": refining,
        "over_floor": next_effect,
        "first_look": next_effect,
        "find": next_effect,
        "floors": discretisation,
    }

    def answering(name, real):
        return lambda of, *given, **options: getattr(of, name)(*given, **options) if isinstance(of, Method) else real(of, *given, **options)

    for name, module in asked.items():
        monkeypatch.setattr(module, name, answering(name, getattr(module, name)))


def stood(errors, point=None):
    """Where a fit stands that leaves these errors of two recordings."""
    point = point or {"a": 1.0}
    return Stand(Fit(point, tuple(point), 1.0, np.zeros(1), 1, True), None, np.broadcast_to(errors, 2) ** 2.0)


def first_round(error, named, base=1.0):
    """A round with one trial, which leaves `error` and is named or not."""
    t = Trial(Line(clipped).candidates[0], stood(error, {"a": 1.0, "square.c": 1.0}), 1.0, "" if named else "it gains too little")
    return Round({}, np.full(2, base**2), [t], t if named else None, [t] if named else [], 0.01, None, np.full(2, 1e-4))


@pytest.mark.parametrize("together", [True, False])
def test_a_small_candidate_that_the_screening_passes_over_is_fitted(together, monkeypatch):
    found = diagnose(Line(clipped, together=together), keep=1)
    assert [t.candidate.name for t in found.effects] == ["clip"]
    assert 1.0 / found.after["clip.inverse"] == pytest.approx(1.6, abs=0.02)
    monkeypatch.setattr(prospects, "SMALL", 0)
    with monkeypatch.context() as without:
        without.setattr(stand_ins, "candidates_in_place", lambda *_: {})
        assert "clip" not in [t.candidate.name for t in diagnose(Line(clipped, together=together), keep=1).rounds[0].trials]
    # where another one ends it is found all the same
    assert [t.candidate.name for t in diagnose(Line(clipped, together=together), keep=1).effects] == ["clip"]


def test_many_parameters_are_not_fitted_where_one_leaves_noise_alone():
    found = diagnose(Line(clipped), keep=6)
    asked, fitted = set(found.rounds[0].unfitted), {t.candidate.key for t in found.rounds[0].trials}
    assert asked and asked <= {"wave0", "wave1", "wave2"}
    assert not asked & fitted
    reasons = {r["name"]: r["reason"] for r in rejected(found)}
    assert all("fewer parameters" in reasons[name] for name in asked)
    # where none does, they are
    other = diagnose(Line(lambda t: t + 0.3 * np.sin(9 * t)), keep=6)
    assert not other.rounds[0].unfitted
    assert any(t.candidate.key.startswith("wave") for t in other.rounds[0].trials)


def test_the_floor_is_what_a_refit_leaves():
    search = next_effect.new_search(Line(lambda t: 3.0 * t))
    start = base_fits.base_fit(search)
    as_they_are = np.sqrt(np.mean(start.floor.spread[0] ** 2))
    assert as_they_are > 1.0  # a slope of 2
    floors = discretisation.floors(search.lab, start.fit.point, search.lab.problem.declared, start.floor)
    assert floors == pytest.approx(NOISE**2 + 0.02**2 / 2, rel=0.2)
    # and the gain that it takes goes by that
    trial = SimpleNamespace(errors=floors, fit=start.fit)
    small, large = (
        judging.least_gain(search.lab, choosing.unsearched(replace(start, errors=k * floors), floors), trial) for k in (0.2, 4.0)
    )
    assert (small, large) == (GAIN_IN_FLOOR, LEAST_GAIN)


def test_what_brings_the_declared_values_back_need_not_pass_the_floor():
    search = next_effect.new_search(Line(lambda t: 3.0 * t))
    start = base_fits.base_fit(search)
    young = Parameter("young", "Pa", 1e5, 1.0, 1e3, 1e7, log=True)
    search.lab.problem.__dict__["declared"] = (young,)

    def takes(base, there, over=0.8):
        r = choosing.unsearched(replace(start, errors=np.full(2, 100.0) * NOISE**2), np.full(2, 100.0) * (NOISE / over) ** 2)
        trial = SimpleNamespace(errors=np.full(2, 9.0) * NOISE**2, fit=SimpleNamespace(point={"young": there}))
        return judging.least_gain(search.lab, replace(r, base={"young": base}), trial)

    assert takes(5e5, 8e4) == takes(2e4, 1.3e5) == LEAST_GAIN
    assert takes(5e5, 2e5) == takes(2e5, 1e5) > GAIN_AT_FLOOR
    assert takes(5e5, 8e4, over=1.2) == BACK_GAIN, "above the floor it is an effect, and says which"
    assert takes(5e5, 2e5, over=1.1) == GAIN_TO_NOISE < takes(2e5, 1e5, over=1.1), "or that it is one"
    assert takes(5e5, 8e4, over=0.4) == GAIN_IN_FLOOR, "well within it grids lead as far away"


def test_what_does_all_that_it_can_at_a_bound_is_physical():
    rate = Parameter("rate", "1/s", 1.0, 1.0, 1e-3, 1e5, log=True)
    candidate = Candidate("restitution", (rate,), ({"rate": 1e2},), "contact")
    dead = Candidate("restitution", (replace(rate, saturates=True),), ({"rate": 1e2},), "contact")
    assert "edge" in unphysical(candidate, {"rate": 1e5}) and not unphysical(dead, {"rate": 1e5})
    assert "edge" in unphysical(dead, {"rate": 1e-3})


def test_what_leads_all_others_by_far_need_not_pass_the_floor():
    search = next_effect.new_search(Line(lambda t: 3.0 * t))
    start = base_fits.base_fit(search)
    within = choosing.unsearched(replace(start, errors=np.full(2, 9.0) * NOISE**2), np.full(2, 36.0) * NOISE**2)

    def takes(gain, others, parameters=1, name="other"):
        def trial(g, name, count):
            candidate = SimpleNamespace(name=name, size_parameters=[None] * count)
            return SimpleNamespace(gain=g, candidate=candidate, errors=np.full(2, 4.0) * NOISE**2, fit=start.fit)

        top = trial(gain, "top", parameters)
        return judging.least_gain(search.lab, replace(within, trials=[top, *(trial(g, name, 1) for g in others)]), top)

    assert takes(0.9, [0.2, -0.5]) == GAIN_TO_NOISE
    assert takes(0.9, [0.5]) == takes(0.9, [0.2], parameters=5) == takes(0.9, []) == GAIN_IN_FLOOR
    assert takes(0.9, [0.2], name="top") == GAIN_IN_FLOOR, "another form of the same effect is no other one"


def test_what_alone_brings_the_fitted_recordings_to_the_noise_need_not_pass_the_floor():
    search = next_effect.new_search(Line(lambda t: 3.0 * t))
    start = base_fits.base_fit(search)
    within = choosing.unsearched(replace(start, errors=np.array([100.0, 36.0]) * NOISE**2), np.full(2, 400.0) * NOISE**2)

    def takes(fitted, others, parameters=3, before=within):
        def trial(squares, name):
            candidate = SimpleNamespace(name=name, parameters=[None] * parameters, size_parameters=[None] * 3)
            return SimpleNamespace(gain=0.0, candidate=candidate, errors=np.array([squares, 16.0]) * NOISE**2, fit=start.fit)

        top = trial(fitted, "top")
        return judging.least_gain(search.lab, replace(before, trials=[top, *(trial(squares, "other") for squares in others)]), top)

    assert takes(1.2, [20.0, 5.0]) == takes(1.2, []) == FORETELLS
    assert takes(2.0, [20.0]) == takes(1.2, [20.0, 4.0]) == takes(1.2, [20.0], parameters=4) == GAIN_IN_FLOOR
    less = replace(within, errors=np.array([15.0, 36.0]) * NOISE**2)
    assert takes(1.2, [20.0], before=less) == GAIN_IN_FLOOR, "little was to be explained"


@pytest.mark.parametrize("every", [True, False])
def test_all_fits_or_the_leading_ones_are_measured_where_they_end(every, monkeypatch):
    monkeypatch.setattr(refining, "MEASURED", 1)
    problem = Line(lambda t: 3.0 * t + 0.5 * np.sin(40.0 * t))
    search, seen = next_effect.new_search(problem), []
    start = base_fits.base_fit(search)
    monkeypatch.setattr(discretisation, "prefetch", lambda lab, points, **_: seen.append(len(points)))
    best = {c.key: (c, replace(start.fit, point={**start.fit.point, **c.starts[0]})) for c in problem.candidates[:3]}
    refining.measured(search.lab, best, start.floor, every=every)
    assert seen == [3 if every else 1]


@pytest.mark.parametrize("together", [True, False])
def test_every_fit_is_measured_where_it_ends_before_nothing_is_named(together, monkeypatch):
    """Side by side at once; where every point costs, once nothing was named among the leading ones."""
    asked, judge = [], judging.judge
    monkeypatch.setattr(judging, "judge", lambda search, *given, every=False: asked.append(every) or judge(search, *given, every=every))
    problem = Line(lambda t: 3.0 * t + np.sin(40.0 * t), together=together)
    search = next_effect.new_search(problem)
    start = base_fits.base_fit(search)
    assert next_effect.find(search, start.fit, start.floor, []).chosen is None
    assert asked[-1] and asked[0] is together


def test_near_the_noise_a_gain_is_that_of_what_is_above_it(monkeypatch):
    search = next_effect.new_search(Line(lambda t: 3.0 * t + 2.0 * t**3))

    def above(before, after):
        before, after = np.array(before) * NOISE**2, np.array(after) * NOISE**2
        trial = Trial(search.lab.problem.candidates[0], Stand(Fit({}, (), 0.0, np.empty(0), 0, True), search.lab.noise(), after), 0.0)
        return np.exp(judging.above_noise(search.lab, before, replace(trial, gain=comparing.gain(search.lab, before, after))))

    assert above([4.0, 100.0], [1.5, 4.0]) == pytest.approx(6.0**0.5)  # the whole errors are 1.6 times one another
    assert above([4.0, 100.0], [1.5, 90.0]) == pytest.approx((10.0 / 9.0) ** 0.5), "what is held out gains no more than before"
    assert above([4.0, 100.0], [0.5, 1.0]) == pytest.approx(30.0**0.5), "what is left below the noise counts as a tenth of it"
    start = base_fits.base_fit(search)
    assert next_effect.find(search, start.fit, start.floor, []).chosen.candidate.name == "cube"
    monkeypatch.setattr(judging, "above_noise", lambda lab, before, t: 0.0)
    monkeypatch.setattr(judging, "is_exact", lambda search, t: False)
    assert next_effect.find(search, start.fit, start.floor, []).chosen is None


def test_a_fit_that_runs_nowhere_ends_without_a_residual():
    class Broken(Line):
        def predict(self, points, recording, setting=0):
            rows = super().predict(points, recording, setting)
            rows[[p.get("clip.inverse", 0.0) > 0 for p in points]] = np.nan
            return rows

    problem = Broken(lambda t: 3.0 * t + 2.0 * t**2)
    clip = problem.candidates[-1]
    (fit,) = run(problem, [levenberg_marquardt((*problem.declared, *clip.parameters), clip.starts[0])], lambda r, n: r / NOISE, [0])
    assert fit.cost == np.inf
    assert len(fit.residual) == 0
    found = diagnose(problem)
    assert [t.candidate.name for t in found.effects] == ["square"]
    assert all(t["name"] != "clip" or t["data"] == 0 for t in trace(found)["rounds"][0]["trials"])


def test_what_lies_within_the_floor_is_not_asked_of_another_method():
    def fitted(y):
        lines = []
        found = diagnose(Line(y, wiggle=0.1, solvers=(0, 1)), tell=lines.append)
        return found, sum(line.startswith("fitting ") for line in lines)

    found, rounds_of_fits = fitted(lambda t: 3.0 * t + 0.025 * np.sin(33 * t))
    assert found.answer == "none"
    assert found.rounds[0].over < WITHIN
    assert rounds_of_fits == 1
    found, rounds_of_fits = fitted(lambda t: 3.0 * t + 0.3 * np.sin(33 * t))
    assert found.answer == "unknown"
    assert found.rounds[0].over > ABOVE
    assert rounds_of_fits == 2


def test_a_held_out_recording_far_above_its_floor_is_unknown():
    problem = Line(lambda t: 3.0 * t)
    other = problem.recordings[1]
    for size, answer in ((0.02, "none"), (0.07, "unknown")):
        strange = replace(other, y=other.y + size * np.sin(33 * T))
        problem.__dict__["recordings"] = (problem.recordings[0], strange)
        found = diagnose(problem)
        assert found.answer == answer
        assert found.rounds[0].over < ABOVE  # the fitted recording lies at the noise


@pytest.mark.parametrize(("left", "looks"), [(0.3, [0]), (0.05, [0, 1])])
def test_a_method_that_leaves_more_than_what_another_named_is_not_looked_further_with(left, looks, monkeypatch, scripted):
    methods = [Method(first_round(0.1, True)), Method(first_round(left, False))]
    asked = []
    monkeypatch.setattr(choosing, "look_ahead", lambda search, first: asked.append(methods.index(search)) or [first])
    choosing.first_rounds(methods, [stood(1.0)] * 2)
    assert asked == looks


def test_the_method_that_fits_best_begins_and_a_much_worse_one_is_not_asked():
    lines = []
    y = Line(lambda t: t, wiggle=0.5, turns=True).predict([{"a": 1.0}], 0, 1)[0]
    found = diagnose(Line(lambda t: y + 0.1 * np.sin(33 * t), wiggle=0.5, solvers=(0, 1), turns=True), tell=lines.append)
    assert found.setting == 1
    assert found.answer == "insufficient" and not found.effects, "what is left lies within the floor, and far above the noise"
    assert sum(line.startswith("fitting ") for line in lines) == 1


def test_an_interval_leaves_room_for_what_only_the_held_out_recording_shows():
    search = next_effect.new_search(Line(lambda t: 3.0 * t))
    start = base_fits.base_fit(search)

    def width(fitted, held_out):
        low, high = intervals(search.lab, start.fit, start.floor, np.array([fitted, held_out]) ** 2 + NOISE**2)["a"]
        return high - low

    # the slope of the other setting may be in there, as much of it as its wiggle leaves room for beside the noise
    amount = NOISE / np.sqrt(np.sum((0.02 * np.sin(40 * T)) ** 2))
    assert width(0.0, 0.0) == pytest.approx(2 * 1.645 * 2.0 * amount, rel=0.3)
    # the two settings differ by a slope of 2: a fit may be off by as much, and one difference says little of the next
    wiggle = np.sqrt(np.mean((0.02 * np.sin(40 * T)) ** 2))
    assert width(0.0, wiggle) == pytest.approx(2 * student.ppf(0.95, 1) * 2.0, rel=0.05)
    assert width(0.0, 1.3 * wiggle) == pytest.approx(1.3 * width(0.0, wiggle), rel=0.05)
    assert width(0.0, 0.01) == pytest.approx(width(0.01, 0.0))


def test_what_is_too_near_to_the_noise_for_the_least_gain_needs_an_exact_effect(monkeypatch):
    """A gain of 1.5 is enough where one simulation with the effect leaves noise alone: then there is no error of a grid in the data."""
    assert diagnose(Line(lambda t: 3.0 * t + 0.015 * np.sin(33 * t))).answer == "none"
    problem = Line(lambda t: 3.0 * t + 0.1 * t**2, wiggle=0.0)
    found = diagnose(problem)
    assert found.answer in ("effect", "class") and "square" in [t.candidate.name for t in found.rounds[0].members]
    before, after = (found.errors[when]["two"] for when in ("before", "after"))
    assert 1.15 < before / after < np.exp(LEAST_GAIN) and found.rounds[0].p_value <= 0.05
    monkeypatch.setattr(judging, "is_exact", lambda search, t: False)
    assert diagnose(problem).answer == "none"


def test_what_is_too_near_to_the_noise_for_the_least_gain_is_searched_no_further():
    search = next_effect.new_search(Line(lambda t: 3.0 * t))
    assert comparing.is_settled(search.lab, np.array([2.5, 100.0]) * NOISE**2)  # the gain is the smaller one of the two
    assert not comparing.is_noise(search.lab, np.array([2.5, 100.0]) * NOISE**2)
    assert not comparing.is_settled(search.lab, np.array([4.0, 4.0]) * NOISE**2)


class Tones(Line):
    """Line with tones: `low`, `high`, and `chord`, which is both and something that no other has."""

    def __init__(self, y, *names):
        super().__init__(y, wiggle=0.0)
        own = [Candidate(n, (Parameter(f"{n}.c", "1", 0.0, 0.1, -5.0, 5.0),), ({f"{n}.c": 0.1},), "flight") for n in names]
        self.__dict__["candidates"] = (*self.candidates, *own)

    def predict(self, points, recording, setting=0):
        low, high, other = (np.sin(w * T) for w in (40, 62, 87))
        shapes = {"low": low, "high": high, "chord": low + 0.2 * high + 0.6 * other}
        rows = super().predict(points, recording)
        return rows + np.stack([sum(p.get(f"{name}.c", 0.0) * shape for name, shape in shapes.items()) for p in points])


class Brittle(Line):
    """A bend beyond a limit does not run, as a viscosity that explicit steps cannot bear."""

    LIMIT = 0.06

    def predict(self, points, recording, setting=0):
        rows = super().predict(points, recording, setting)
        rows[[abs(p.get("square.c", 0.0)) > self.LIMIT for p in points]] = np.nan
        return rows


@pytest.mark.parametrize("together", [True, False])
def test_a_start_that_does_not_run_is_made_smaller(together):
    problem = Brittle(lambda t: t + 0.05 * t**2, together=together)
    square = problem.candidates[0]
    parameters = (*problem.declared, *square.parameters)
    for sizes, found in (((), 0.3), (("square.c",), 0.05)):
        request = levenberg_marquardt(parameters, {"square.c": 0.3}, together=together, sizes=sizes)
        (fit,) = run(problem, [request], lambda r, n: r / NOISE, [0])
        assert fit.point["square.c"] == pytest.approx(found, abs=0.02)
        assert np.isfinite(fit.cost) == bool(sizes)


def test_an_effect_that_does_not_run_in_every_recording_says_so():
    class Torn(Line):
        def predict(self, points, recording, setting=0):
            rows = super().predict(points, recording, setting)
            rows[[recording == 1 and abs(p.get("square.c", 0.0)) > 1.0 for p in points]] = np.nan
            return rows

    search = next_effect.new_search(Torn(lambda t: t + 2.0 * t**2, wiggle=0.0))
    start = base_fits.base_fit(search)
    result = next_effect.find(search, start.fit, start.floor, [])
    (square,) = [t for t in result.trials if t.candidate.key == "square"]
    assert square.fit.point["square.c"] == pytest.approx(2.0, abs=0.1)
    assert square.reason == "not every recording runs where its fit ends"
    assert result.chosen is None or result.chosen.candidate.key != "square"


def test_two_effects_of_which_none_gains_enough_alone():
    def both(t):
        return 3.0 * t + 0.3 * np.sin(40 * t) + 0.3 * np.sin(62 * t)

    found = diagnose(Tones(both, "low", "high"))
    assert sorted(t.candidate.name for t in found.effects) == ["high", "low"]
    assert found.errors["after"]["two"] == pytest.approx(NOISE, rel=0.3)
    first = found.rounds[0]
    assert first.chosen.gain < LEAST_GAIN  # 1.4-fold
    # a residual that no pair explains stays unknown
    lost = diagnose(Tones(lambda t: both(t) + 0.6 * np.sin(110 * t) + 0.6 * np.sin(150 * t), "low", "high"))
    assert lost.answer == "unknown"


def test_a_class_is_weighed_again_beside_what_was_found_later():
    found = diagnose(Tones(lambda t: 3.0 * t + 0.5 * np.sin(40 * t) + 0.25 * np.sin(62 * t), "low", "high", "chord"))
    assert sorted(t.candidate.name for t in found.effects) == ["high", "low"]
    assert all(len(r.members) == 1 for r in found.rounds if r.chosen)
    reasons = {r["name"]: r["reason"] for r in rejected(found)}
    assert reasons["chord"].startswith("with all effects that were found it leaves")


def standing_for_two() -> Problem:
    """Two tones, and a candidate `chord` of two parameters that stands for both but for a third tone of its own."""
    problem = Tones(lambda t: 3.0 * t + 0.5 * np.sin(40 * t) + 0.25 * np.sin(62 * t), "low", "high")
    both = tuple(Parameter(f"chord.{name}", "1", 0.0, 0.1, -5.0, 5.0) for name in ("c", "d"))
    broad = Candidate("chord", both, ({"chord.c": 0.1, "chord.d": 0.1},), "flight")
    plain = problem.predict

    def predict(points, recording, setting=0):
        low, more = np.sin(40 * T), np.sin(62 * T) + 0.6 * np.sin(87 * T)
        rows = plain([{k: v for k, v in p.items() if "chord" not in k} for p in points], recording, setting)
        return rows + np.stack([p.get("chord.c", 0.0) * low + p.get("chord.d", 0.0) * more for p in points])

    problem.__dict__.update(candidates=(*problem.candidates, broad), predict=predict)
    return problem


def test_a_simpler_effect_takes_the_place_of_one_that_stood_for_two():
    found = diagnose(standing_for_two())
    assert sorted(t.candidate.name for t in found.effects) == ["high", "low"]
    assert found.rounds[0].trials[0].candidate.name == "chord"  # the best one alone


def test_beside_what_is_simpler_than_an_effect_of_many_parameters_a_second_one_is_looked_for(monkeypatch):
    monkeypatch.setattr(pairs, "MANY", 1)  # `chord` has two
    start = base_fits.base_fit(search := next_effect.new_search(standing_for_two()))
    first = next_effect.find(search, start.fit, start.floor, [])
    at = first.chosen.stand
    assert [t.candidate.name for t in first.members] == ["chord"] and not comparing.is_settled(search.lab, at.errors)
    low, high = pairs.beside_members(search, [first], at)
    assert sorted(r.chosen.candidate.name for r in (low, high)) == ["high", "low"]
    assert low.members == [low.chosen] and not low.chosen.reason and comparing.is_noise(search.lab, high.chosen.errors)
    (reason,) = (t.reason for t in low.trials if t.candidate.name == "chord")
    assert reason.endswith("times the error of two effects")
    monkeypatch.setattr(pairs, "simpler", lambda r, chosen: [])
    beside, *_ = pairs.beside_members(search, [first], at)
    assert beside.chosen is first.chosen  # for want of anything simpler


def test_beside_an_effect_of_many_parameters_a_second_one_is_looked_for_last(monkeypatch):
    search = next_effect.new_search(Tones(lambda t: 3.0 * t + 2.0 * np.sin(3.0 * t) + np.sin(7.0 * t) + 0.1 * np.sin(40 * t), "low"))
    start = base_fits.base_fit(search)
    first = next_effect.find(search, start.fit, start.floor, [])
    at = first.chosen.stand
    assert (
        first.chosen.candidate.key.startswith("wave")
        and len(first.chosen.candidate.parameters) > pairs.MANY
        and not comparing.is_settled(search.lab, at.errors)
    )
    wave, low = pairs.beside_members(search, [first], at)
    assert wave.chosen is first.chosen and low.chosen.candidate.name == "low" and comparing.is_noise(search.lab, low.chosen.errors)
    assert not pairs.beside_members(search, [first, replace(low, chosen=None)], at), "a round beside it was made"
    monkeypatch.setattr(next_effect, "promised", lambda search, at, beside: 1.0)
    assert not pairs.beside_members(search, [first], at)


def test_a_limit_of_an_effect_takes_its_place_however_far_it_was_alone(monkeypatch):
    monkeypatch.setattr(pairs, "CLOSE", 1.0)  # nothing else is close
    assert "chord" in [t.candidate.name for t in diagnose(standing_for_two()).effects]
    monkeypatch.setitem(pairs.LIMITS, "chord", ("low",))
    assert sorted(t.candidate.name for t in diagnose(standing_for_two()).effects) == ["high", "low"]


def test_a_limit_of_the_leading_candidate_is_fitted_from_its_declared_values(monkeypatch):
    search = next_effect.new_search(standing_for_two())
    by_key = {c.key: c for c in search.lab.problem.candidates}
    start, free = base_fits.base_fit(search), search.lab.problem.declared
    far = Fit({"a": -3.0, "low.c": 0.0}, ("a", "low.c"), 1e9, np.zeros(1), 1, True)
    (chord,) = search.lab.fits([search.lab.request((*free, *by_key["chord"].parameters), start.fit.point)], start.floor)
    best = {"chord": (by_key["chord"], chord), "low": (by_key["low"], far)}
    assert not stand_ins.limiting_cases(search.lab, free, best, search.lab.problem.candidates, start.floor)
    monkeypatch.setitem(stand_ins.LIMITS, "chord", ("low",))
    ((key, (_, fit)),) = stand_ins.limiting_cases(search.lab, free, best, search.lab.problem.candidates, start.floor).items()
    assert key == "low" and fit.point["low.c"] == pytest.approx(0.5, abs=0.02) and "chord.c" not in fit.point
    near = replace(far, cost=1.2 * chord.cost)  # it is as good already
    assert not stand_ins.limiting_cases(search.lab, free, best | {"low": (by_key["low"], near)}, search.lab.problem.candidates, start.floor)


@pytest.mark.parametrize("apart", ["pull.k", ""])
def test_a_size_whose_sign_no_fit_changes_is_fitted_from_either_side(apart):
    """k (c f - g), which has a place: the best linear start has the wrong k, and on the way to the other sign c would pass infinity."""
    k, c = Parameter("pull.k", "1", 0.0, 0.3, -5.0, 5.0), Parameter("pull.c", "1", 0.1, 1.0, -20.0, 20.0)
    starts = {"pull.k": 1.0, "pull.c": 2.0}, {"pull.k": 1.0, "pull.c": 0.1}
    problem = Line(lambda t: 3.0 * t + 0.2 * (-5.0 * np.sin(40 * t) - np.sin(62 * t)), wiggle=0.0)
    plain = problem.predict

    def predict(points, recording, setting=0):
        own = [p.get("pull.k", 0.0) * (p.get("pull.c", 0.0) * np.sin(40 * T) - np.sin(62 * T)) for p in points]
        return plain(points, recording, setting) + np.stack(own)

    pull = Candidate("pull", (k, c), starts, "flight", sizes=("pull.k",), apart=apart)
    problem.__dict__.update(candidates=(*problem.candidates, pull), predict=predict)
    after = diagnose(problem).after
    right = after.get("pull.k") == pytest.approx(0.2, abs=0.01) and after["pull.c"] == pytest.approx(-5.0, abs=0.3)
    assert right is bool(apart), after


def test_an_effect_that_was_found_last_is_dropped_too():
    problem = Tones(lambda t: 3.0 * t + 0.5 * np.sin(40 * t), "low", "high")
    search = next_effect.new_search(problem)
    start = base_fits.base_fit(search)
    low, high = (c for c in problem.candidates if c.name in ("low", "high"))
    free = (*problem.declared, *low.parameters, *high.parameters)
    (both,) = search.lab.fits([search.lab.request(free, {"low.c": 0.5, "high.c": 0.1})], start.floor)
    found = [Trial(c, Stand(both, start.floor, start.errors), 1.0) for c in (low, high)]
    fit, left = drop(search, both, start.floor, found)
    assert [t.candidate.name for t in left] == ["low"]
    assert fit.names == ("a", "low.c")
    assert fit.point["low.c"] == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize("order", [("low", "high", "broad"), ("broad", "low", "high")])
def test_what_fits_alone_and_foretells_nothing_is_what_is_dropped(order):
    """In the fitted recording `broad` stands for both of the others; in the other one it does not."""
    one, two, three = (np.sin(w * T) for w in (40, 62, 87))
    shapes = {"low": (one, one), "high": (two, two), "broad": (one + two, three)}
    problem = Mixed(shapes, {"low": 0.5, "high": 0.4}, rest=0.05 * np.sin(111 * T))
    search = next_effect.new_search(problem)
    start = base_fits.base_fit(search)
    named = [next(c for c in problem.candidates if c.name == name) for name in order]
    free = (*problem.declared, *(p for c in named for p in c.parameters))
    (all_three,) = search.lab.fits([search.lab.request(free, {"low.c": 0.5, "high.c": 0.4, "broad.c": 0.01})], start.floor)
    found = [Trial(c, Stand(all_three, start.floor, start.errors), 1.0) for c in named]
    _, left = drop(search, all_three, start.floor, found)
    assert [t.candidate.name for t in left] == ["low", "high"]


def test_what_cannot_run_where_the_base_fit_went_is_fitted_from_the_declared_values():
    def low(p):
        return p.get("low.c", 0.0) * (T + 0.2 * np.sin(40 * T))

    class Stiff(Tones):
        """`low` runs for small a alone, and looks like a."""

        def predict(self, points, recording, setting=0):
            rows = Line.predict(self, points, recording, setting) + np.stack([low(p) for p in points])
            rows[[p.get("a", 1.0) > 2.0 and "low.c" in p for p in points]] = np.nan
            return rows

    search = next_effect.new_search(Stiff(lambda t: t + 3.0 * (t + 0.2 * np.sin(40 * t)), "low"))
    start = base_fits.base_fit(search)
    assert start.fit.point["a"] > 3.5  # where `low` does not run
    found = next_effect.find(search, start.fit, start.floor, [])
    assert found.chosen.candidate.name == "low"
    assert found.chosen.fit.point["low.c"] == pytest.approx(3.0, abs=0.05)


def test_a_member_of_a_class_is_fitted_from_its_leader():
    class Twins(Tones):
        """`high` does half of what `low` does."""

        def predict(self, points, recording, setting=0):
            both = [p.get("low.c", 0.0) + 0.5 * p.get("high.c", 0.0) for p in points]
            return super().predict([{**p, "high.c": 0.0, "low.c": c} for p, c in zip(points, both, strict=True)], recording)

    problem = Twins(lambda t: 3.0 * t + 0.5 * np.sin(40 * t), "low", "high")
    search = next_effect.new_search(problem)
    start = base_fits.base_fit(search)
    leader, twin = (c for c in problem.candidates if c.name in ("low", "high"))
    others = [c for c in problem.candidates if c.name in ("square", "cube")]
    (fit,) = search.lab.fits([search.lab.request((*problem.declared, *leader.parameters), {"low.c": 0.1})], start.floor)
    candidates = [leader, twin, *others]
    columns, slopes = (
        directions.candidate_columns(search.lab, start.fit.point, candidates, [0]),
        directions.slopes(search.lab, problem.declared, start.fit.point, [0]),
    )
    best = {"low": (leader, fit)}
    more = stand_ins.similar_candidates(search.lab, problem.declared, best, candidates, {"low": 0}, columns, slopes, start.floor)
    assert list(more) == ["high"]
    assert more["high"][1].point["high.c"] == pytest.approx(2 * fit.point["low.c"], rel=0.01)
    assert (
        stand_ins.similar_candidates(
            search.lab, problem.declared, best | more, candidates, {"low": 0, "high": 0}, columns, slopes, start.floor
        )
        == {}
    )


def test_what_the_leading_one_is_a_limit_of_is_fitted_from_it_where_that_leaves_more_than_noise(monkeypatch):
    monkeypatch.setattr(stand_ins, "MANY", 0)  # of too many parameters otherwise
    monkeypatch.setitem(stand_ins.LIMITS, "high", ("low",))
    problem = Tones(lambda t: 3.0 * t + 0.5 * np.sin(40 * t), "low", "high")
    problem.__dict__["candidates"] = tuple(c for c in problem.candidates if c.name in ("low", "high"))
    search = next_effect.new_search(problem)
    start = base_fits.base_fit(search)
    low, high = problem.candidates
    columns, slopes = (
        directions.candidate_columns(search.lab, start.fit.point, (low, high), [0]),
        directions.slopes(search.lab, problem.declared, start.fit.point, [0]),
    )
    columns["high", 0] = columns["low", 0]
    monkeypatch.setattr(stand_ins, "leader", lambda best: best["low"])

    def asked(size):
        (cost,) = search.lab.costs([point := {"a": 3.0, "low.c": size}], start.floor)
        fit = Fit(point, ("a", "low.c"), cost, np.zeros(1), 1, True)
        return list(
            stand_ins.similar_candidates(
                search.lab, problem.declared, {"low": (low, fit)}, (low, high), {"low": 0}, columns, slopes, start.floor
            )
        )

    assert asked(0.4) == ["high"] and asked(0.5) == []
    monkeypatch.setitem(stand_ins.LIMITS, "high", ())
    assert asked(0.4) == []


class Tuned(Line):
    """A tone whose pitch goes with `a`, and one that stays and stands in for it where `a` is 3."""

    def __init__(self):
        super().__init__(lambda t: 3.0 * t + 0.5 * np.sin(60 * t))
        own = [Candidate(n, (Parameter(f"{n}.c", "1", 0.0, 0.1, -5.0, 5.0),), ({f"{n}.c": 0.1},), "flight") for n in ("tuned", "fixed")]
        self.__dict__["candidates"] = (*self.candidates, *own)

    def predict(self, points, recording, setting=0):
        fixed = np.sin(60 * T) + 0.2 * np.sin(25 * T)
        own = [p.get("tuned.c", 0.0) * np.sin(20 * p.get("a", 1.0) * T) + p.get("fixed.c", 0.0) * fixed for p in points]
        return super().predict(points, recording) + 0.02 * setting * np.sin(40 * T) + np.stack(own)


def test_what_stands_in_for_an_effect_says_where_that_one_begins(monkeypatch):
    search = next_effect.new_search(problem := Tuned())
    start, free = base_fits.base_fit(search), problem.declared
    by_key = {c.key: c for c in problem.candidates}
    base = Fit({"a": 2.0}, ("a",), search.lab.costs([{"a": 2.0}], start.floor)[0], np.zeros(1), 1, True)
    (fixed,) = search.lab.fits([search.lab.request((*free, *by_key["fixed"].parameters), {"a": 3.0, "fixed.c": 0.4})], start.floor)
    astray = Fit({"a": 2.0, "tuned.c": 0.0}, ("a", "tuned.c"), base.cost, np.zeros(1), 1, True)
    best = {"fixed": (by_key["fixed"], fixed), "tuned": (by_key["tuned"], astray)}
    assert [p["tuned.c"] for p in stand_ins.scanned(search.lab, by_key["tuned"], astray.point)][:3] == pytest.approx([0.1, 0.15, 0.225])
    assert {p["tuned.c"] < 0 for p in stand_ins.scanned(search.lab, by_key["tuned"], astray.point)} == {True, False}
    assert not stand_ins.scanned(search.lab, by_key["clip"], astray.point)
    more = stand_ins.candidates_in_place(search.lab, free, best, problem.candidates, base, start.floor)
    assert more["tuned"][1].point["tuned.c"] == pytest.approx(0.5, abs=0.02) and "fixed.c" not in more["tuned"][1].point
    assert comparing.is_noise(search.lab, search.lab.mean_squares([more["tuned"][1].point], start.floor)[0])
    # not where the leading one leaves noise alone, nor where it says little of the declared values
    assert not stand_ins.candidates_in_place(search.lab, free, best | more, problem.candidates, base, start.floor)
    monkeypatch.setattr(comparing, "moved", lambda lab, point: point["a"])
    for led, more, wanted in ((2.4, 1.5, True), (3.0, 1.05, True), (3.0, 1.5, False), (2.4, 2.0, False)):
        assert stand_ins.leaves_only_noise(search.lab, replace(base, point={"a": led}), more * search.lab.noise_squares) is wanted
    near = replace(base, point={"a": fixed.point["a"]})
    little = {"fixed": (by_key["fixed"], replace(fixed, cost=0.6 * search.lab.costs([near.point], start.floor)[0]))}
    assert not stand_ins.candidates_in_place(search.lab, free, little, problem.candidates, near, start.floor)


@pytest.mark.parametrize("together", [True, False])
def test_what_promises_nothing_in_the_place_of_another_is_tried_where_that_is_one_launch(together, monkeypatch):
    monkeypatch.setattr(stand_ins, "PROMISING", 0.0)
    problem = Tuned()
    problem.__dict__["_together"] = together
    start, by_key = base_fits.base_fit(search := next_effect.new_search(problem)), {c.key: c for c in problem.candidates}
    base = Fit({"a": 2.0}, ("a",), search.lab.costs([{"a": 2.0}], start.floor)[0], np.zeros(1), 1, True)
    free = (*problem.declared, *by_key["fixed"].parameters)
    (fixed,) = search.lab.fits([search.lab.request(free, {"a": 3.0, "fixed.c": 0.4})], start.floor)
    more = stand_ins.candidates_in_place(
        search.lab, problem.declared, {"fixed": (by_key["fixed"], fixed)}, problem.candidates, base, start.floor
    )
    assert ("tuned" in more) is together


def test_what_leaves_noise_alone_need_not_pass_the_floor():
    search = next_effect.new_search(Line(lambda t: 3.0 * t))
    start = base_fits.base_fit(search)
    r = choosing.unsearched(replace(start, errors=np.full(2, 9.0) * NOISE**2), np.full(2, 36.0) * NOISE**2)
    noise = np.full(2, NOISE**2)
    assert judging.least_gain(search.lab, r, SimpleNamespace(errors=1.2 * noise, fit=start.fit)) == GAIN_TO_NOISE
    assert judging.least_gain(search.lab, r, SimpleNamespace(errors=3.0 * noise, fit=start.fit)) == GAIN_IN_FLOOR


def test_a_method_that_fails_at_one_point_is_tried_all_the_same():
    class Tangled(Line):
        """Setting 1 runs nowhere near the slope of the other one's fit."""

        def predict(self, points, recording, setting=0):
            rows = super().predict(points, recording, setting)
            rows[[setting == 1 and p.get("a", 1.0) > 4.9 for p in points]] = np.nan
            return rows

    y = Tangled(lambda t: t, wiggle=0.5, turns=True).predict([{"a": 3.0}], 0, 1)[0]
    problem = Tangled(lambda t: y, wiggle=0.5, solvers=(0, 1), turns=True)
    found = diagnose(problem)
    assert found.setting == 1
    assert found.answer == "none"
    assert found.after["a"] == pytest.approx(3.0, abs=0.01)


def test_a_size_behind_a_ridge_is_found_from_elsewhere(monkeypatch):
    class Ridge(Line):
        """`step` acts as c (c - 1/2): small sizes do the opposite of large ones."""

        def __init__(self, y):
            super().__init__(y)
            own = Candidate("step", (Parameter("step.c", "1", 0.0, 0.1, 0.0, 5.0),), ({"step.c": 0.1},), "flight")
            self.__dict__["candidates"] = (*self.candidates, own)

        def predict(self, points, recording, setting=0):
            rows = super().predict(points, recording)
            return rows + np.stack([(p.get("step.c", 0.0) * (p.get("step.c", 0.0) - 0.5)) * np.sin(50 * T) for p in points])

    problem = Ridge(lambda t: 3.0 * t + 2.5 * t**2 + 0.54 * np.sin(50 * t))
    found = diagnose(problem, keep=12)
    assert sorted(t.candidate.name for t in found.effects) == ["square", "step"]
    assert found.after["step.c"] == pytest.approx(1.026, abs=0.01)
    monkeypatch.setattr(contests, "FAR", 1.0)
    monkeypatch.setattr(refining, "FAR", 1.0)
    assert "step" not in [t.candidate.name for t in diagnose(problem, keep=12).effects]


def test_a_size_of_the_other_sign_is_found_from_elsewhere(monkeypatch):
    class Ridge(Line):
        """`step` acts as c (c + 5) below zero, and the other way round above: no small size does what a large one does."""

        def __init__(self, y):
            super().__init__(y)
            own = Candidate("step", (Parameter("step.c", "1", 0.0, 0.1, -9.0, 9.0),), ({"step.c": 0.5},), "flight")
            self.__dict__["candidates"] = (own,)

        def predict(self, points, recording, setting=0):
            rows = super().predict(points, recording, setting)
            c = np.array([p.get("step.c", 0.0) for p in points])
            return rows + np.where(c < 0, c * (c + 5.0), -0.2 * c)[:, None] * np.sin(50 * T)

    problem = Ridge(lambda t: 3.0 * t + 0.54 * np.sin(50 * t))
    found = diagnose(problem)
    assert [t.candidate.name for t in found.effects] == ["step"]
    assert found.after["step.c"] == pytest.approx(-5.106, abs=0.01)
    monkeypatch.setattr(contests, "FAR", 1.0)
    monkeypatch.setattr(refining, "FAR", 1.0)
    assert not diagnose(problem).effects


@pytest.mark.slow
def test_what_an_effect_leaves_within_the_floor_is_searched_only_where_another_one_promises_much(monkeypatch):
    def searches(y):
        lines = []
        found = diagnose(Tones(y, "low", "high"), tell=lines.append)
        return sorted(t.candidate.name for t in found.effects), sum(line.startswith("fitting ") for line in lines)

    def low(t):
        return 3.0 * t + 0.5 * np.sin(40 * t)

    both, more = searches(lambda t: low(t) + 0.25 * np.sin(62 * t))
    assert both == ["high", "low"] and more == 2
    assert searches(lambda t: low(t) + 0.25 * np.sin(90 * t)) == (["low"], 2)
    monkeypatch.setattr(discretisation, "floors", lambda lab, point, free, floor: np.full(2, 0.15**2))
    assert searches(lambda t: low(t) + 0.25 * np.sin(90 * t)) == (["low"], 1)
    assert searches(lambda t: low(t) + 0.25 * np.sin(62 * t)) == (["high", "low"], 2)  # unless one promises much
    monkeypatch.setattr("neuido.discrepancy.inference.search.attribution.CLEAR", 0.0)
    assert searches(lambda t: low(t) + 0.25 * np.sin(90 * t))[1] == 2


def test_a_fit_that_goes_astray_where_it_is_finished_is_not_taken(monkeypatch):
    search = next_effect.new_search(Line(lambda t: 3.0 * t))
    free = search.lab.problem.declared
    (fit,) = search.lab.fits([search.lab.request(free, {})], search.lab.noise())
    named = Stand(fit, *discretisation.stand(search.lab, fit.point))
    away = replace(fit, point={**fit.point, "square.c": 0.2})
    near = replace(fit, point={"a": fit.point["a"] + 1e-4})
    # the floor where an effect was named may leave less than that where its fit stands
    better = replace(named, errors=0.25 * named.errors)
    for start, end, taken in ((named, away, False), (named, near, True), (better, near, False)):
        monkeypatch.setattr(Laboratory, "fits", lambda self, requests, floor, end=end, **options: [end])
        found = base_fits.finished(search.lab, start)
        assert (found.fit is end) is taken
        if not taken:
            assert np.array_equal(found.errors, start.errors)


@pytest.mark.parametrize(("times", "refined"), [(4.0, True), (20.0, False)])
def test_what_leaves_far_more_than_another_method_named_is_not_refined(times, refined):
    lines = []
    search = next_effect.new_search(Line(lambda t: 3.0 * t + 2.0 * t**2 + 0.3 * np.sin(33 * t), turns=True), tell=lines.append)
    start = base_fits.base_fit(search)
    alone = next_effect.find(search, start.fit, start.floor, [])
    assert any(line.startswith("refining ") for line in lines)
    lines.clear()
    top = alone.trials[0]
    rival = replace(alone, chosen=replace(top, stand=replace(top.stand, errors=top.errors / times**2)))
    next_effect.find(search, start.fit, start.floor, [], rival)
    assert any(line.startswith("refining ") for line in lines) is refined


@pytest.mark.parametrize("asked_after", [True, False])
def test_past_its_share_of_the_time_a_method_halts_its_fits_where_another_one_named_an_effect(asked_after, monkeypatch):
    monkeypatch.setattr(contests, "LEADERS", 1)
    search = next_effect.new_search(Line(lambda t: 3.0 * t + 2.0 * t**2 + 0.3 * np.sin(33 * t)))
    start = base_fits.base_fit(search)
    alone = next_effect.find(search, start.fit, start.floor, [])
    search.seen = None
    late = next_effect.CONFIRMED + 0.01
    monkeypatch.setattr(search.lab.budget, "ends", lambda share=1.0: late > share)
    again = next_effect.find(search, start.fit, start.floor, [], alone if asked_after else None)
    assert any(why == contests.NO_TIME for why in again.unfitted.values()) is asked_after


def test_what_is_reported_as_before_is_what_the_effects_were_weighed_against():
    for law in (lambda t: 3.0 * t, lambda t: 3.0 * t + 2.0 * t**2):
        found = diagnose(Line(law, turns=True), draws=19)
        assert found.answer == ("none" if law(1.0) == 3.0 else "effect")
        (first, *_) = found.rounds
        assert list(found.errors["before"].values()) == pytest.approx(np.sqrt(first.errors))
        assert found.final["before"] is first.floor
        assert (found.errors["after"] == found.errors["before"]) is (found.answer == "none")


@pytest.mark.parametrize("converged", [True, False])
def test_a_fit_goes_on_until_it_has_come_to_its_end(converged, monkeypatch):
    """Each further fit takes off a sixth of what is left: too little to go on for, unless the fit ended for its iterations."""
    search = next_effect.new_search(Line(lambda t: 3.0 * t + 2.0 * t**2, wiggle=0.0))
    start = base_fits.base_fit(search)
    square = next(c for c in search.lab.problem.candidates if c.key == "square")
    (fit,) = search.lab.fits([search.lab.request((*search.lab.problem.declared, *square.parameters), start.fit.point)], start.floor)
    ends = iter([1.6, 1.66, 1.715, 1.762, 1.8])
    asked = []

    def refit_from_starts(lab, entries, like):
        ((_, fit, _),) = entries
        asked.append(fit)
        return [(replace(fit, point={"a": 3.0, "square.c": next(ends)}, converged=converged), like)]

    monkeypatch.setattr(refining, "refit_from_starts", refit_from_starts)
    monkeypatch.setattr(comparing, "is_noise", lambda *_, **__: False)
    out = refining.refine(search.lab, search.lab.problem.declared, {"square": (square, fit)}, start.fit, start.floor)
    assert len(asked) == (2 if converged else 1 + refining.ONWARD)
    assert out["square"][1].point["square.c"] == (1.66 if converged else 1.762)


class Folded(Line):
    """A line and one candidate whose signs are two effects: c t^2 above zero and -c t^3 below."""

    def __init__(self, y):
        super().__init__(y, wiggle=0.0)
        size = Parameter("fold.c", "1", 0.0, 0.022, -5.0, 5.0)
        self.__dict__["fold"] = Candidate("fold", (size,), ({"fold.c": 0.3},), "flight", apart="fold.c")

    def predict(self, points, recording, setting=0):
        c = np.array([[p.get("fold.c", 0.0)] for p in points])
        return super().predict(points, recording, setting) + np.where(c > 0, c * T**2, -c * T**3)


def test_the_other_sign_of_the_leading_candidate_is_followed_to_its_end(monkeypatch):
    def lost(self, costs, left):
        self.best = min(self.best, costs[-1])
        return len(costs) > 2 and costs[-1] > 2.0 * self.best

    monkeypatch.setattr(Race, "lost", lost)
    search = next_effect.new_search(Folded(lambda t: 3.0 * t + 1.5 * t**3))
    start, fold, free = base_fits.base_fit(search), search.lab.problem.fold, search.lab.problem.declared
    starts = [(fold, {"a": 2.5, "fold.c": 2.1}, None), (fold, {"a": 3.5, "fold.c": -0.1}, None)]
    best, other, *_ = contests.contest(search.lab, free, starts, start.floor)
    # the one that leads while the other has hardly begun gives its place up to it
    assert other[1].point["fold.c"] > 0
    assert best["fold"][1].point["fold.c"] == pytest.approx(-1.5, abs=0.05)
    assert best["fold"][1].cost < 0.5 * other[1].cost
    refined = refining.refine(search.lab, free, {"fold": other}, start.fit, start.floor, other=best["fold"])
    assert refined["fold"][1].point["fold.c"] == pytest.approx(-1.5, abs=0.05)
    alone, none, *_ = contests.contest(search.lab, free, starts[:1], start.floor)
    assert alone["fold"][1].point["fold.c"] > 0 and none is None


class Mixed(Line):
    """A line and tones; `shapes`: what each candidate does in the fitted recording and in the other one. `rest`: what none does."""

    def __init__(self, shapes, truth, rest=0.0):
        super().__init__(lambda t: 3.0 * t, wiggle=0.0)
        own = [Candidate(n, (Parameter(f"{n}.c", "1", 0.0, 0.1, -5.0, 5.0),), ({f"{n}.c": 0.1},), "flight") for n in shapes]
        self.__dict__ |= {"_shapes": shapes, "candidates": (*self.candidates, *own)}
        added = [sum(c * shapes[name][n] for name, c in truth.items()) + rest for n in range(2)]
        self.__dict__["recordings"] = tuple(replace(r, y=r.y + more) for r, more in zip(self.recordings, added, strict=True))

    def predict(self, points, recording, setting=0):
        own = [sum(p.get(f"{name}.c", 0.0) * both[recording] for name, both in self._shapes.items()) + 0.0 * T for p in points]
        return super().predict(points, recording, setting) + np.stack(own)


def names(found):
    return sorted(t.candidate.name for t in found.effects)


def test_what_fits_alone_and_foretells_nothing_is_tried_with_a_second_effect(monkeypatch):
    """In the fitted recording one tone stands for both effects; in the other one they go apart."""
    monkeypatch.setattr(refining, "growing_pairs", lambda *_: [])  # they would find them before
    one, two, three = (np.sin(w * T) for w in (40, 62, 87))
    shapes = {"low": (one, one), "high": (0.9 * one + 0.3 * two, -three)}
    problem = Mixed(shapes, {"low": 0.5, "high": 0.5})
    start = base_fits.base_fit(search := next_effect.new_search(problem))
    alone = next_effect.find(search, start.fit, start.floor, [])
    assert alone.chosen is None and alone.trials[0].gain < 0.2
    found = diagnose(problem)
    assert found.answer == "effect" and names(found) == ["high", "low"]
    assert found.after["low.c"] == pytest.approx(0.5, abs=0.02) and found.after["high.c"] == pytest.approx(0.5, abs=0.02)
    # what the two leave together must be near the floor
    assert diagnose(Mixed(shapes, {"low": 0.5, "high": 0.5}, rest=0.1 * np.sin(75 * T))).answer == "unknown"
    monkeypatch.setattr(pairs, "BLIND_GAIN", np.inf)
    assert diagnose(problem).answer == "effect"  # far above its floor what gains little alone is tried too
    monkeypatch.setattr(pairs, "FAR_ABOVE", np.inf)
    assert diagnose(problem).answer == "unknown"


def test_a_second_effect_is_looked_for_beside_each_member_of_a_class(monkeypatch):
    """`mix` comes nearest alone, and is neither of the two effects that are there."""
    monkeypatch.setattr(refining, "growing_pairs", lambda *_: [])  # they would find them before
    one, two, three = (np.sin(w * T) for w in (40, 62, 87))
    shapes = {"low": one, "high": two, "mix": 0.9 * one + 0.2 * two + 0.15 * three}
    problem = Mixed({name: (shape, shape) for name, shape in shapes.items()}, {"low": 0.9, "high": 0.3})
    start = base_fits.base_fit(search := next_effect.new_search(problem))
    alone = next_effect.find(search, start.fit, start.floor, [])
    assert alone.chosen.candidate.name == "mix" and {t.candidate.name for t in alone.members} == {"low", "mix"}
    found = diagnose(problem)
    assert found.answer == "effect" and names(found) == ["high", "low"]
    assert all(e == pytest.approx(NOISE, rel=0.2) for e in found.errors["after"].values())
    monkeypatch.setattr(pairs, "PROMISED", 0.0)
    assert names(diagnose(problem)) == ["mix"]


def test_a_neighbour_takes_the_place_of_an_effect_once_the_other_one_was_found(monkeypatch):
    """`mix` comes nearest alone, by far, and beside it the second effect leaves more than noise."""
    one, two, three = (np.sin(w * T) for w in (40, 62, 87))
    shapes = {"low": one, "high": two, "mix": one + 0.3 * two + 0.06 * three}
    problem = Mixed({name: (shape, shape) for name, shape in shapes.items()}, {"low": 0.9, "high": 0.5})
    start = base_fits.base_fit(search := next_effect.new_search(problem))
    alone = next_effect.find(search, start.fit, start.floor, [])
    assert [t.candidate.name for t in alone.members] == ["mix"]
    assert names(diagnose(problem, most=2)) == ["high", "low"]
    monkeypatch.setattr(attribution, "neighbours", lambda r, chosen: [])
    assert names(diagnose(problem, most=2)) == ["high", "mix"]


@pytest.mark.slow
def test_what_fits_beside_the_wrong_effect_is_tried_beside_the_others(monkeypatch):
    """`mix` leads alone, and `high` fits beside it but foretells nothing: it belongs beside `low`."""
    monkeypatch.setattr(refining, "growing_pairs", lambda *_: [])  # they would find them before
    one, two, three = (np.sin(w * T) for w in (40, 62, 87))
    shapes = {"low": (one, one), "high": (two, two), "mix": (one + 0.3 * two, 0.8 * one + 0.45 * two - 0.25 * three)}
    problem = Mixed(shapes, {"low": 0.9, "high": 0.4})
    start = base_fits.base_fit(search := next_effect.new_search(problem))
    first = next_effect.find(search, start.fit, start.floor, [])
    assert first.chosen.candidate.name == "mix"
    second = next_effect.find(search, first.chosen.fit, first.chosen.stand.floor, [first.chosen])
    assert second.chosen is None
    low, high = pairs.replace_first_effect(search, first, second, first.chosen.errors)
    assert (low.chosen.candidate.name, high.chosen.candidate.name) == ("low", "high") and low.members == [low.chosen]
    assert comparing.is_noise(search.lab, high.chosen.errors)
    assert not pairs.replace_first_effect(search, first, second, high.chosen.errors), "no less than that"
    found = diagnose(problem)
    assert names(found) == ["high", "low"]
    assert found.after["low.c"] == pytest.approx(0.9, abs=0.01) and found.after["high.c"] == pytest.approx(0.4, abs=0.01)
    monkeypatch.setattr(pairs, "replace_first_effect", lambda *_: [])
    assert names(diagnose(problem)) != ["high", "low"]


class Late(Tones):
    """What the candidate `late` does begins at a size of one."""

    def __init__(self, y):
        super().__init__(y, "low")
        late = Candidate("late", (Parameter("late.c", "1", 0.0, 0.3, -9.0, 9.0),), ({"late.c": 0.3},), "flight")
        self.__dict__["candidates"] = (*self.candidates, late)

    def predict(self, points, recording, setting=0):
        late = np.array([max(p.get("late.c", 0.0) - 1.0, 0.0) for p in points])
        return super().predict(points, recording, setting) + late[:, None] * np.sin(62 * T)


@pytest.mark.parametrize("together", [True, False])
def test_a_second_effect_is_tried_at_larger_sizes(together, monkeypatch):
    problem = Late(lambda t: 3.0 * t + 2.0 * np.sin(40 * t) + 0.5 * np.sin(62 * t))
    problem.__dict__["_together"] = together
    found = diagnose(problem)
    assert names(found) == ["late", "low"] and found.after["late.c"] == pytest.approx(1.5, abs=0.01)
    monkeypatch.setattr(contests, "sized", lambda lab, starts, *_, **__: (list(starts), {}))
    assert names(diagnose(problem)) == ["low"]


class Apart(Mixed):
    """Two tones by setting 0; setting 1 has a wiggle more, and the second tone does not run there."""

    def __init__(self):
        one, two = np.sin(40 * T), np.sin(62 * T)
        super().__init__({"low": (one, one), "high": (two, two)}, {"low": 0.9, "high": 0.3})
        self.__dict__ |= {"_wiggle": 0.02, "solvers": (0, 1)}

    def predict(self, points, recording, setting=0):
        rows = super().predict(points, recording, setting)
        rows[[setting == 1 and p.get("high.c", 0.0) != 0.0 for p in points]] = np.nan
        return rows


@pytest.fixture
def methods():
    """The chosen method, and another one with its first round."""
    problem = Apart()
    search, other = next_effect.new_search(problem, setting=1), next_effect.new_search(problem, setting=0)
    start = base_fits.base_fit(other)
    return search, other, next_effect.find(other, start.fit, start.floor, [])


@pytest.mark.parametrize("within", [False, True])
@pytest.mark.parametrize(("left", "found"), [(1.0, True), (0.4, True), (0.2, False), (0.05, False)])
def test_another_method_is_asked_for_two_effects_where_its_first_comes_near(left, found, within, methods):
    """`left`: what the chosen method leaves of what one effect leaves by this one; 0.05 is noise, 0.2 too far away."""
    search, other, first = methods
    assert first.chosen.candidate.name == "low"
    at = replace(first.chosen.stand, errors=left**2 * first.chosen.errors)
    both = pairs.by_another_method({other: first}, search, at, [first.chosen], within=within)
    assert bool(both) is found
    if found:
        assert both[0] is other
        assert [r.chosen.candidate.name for r in both[1]] == ["low", "high"]
        assert comparing.is_noise(other.lab, both[1][-1].chosen.errors)


@pytest.mark.parametrize(("above", "within", "found"), [(2.0, True, True), (3.0, True, False), (3.0, False, True)])
def test_beside_what_lies_within_its_floor_two_effects_by_another_method_leave_about_noise(above, within, found, methods, monkeypatch):
    """`above`: times the noise that the two leave before they are refined."""
    search, other, first = methods
    _, (_, second) = pairs.by_another_method({other: first}, search, first.chosen.stand, [first.chosen])
    limit = 1.001 * second.chosen.errors / above**2
    real = comparing.is_noise

    def near(lab, squares, **options):
        return bool(np.all(squares < limit)) if lab is other.lab else real(lab, squares, **options)

    monkeypatch.setattr(comparing, "is_noise", near)
    assert bool(pairs.by_another_method({other: first}, search, first.chosen.stand, [first.chosen], within=within)) is found


def test_pairs_grow_by_the_suggested_method_first(methods, monkeypatch):
    search, other, first = methods
    asked = []
    monkeypatch.setattr(refining, "growing_pairs", lambda search, *_: asked.append(search.lab.own) or [])
    monkeypatch.setattr(refining, "leaves_much", lambda lab, errors: True)
    assert pairs.by_growing(search, first, first.chosen.stand, {other: first}) is None
    assert asked == [0, 1]


@pytest.fixture
def unnamed(methods):
    """The chosen method, another one with its first round which named nothing, and the trial there of what the chosen one named."""
    search, other, first = methods
    low = first.chosen
    low.reason = "too little"
    return search, other, replace(first, chosen=None, members=[]), low


@pytest.mark.parametrize(("over", "found"), [(1.1, True), (0.9, False)])
def test_another_method_that_named_nothing_is_asked_beside_what_was_named(over, found, unnamed, monkeypatch):
    search, other, first, low = unnamed
    monkeypatch.setattr(next_effect, "over_floor", lambda lab, at: over)
    assert not pairs.by_another_method({other: first}, search, low.stand, [low], within=True)
    high = next(t for t in first.trials if t.candidate.name == "high")
    assert not pairs.by_another_method({other: replace(first, trials=[high])}, search, low.stand, [low])
    both = pairs.by_another_method({other: first}, search, low.stand, [low])
    assert bool(both) is found and bool(low.reason) is not found
    if found:
        assert [r.chosen.candidate.name for r in both[1]] == ["low", "high"] and both[1][0].members == [low]
        assert first.chosen is None


def test_where_two_were_found_the_other_method_alone_is_asked(unnamed, monkeypatch):
    def fail(*_):
        raise AssertionError

    search, other, first, low = unnamed
    for name in ("beside_members", "replace_first_effect"):
        monkeypatch.setattr(pairs, name, fail)
    by, pair = pairs.two_effects(search, [first, first], [low, low], low.stand, {other: first})
    assert by is other and [r.chosen.candidate.name for r in pair] == ["low", "high"]
    assert pairs.two_effects(search, [first, first], [low, low], low.stand, {}) == (search, [])


def test_what_another_method_names_with_as_much_left_is_in_the_class(unnamed):
    search, other, first, low = unnamed
    high = next(t for t in first.trials if t.candidate.name == "high")

    def widened(left, of=low.errors):
        named = replace(first, trials=[low, high], chosen=low, members=[low])
        joins = replace(high, stand=replace(high.stand, errors=left**2 * of))
        attribution.widen(search, named, replace(low.stand, errors=of), [first, replace(first, chosen=joins, members=[joins, low])])
        assert len(named.trials) == 2 and (joins in named.trials) is (joins in named.members)
        return [t.candidate.name for t in named.members]

    assert widened(1.3) == ["low", "high"] and widened(0.7) == ["low", "high"]
    assert widened(1.5) == ["low"]
    assert widened(1.0, search.lab.noise_squares) == ["low"], "nothing is left to be told"


@pytest.mark.slow
def test_the_method_may_change_where_there_are_two_effects(monkeypatch):
    monkeypatch.setattr(refining, "growing_pairs", lambda *_: [])  # they would find them before
    real = choosing.first_rounds

    def other_one(tried, starts):
        chosen, firsts = real(tried, starts)
        assert [tried[i].lab.setting for i in (chosen, *(i for i in firsts if i != chosen))] == [0, 1]
        return 1 - chosen, firsts

    asked, beside = [], pairs.beside_members
    monkeypatch.setattr(attribution, "first_rounds", other_one)
    monkeypatch.setattr(pairs, "beside_members", lambda *args: asked.append(args) or beside(*args))
    found = diagnose(Apart())
    assert found.setting == 0 and found.unable and not names(found), "the one other setting does not run: nothing says what a grid does"
    monkeypatch.setattr(attribution, "blind_to_settings", lambda _: False)
    found = diagnose(Apart())
    assert found.setting == 0 and names(found) == ["high", "low"]
    assert not asked, "the other method leaves noise"
    assert all(e == pytest.approx(NOISE, rel=0.2) for e in found.errors["after"].values())
    monkeypatch.setattr(pairs, "WORSE", 0.1)
    found = diagnose(Apart())
    assert found.setting == 1 and names(found) == ["low"] and len(asked) == 1


def test_what_leaves_as_much_as_grids_differ_by_is_not_named(monkeypatch):
    """Without what grids may be it is named, however little it does to the held-out recording beside them."""
    one = np.sin(40 * T)
    problem = Mixed({"low": (one, one)}, {"low": 0.9}, rest=0.3 * np.sin(75 * T))
    start = base_fits.base_fit(search := next_effect.new_search(problem))
    first = next_effect.find(search, start.fit, start.floor, [])
    assert first.chosen is not None and not comparing.is_noise(search.lab, first.chosen.errors)
    wide = {n: np.full_like(v, 0.4) for n, v in first.chosen.stand.floor.spread.items()}
    coarse = replace(first.chosen, stand=replace(first.chosen.stand, floor=replace(first.chosen.stand.floor, spread=wide)))
    assert judging.is_like_a_grid(search.lab, coarse, first.errors)
    assert not judging.is_like_a_grid(search.lab, coarse, 9.0 * first.errors)  # far more was to be explained
    little = replace(coarse, stand=replace(coarse.stand, errors=0.3 * coarse.errors))
    assert not judging.is_like_a_grid(search.lab, little, first.errors)
    told = replace(coarse, stand=replace(coarse.stand, errors=np.where(search.lab.fitted, search.lab.noise_squares, coarse.errors)))
    assert not judging.is_like_a_grid(search.lab, told, first.errors), "what is fitted comes to the noise"
    assert not judging.is_like_a_grid(search.lab, replace(coarse, gain=1.01 * GAIN_IN_FLOOR), first.errors), (
        "it gains what it takes within the floor"
    )
    monkeypatch.setattr(judging, "is_like_a_grid", lambda self, t, before: t.candidate.name == "low")
    again = next_effect.find(search, start.fit, start.floor, [])
    (reason,) = (t.reason for t in again.trials if t.candidate.name == "low")
    assert again.chosen is None and "another grid" in reason


def test_what_is_behind_by_less_than_grids_differ_by_is_in_the_class():
    """Only what fits the fitted recordings as well, with no more parameters, and where what is named leaves more than noise there."""
    one = np.sin(40 * T)
    search = next_effect.new_search(Mixed({"low": (one, one), "high": (np.sin(62 * T), one)}, {"low": 0.9}, rest=0.3 * np.sin(75 * T)))
    start = base_fits.base_fit(search)
    first = next_effect.find(search, start.fit, start.floor, [])
    other, fitted = next(t for t in first.trials if t.candidate.name == "high"), np.array(search.lab.fitted)
    wide = {n: np.full_like(v, 0.4) for n, v in first.chosen.stand.floor.spread.items()}
    top = replace(first.chosen, stand=replace(first.chosen.stand, floor=replace(first.chosen.stand.floor, spread=wide)))

    def rival(share, left, of=top, candidate=other.candidate):
        errors = np.where(fitted, share * of.errors, left**2)
        return judging.is_rival(search, replace(other, candidate=candidate, gain=0.0, stand=replace(other.stand, errors=errors)), of)

    assert rival(0.9, 0.35) and not rival(0.9, 0.45) and not rival(1.1, 0.35)
    assert not rival(0.9, 0.35, candidate=replace(other.candidate, parameters=(other.candidate.parameters[0],) * 2))
    noise = replace(top, stand=replace(top.stand, errors=np.where(fitted, search.lab.noise_squares, top.errors)))
    assert not rival(0.9, 0.35, of=noise)


def test_beside_a_fit_that_was_given_up_a_second_effect_is_looked_for_where_it_ends():
    shapes = {"low": np.sin(40 * T), "high": np.sin(62 * T)}
    search = next_effect.new_search(problem := Mixed({name: (s, s) for name, s in shapes.items()}, {"low": 0.9, "high": 0.3}))
    low = next(c for c in problem.candidates if c.name == "low")
    parameters = (*problem.declared, *low.parameters)
    (fit,) = search.lab.fits([search.lab.request(parameters, {"a": 2.0, "low.c": 0.1}, iterations=0)], search.lab.noise())
    given_up = Trial(low, Stand(fit, *discretisation.stand(search.lab, fit.point)), 1.0)
    assert not fit.converged and fit.point["low.c"] == 0.1
    there = pairs.continued_to_end(search.lab, given_up)
    (alone,) = search.lab.fits([search.lab.request(parameters, {"a": 2.0, "low.c": 0.1})], there.floor)
    assert alone.point["low.c"] > 0.8 and there.fit.point == pytest.approx(alone.point, rel=0.01)
    assert there.errors[0] < 0.2 * given_up.errors[0]
    ended = Trial(low, replace(there, fit=replace(there.fit, converged=True)), 1.0)
    assert pairs.continued_to_end(search.lab, ended).fit is ended.fit


def test_the_other_method_goes_on_from_where_the_chosen_one_has_come():
    """`low` acts as sin(40 t) for a near 3 alone: from anywhere below 2 no fit gets there."""

    class Valley(Mixed):
        def predict(self, points, recording, setting=0):
            rows = super().predict(points, recording, setting)
            wrong = np.array([[p.get("a", 1.0) < 2.0] for p in points])
            return np.where(wrong, rows + 0.4 * np.sin(62 * T) - 2.0 * np.array([[p.get("a", 1.0)] for p in points]) * T, rows)

    one = np.sin(40 * T)
    search = next_effect.new_search(problem := Valley({"low": (one, one)}, {"low": 0.9}))
    low = problem.candidates[-1]
    (fit,) = search.lab.fits([search.lab.request(low.parameters, {"a": 1.0, "low.c": 0.5})], search.lab.noise())
    t = Trial(low, Stand(fit, *discretisation.stand(search.lab, fit.point)), 1.0)
    there = pairs.refit_from(search.lab, t, {"a": 2.9, "other.c": 1.0})
    assert comparing.is_noise(search.lab, there.errors) and there.fit.point["a"] == pytest.approx(3.0, abs=0.02)
    assert "other.c" not in there.fit.point
    better = Trial(low, there, 1.0)
    assert pairs.refit_from(search.lab, better, {"a": 1.0}).fit is there.fit


@pytest.mark.parametrize(("left", "chosen"), [(0.8, 0), (0.5, 1)])
def test_an_effect_by_the_worse_method_leaves_clearly_less_than_the_better_one_without_any(left, chosen, monkeypatch, scripted):
    """Else an effect stands for what another method gets wrong."""
    monkeypatch.setattr(choosing, "look_ahead", lambda search, first: [first])
    methods = [Method(first_round(0.95, False, base=1.0)), Method(first_round(left, True, base=1.5))]
    assert choosing.first_rounds(methods, [stood(1.0), stood(1.5)])[0] == chosen


@pytest.mark.parametrize(("left", "answered"), [(0.5, False), (0.1, True)])
def test_an_effect_leaves_less_than_a_method_that_was_not_asked_does_without_any(left, answered, monkeypatch, scripted):
    monkeypatch.setattr(choosing, "look_ahead", lambda search, first: [first])
    monkeypatch.setattr(choosing, "by_first_fits", lambda *_: {0: 0.0})
    asked, late = Method(first_round(left, named=True)), Method()
    asked.result.chosen.gain = np.log(10.0)
    late.budget, late.problem = Budget(0.0, spent=lambda: 1.0), SimpleNamespace(declared=())
    chosen, firsts = choosing.first_rounds([asked, late], [stood(1.0), stood(0.4)])
    assert (firsts[chosen][0].chosen is not None) is answered
    assert firsts[chosen][0].errors[0] == pytest.approx(1.0 if answered else 0.16)


@pytest.mark.parametrize(("gain", "late", "named"), [(2.6, True, False), (3.5, True, True), (2.6, False, True)])
def test_an_effect_gains_much_where_there_was_no_time_for_another_method(gain, late, named, monkeypatch, scripted):
    monkeypatch.setattr(choosing, "look_ahead", lambda search, first: [first])
    monkeypatch.setattr(choosing, "by_first_fits", lambda *_: {0: 0.0})
    first = first_round(0.2, named=True)
    first.chosen.gain = np.log(gain)
    other = Method(first_round(1.0, named=False))
    other.budget = Budget(0.0 if late else np.inf, spent=lambda: 1.0)
    chosen, firsts = choosing.first_rounds([Method(first), other], [stood(1.0), stood(1.1)])
    assert chosen == 0 and (firsts[0][0].chosen is not None) is named and firsts[0][0].unsure is not named
    assert bool(first.trials[0].reason) is not named
    assert named or "the search ended before the other method" in first.trials[0].reason


def test_what_there_was_no_time_to_be_sure_of_is_unknown_and_not_none(monkeypatch):
    assert diagnose(Line(lambda t: 3.0 * t)).answer == "none"
    real = choosing.first_rounds

    def unsure(tried, starts):
        chosen, firsts = real(tried, starts)
        return chosen, {i: [replace(r, unsure=True) for r in own] for i, own in firsts.items()}

    monkeypatch.setattr(attribution, "first_rounds", unsure)
    assert diagnose(Line(lambda t: 3.0 * t)).answer == "unknown"


@pytest.mark.parametrize(("bend", "found"), [(0.0, True), (1.0, False)])
def test_a_model_is_weighed_without_an_effect_where_the_fit_with_it_ended(bend, found):
    search = next_effect.new_search(Line(lambda t: 3.0 * t + bend * t**2))
    start = base_fits.base_fit(search)
    end = stood(NOISE, {"a": 3.0, "square.c": bend})
    t = Trial(search.lab.problem.candidates[0], replace(end, floor=start.floor), 1.0)
    # the base is as good in the fitted recording and twenty times the noise off in the other one
    r = Round(start.fit.point, np.array([1.0, 400.0]) * NOISE**2, [t], t, [t], 0.01, start.floor, np.full(2, NOISE**2))
    plain = next_effect.without_effect(search.lab, r, start.fit, start.floor)
    assert (plain is not None) is found
    if plain is not None:
        assert plain.fit.point == {"a": 3.0}
        assert np.all(plain.errors < 4 * NOISE**2)


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_so_many_places_without_an_effect_are_weighed(count, monkeypatch):
    """Those of the members, three at the most, and of others up to two in all."""
    search = next_effect.new_search(Line(lambda t: 3.0 * t))
    start = base_fits.base_fit(search)
    square = search.lab.problem.candidates[0]
    ends = [{"a": 3.01 - 0.002 * i, "square.c": 0.0} for i in range(6)]
    trials = [Trial(square, replace(stood(NOISE, end), floor=start.floor), 1.0) for end in ends]
    members = trials[-count:]
    errors, floors = np.array([1.0, 400.0]) * NOISE**2, np.full(2, NOISE**2)
    r = Round(start.fit.point, errors, trials, members[0], members, 0.01, start.floor, floors)
    asked = []
    monkeypatch.setattr(discretisation, "prefetch", lambda lab, points, **_: asked.extend(points))
    next_effect.without_effect(search.lab, r, start.fit, start.floor)
    own = [{"a": t.fit.point["a"]} for t in members[:3]]
    assert asked[: len(own)] == own and len(asked) == max(len(own), 2)


@pytest.mark.parametrize(("bend", "found"), [(0.0, True), (1.0, False)])
def test_a_residual_that_no_effect_explains_has_the_model_fitted_from_where_those_ended(bend, found, monkeypatch):
    search = next_effect.new_search(Line(lambda t: 3.0 * t + bend * t**2))
    start = base_fits.base_fit(search)
    t = Trial(
        search.lab.problem.candidates[0], replace(stood(8 * NOISE, {"a": 3.6, "square.c": -0.7}), floor=start.floor), 0.1, "too little"
    )
    errors = np.array([1.0, 400.0]) * NOISE**2
    fits, begun = Laboratory.fits, []
    monkeypatch.setattr(
        Laboratory, "fits", lambda self, requests, *rest, **options: begun.append(len(requests)) or fits(self, requests, *rest, **options)
    )
    plain = next_effect.without_effect(
        search.lab, Round(start.fit.point, errors, [t], None, [], 0.5, start.floor, np.full(2, NOISE**2)), start.fit, start.floor
    )
    assert (plain is not None) is found
    if plain is not None:
        assert set(plain.fit.point) == {"a"} and np.all(plain.errors < 4 * NOISE**2)
    within = Round(start.fit.point, errors, [t], None, [], 0.5, start.floor, errors)
    assert next_effect.without_effect(search.lab, within, start.fit, start.floor) is None and begun == [1]


def test_what_another_modulus_does_as_well_is_no_effect(monkeypatch):
    def as_good(search, result, base, floor):
        return result.chosen and Stand(replace(base, point={"a": 2.0}), floor, 1.02 * result.chosen.errors)

    assert diagnose(Line(clipped)).answer == "effect"
    monkeypatch.setattr(next_effect, "without_effect", as_good)
    found = diagnose(Line(clipped))
    assert (found.answer, found.effects, found.before) == ("none", [], {"a": 2.0})


@pytest.mark.parametrize(("error", "moves"), [(0.8, False), (0.5, True)])
def test_a_parameter_of_the_problems_own_leaves_its_place_for_clearly_less_alone(error, moves):
    search = next_effect.new_search(Line(clipped))

    still, moved = stood([1.0, 5.0], {"a": 2.0}), stood([error, 5.0], {"a": 3.0, "height": 0.1})
    rough = stood([1.3, 5.0])
    assert base_fits.best_base_fit(search, [rough, still, moved]) is (moved if moves else still)
    assert search.still == ({"a": 2.0} if moves else None)


class Shifted(Line):
    """A bend whose other setting lies elsewhere the more it bends: differences at the base say nothing of where the bend's fit ends."""

    def predict(self, points, recording, setting=0):
        bends = np.array([p.get("square.c", 0.0) for p in points])[:, None]
        return super().predict(points, recording, 0) + setting * (0.3 * np.sin(25 * T) * bends)


def test_ends_from_elsewhere_are_weighed_by_the_floor_where_they_stand():
    """The recording lies halfway to the other setting: by the base's floor, where the two agree, the truth leaves the sine."""
    problem = Shifted(lambda t: 3.0 * t + 2.0 * t**2 + 0.3 * np.sin(25 * t))
    search = next_effect.new_search(problem)
    base = base_fits.base_fit(search)
    square = problem.candidates[0]
    request = search.lab.request((*problem.declared, *square.parameters), {"a": 3.0, "square.c": 2.0})
    (end,) = search.lab.fits([request], base.floor)
    wrong = replace(end, point={"a": 5.0, "square.c": -1.0}, cost=0.5 * end.cost)
    found = refining.refit_at_own_floors(search.lab, [(square, end)], {"square": (square, wrong)}, base.floor)
    assert found["square"][1].point["square.c"] == pytest.approx(2.0, abs=0.1)
    assert (
        refining.refit_at_own_floors(search.lab, [(square, wrong)], {"square": (square, end)}, base.floor)
        .get("square", (square, end))[1]
        .point["square.c"]
        > 1.0
    )


@pytest.mark.parametrize("found", [False, True])
def test_candidates_are_fitted_without_the_problems_own_parameters_too(found, monkeypatch):
    search = next_effect.new_search(Line(clipped))
    base = base_fits.base_fit(search)
    square, cube = (next(c for c in search.lab.problem.candidates if c.name == name) for name in ("square", "cube"))
    search.still = {"a": 2.5}
    beside = {"a": 2.0, "cube.c": 0.4} if found else {"a": 2.0}
    moved = replace(base, fit=replace(base.fit, point={**beside, "height": 0.1}))
    ended = replace(moved.fit, point={**moved.fit.point, "a": 2.2, "square.c": 0.7})
    asked = []

    def contest(lab, free, starts, floor, hopeful, then, beyond, until, between, puts_off):
        asked.extend([*starts, *then([(square, ended)])])
        return contests.Contest({}, None, {})

    monkeypatch.setattr(contests, "contest", contest)
    monkeypatch.setattr(refining, "leaves_much", lambda lab, errors: False)
    next_effect.find(search, moved.fit, moved.floor, [Trial(cube, moved, 1.0)] if found else [])
    own = [{k: v for k, v in begin.items() if not k.startswith("square.")} for c, begin, _ in asked if c.name == "square"]
    still = beside if found else {"a": 2.5}
    assert own == [{**beside, "height": 0.1}, still, {**still, "a": 2.2}]  # the last one where the fit with it ended
    assert asked[-1][1]["square.c"] == 0.7
    monkeypatch.setattr(prospects, "LEADERS", 0)
    asked.clear()
    search.seen = None
    next_effect.find(search, moved.fit, moved.floor, [Trial(cube, moved, 1.0)] if found else [])
    again = [c.key for c, begin, _ in asked if c.linear and "height" not in begin]
    assert again == ["square"] * 2
    asked.clear()
    next_effect.find(search, base.fit, base.floor, [])
    assert all("height" not in begin for _, begin, _ in asked) and len({c.key for c, *_ in asked}) < len(asked) + 1


def test_where_the_first_fits_leave_noise_alone_only_the_hopeful_are_fitted(monkeypatch):
    """Alone and once each: a square is there, and every other candidate begins twice."""
    monkeypatch.setattr(contests, "LEADERS", 1)
    for law, leaves_noise in ((lambda t: 3.0 * t + 2.0 * t**2, True), (lambda t: 3.0 * t + 2.0 * np.sin(9.0 * t), False)):
        search = next_effect.new_search(Line(law, wiggle=0.0))
        base = base_fits.base_fit(search)
        by_key = {c.key: c for c in search.lab.problem.candidates}
        keys = ["square", "cube", "cube", "clip", "clip"]
        starts = [(by_key[key], {**base.fit.point, **by_key[key].starts[-1]}, None) for key in keys]
        begun = []
        request = Laboratory.request

        def seen(self, parameters, start, begun=begun, request=request, **options):
            begun.append(next(k.split(".")[0] for k in start if "." in k))
            return request(self, parameters, start, **options)

        monkeypatch.setattr(Laboratory, "request", seen)
        best, _, unfitted, _ = contests.contest(
            search.lab, search.lab.problem.declared, starts, base.floor, {"square", "cube"}, lambda led, starts=starts: starts[:1]
        )
        monkeypatch.setattr(Laboratory, "request", request)
        assert comparing.is_noise(search.lab, search.lab.mean_squares([best["square"][1].point], base.floor)[0]) is leaves_noise
        assert begun == ["square", "cube"] * leaves_noise + keys * (not leaves_noise) + ["square"]
        assert unfitted == ({"clip": contests.OTHERS_DO} if leaves_noise else {})


@pytest.mark.parametrize(
    ("left", "over", "there", "order"),
    [
        (0.3, 0.5, 0.2, [1, 0]),
        (0.3, 0.5, 0.4, [0, 1]),
        (0.9, 0.5, 0.2, [0, 1]),  # no effect is promised, and there is no need of one
        (0.9, 1.5, 0.2, [1, 0]),
        (1.2, 1.5, 0.9, [1, 0]),  # what they leave is no more than without any
        (0.03, 1.5, 0.005, [0, 1]),  # it may be noise
    ],
)
def test_the_method_whose_first_fits_leave_least_is_refined_first(left, over, there, order, scripted):
    """Unless those of the first one promise no effect within its floor, or leave little more than noise."""
    asked = []

    class Looking(Method):
        def is_noise(self, errors):
            return bool(np.all(errors < 1.8 * NOISE**2))

        def over_floor(self, at):
            return over

        def first_look(self, fit, floor, led=None, beyond=np.inf, until=1.0, grows=True):
            asked.append(led)
            return SimpleNamespace(least=[np.full(2, self.result**2)], led=self.result)

    methods, starts = [Looking(left), Looking(there)], [stood(1.0)] * 2
    seen = choosing.by_first_fits(methods, starts, [0, 1], [0.0, 0.1])
    assert sorted((0, 1), key=lambda i: seen.get(i, np.inf)) == order
    both = left > 0.03 and not (left == 0.9 and over < 1.0)
    assert asked == ([None, left] if both else [None])
    first = {0: pytest.approx(2 * np.log(min(left, 1.0)))}
    assert seen == (first | {1: pytest.approx(2 * np.log(there) + 0.1)} if both else {} if left == 0.9 else first)
    asked.clear()
    far = 2.0 * np.log(pairs.WORSE) + 0.1
    assert choosing.by_first_fits(methods, starts, [0, 1], [0.0, far]) == {} and not asked


@pytest.mark.parametrize(
    ("together", "left", "there", "looks"),
    [
        (True, 0.5, 0.2, [(0.5, True), (0.2, True)]),
        (False, 0.5, 0.2, [(0.5, False), (0.2, False), (0.2, True), (0.5, True)]),
        (False, 0.2, 0.5, [(0.2, False), (0.5, False), (0.2, True), (0.5, True)]),
        (False, 0.5, 0.02, [(0.5, False), (0.02, False), (0.02, True)]),
    ],
)
def test_where_every_point_costs_fits_grow_after_both_methods_were_asked(together, left, there, looks, scripted):
    """By the one that leaves least, and by the other one while that leaves much."""
    asked = []

    class Looking(Method):
        problem = SimpleNamespace(together=together)

        def over_floor(self, at):
            return 1.5

        def leaves_much(self, errors):
            return errors[0][0] > 0.03**2

        def first_look(self, fit, floor, led=None, beyond=np.inf, until=1.0, grows=True):
            asked.append((self.result, grows))
            return SimpleNamespace(least=[np.full(2, self.result**2)], led=None)

    choosing.by_first_fits([Looking(left), Looking(there)], [stood(1.0)] * 2, [0, 1], [0.0, 0.1])
    assert asked == looks


@pytest.mark.parametrize("together", [True, False])
def test_there_are_no_further_fits_where_another_method_does_far_better(together, monkeypatch):
    monkeypatch.setattr(contests, "LEADERS", 1)
    search = next_effect.new_search(Line(lambda t: 3.0 * t + 2.0 * np.sin(9.0 * t), wiggle=0.0, together=together))
    base = base_fits.base_fit(search)
    starts = [(c, {**base.fit.point, **c.starts[-1]}, None) for c in search.lab.problem.candidates if c.key in ("square", "cube", "clip")]
    first, *_ = contests.contest(search.lab, search.lab.problem.declared, starts[:1], base.floor)
    left = score(search.lab.mean_squares([first["square"][1].point], base.floor)[0])
    for beyond, fitted in ((left - 0.1, {"square"}), (left + 0.1, {"square", "cube", "clip"})):
        contest = contests.contest(search.lab, search.lab.problem.declared, starts, base.floor, beyond=beyond)
        assert set(contest.best) == fitted
        assert contest.unfitted == dict.fromkeys({"square", "cube", "clip"} - fitted, contests.FAR_BEHIND)


def test_fits_beside_the_first_ones_wait_until_another_method_was_asked(monkeypatch):
    """Where these leave more than may be noise; what goes on then comes to what fits in one go come to."""
    monkeypatch.setattr(contests, "LEADERS", 1)
    for law, waits in ((lambda t: 3.0 * t + 2.0 * np.sin(9.0 * t), {"cube", "clip"}), (lambda t: 3.0 * t + 2.0 * t**2, set())):
        search = next_effect.new_search(Line(law, wiggle=0.0, together=False))
        base, free = base_fits.base_fit(search), search.lab.problem.declared
        by_key = {c.key: c for c in search.lab.problem.candidates}
        starts = [(by_key[key], {**base.fit.point, **by_key[key].starts[-1]}, None) for key in ("square", "cube", "clip")]
        first = contests.contest(search.lab, free, starts, base.floor, puts_off=True)
        if not waits:
            assert first.put_off is None and set(first.best) == {"square", "cube", "clip"}
            continue
        assert {c.key for c, *_ in first.put_off.starts} == waits and set(first.best) == {"square"}
        assert first.unfitted == dict.fromkeys(waits, contests.NO_TIME)
        assert first.best["square"][1].setting == search.lab.own and next_effect.left_by(search.lab, first.best, base.floor)
        later = contests.contest(search.lab, free, first.put_off.starts, base.floor, before=first.put_off.ended)
        at_once = contests.contest(search.lab, free, starts, base.floor)
        assert later.put_off is None and not later.unfitted
        assert {key: fit.cost for key, (_, fit) in later.best.items()} == {key: fit.cost for key, (_, fit) in at_once.best.items()}


def test_a_look_that_was_put_off_goes_on_when_it_is_asked_again(monkeypatch):
    monkeypatch.setattr(contests, "LEADERS", 1)
    monkeypatch.setattr(refining, "leaves_much", lambda lab, errors: False)
    search = next_effect.new_search(Line(lambda t: 3.0 * t + 2.0 * np.sin(9.0 * t), wiggle=0.0, together=False))
    base = base_fits.base_fit(search)
    first = next_effect.first_look(search, base.fit, base.floor, grows=False)
    waiting = list(dict.fromkeys(c.key for c, *_ in first.contest.put_off.starts))
    (lead,) = first.contest.best
    assert first.led.keys == [lead, *waiting] and set(first.led.ends) == {lead}
    assert next_effect.first_look(search, base.fit, base.floor, grows=False) is first
    whole = next_effect.first_look(search, base.fit, base.floor)
    assert whole.contest.put_off is None and set(whole.contest.best) == {lead, *waiting}
    assert next_effect.first_look(search, base.fit, base.floor) is whole
    search.seen, told = first, []
    monkeypatch.setattr(search.lab.budget, "skips", lambda what, until=1.0: told.append(what) or True)
    assert next_effect.first_look(search, base.fit, base.floor) is first
    assert told == [f"fits of {', '.join(waiting)}"]


@pytest.mark.parametrize(("cost", "settings", "refined"), [(4.0, 2, True), (6.0, 2, False), (4.0, 1, False)])
def test_an_effect_of_many_parameters_that_leads_by_far_is_refined(cost, settings, refined, monkeypatch):
    search = next_effect.new_search(Line(lambda t: 3.0 * t + 2.0 * t**2, wiggle=0.1))
    base = base_fits.base_fit(search)
    search.lab.problem.__dict__["settings"] = settings
    square = next(c for c in search.lab.problem.candidates if c.key == "square")
    knots = tuple(Parameter(f"wide.c{i}", "1", 0.0, 0.1, -5.0, 5.0) for i in range(contests.MANY + 1))
    wide = Candidate("wide", knots, ({p.name: 0.1 for p in knots},), "flight")
    fits = {"square": (square, replace(base.fit, cost=10.0)), "wide": (wide, replace(base.fit, cost=cost))}
    there = replace(base.fit, point={**base.fit.point, "a": 3.4})
    asked = []

    def refit_repeatedly(lab, entries, floor):
        asked.extend(entries)
        return [(there, floor)]

    monkeypatch.setattr(refining, "refit_repeatedly", refit_repeatedly)
    monkeypatch.setattr(search.lab, "costs", lambda points, floor: [1.0 for _ in points])
    errors = {True: [np.array([0.1])], False: [np.array([0.3])]}
    monkeypatch.setattr(search.lab, "mean_squares", lambda points, floor, fitted=False: errors[points[0] is there.point])
    found = refining.refine_large(search.lab, search.lab.problem.declared, fits, base.floor)
    assert {key: (c, fit.point, fit.cost) for key, (c, fit) in found.items()} == ({"wide": (wide, there.point, 1.0)} if refined else {})
    assert [fit.cost for _, fit, _ in asked] == [cost] * refined
    errors[True] = [np.array([0.4])]
    assert refining.refine_large(search.lab, search.lab.problem.declared, fits, base.floor) == {}


def test_what_leaves_far_more_than_the_best_is_not_refined(monkeypatch):
    """However near its cost: what is held out tells them apart."""
    search = next_effect.new_search(Line(lambda t: 3.0 * t + 2.0 * t**2, wiggle=0.0))
    base = base_fits.base_fit(search)
    by_key = {c.key: c for c in search.lab.problem.candidates}
    best = {key: (by_key[key], replace(base.fit, point={"a": 3.0, "square.c": c}, cost=1.0)) for key, c in (("square", 1.8), ("cube", 0.9))}
    asked = []
    monkeypatch.setattr(
        refining, "refit_repeatedly", lambda lab, entries, floor: asked.extend(entries) or [(f, floor) for _, f, _ in entries]
    )
    refining.refine(search.lab, search.lab.problem.declared, best, base.fit, base.floor)
    assert [fit.point["square.c"] for _, fit, _ in asked] == [1.8]
    monkeypatch.setattr(refining, "NEARBY", 10.0)
    refining.refine(search.lab, search.lab.problem.declared, best, base.fit, base.floor)
    assert [fit.point["square.c"] for _, fit, _ in asked] == [1.8, 1.8, 0.9]


@pytest.mark.parametrize(("suggested", "first"), [(2.5, 0), (3.5, 1)])
def test_the_suggested_method_is_looked_at_first_unless_it_is_far_worse(suggested, first, monkeypatch, scripted):
    orders = []
    monkeypatch.setattr(choosing, "look_ahead", lambda search, first: [first])
    monkeypatch.setattr(choosing, "by_first_fits", lambda tried, starts, order, _: orders.append(order) or {})
    result = first_round(0.1, True)
    choosing.first_rounds([Method(result), Method(result)], [stood(suggested), stood(1.0)])
    assert orders == [[first, 1 - first]]


@pytest.mark.parametrize(("left", "rounds_of"), [(0.1, [0, 1]), (2.0, [1, 0]), (3.9, [1])])
def test_a_method_that_is_far_worse_without_effects_is_asked_where_with_one_it_is_not(left, rounds_of, monkeypatch, scripted):
    """Its first fits were made before the other method was: what they leave counts, not what the declared model does there."""
    asked, starts = [], [stood(4.0), stood(1.0)]

    class Asked(Method):
        def first_look(self, *_, **__):
            return self.seen

        def over_floor(self, at):
            return 1.5

        def find(self, *_):
            asked.append(self.result)
            return first_round(0.8, False)

    methods = [Asked(0), Asked(1)]
    for method, start, least in zip(methods, starts, (left, 0.8), strict=True):
        method.seen = SimpleNamespace(base=start.fit, least=[np.full(2, least**2)], led=None, contest=SimpleNamespace(put_off=None))
    monkeypatch.setattr(choosing, "look_ahead", lambda search, first: [first])
    choosing.first_rounds(methods, starts)
    assert asked == rounds_of
    methods[0].seen.base = None  # of another stand of the declared model
    asked.clear()
    choosing.first_rounds(methods, starts)
    assert asked == [1]


@pytest.mark.parametrize(("there", "waits", "rounds_of"), [(0.5, False, [0, 1]), (0.9, False, [0]), (0.9, True, [0, 1])])
def test_a_method_whose_first_fits_are_far_from_what_was_named_is_not_asked_further(there, waits, rounds_of, monkeypatch, scripted):
    """Unless most of these were put off."""
    asked = []

    class Asked(Method):
        def find(self, *_):
            asked.append(self.result)
            return first_round(0.1, True)

    monkeypatch.setattr(choosing, "look_ahead", lambda search, first: [first])
    monkeypatch.setattr(choosing, "by_first_fits", lambda *_: {0: 2 * np.log(0.1), 1: 2 * np.log(there) + np.log(1.2)})
    methods = [Asked(0), Asked(1)]
    methods[1].seen = SimpleNamespace(contest=SimpleNamespace(put_off=() if waits else None), base=None)
    choosing.first_rounds(methods, [stood(1.0)] * 2)
    assert asked == rounds_of


@pytest.mark.parametrize(("noise", "rounds_of"), [(0.06, [0]), (0.04, [0, 1])])
def test_no_other_method_is_asked_where_a_named_effect_leaves_little_more_than_noise(noise, rounds_of, monkeypatch, scripted):
    asked = []

    class Asked(Method):
        def find(self, *_):
            asked.append(self.result)
            return first_round(0.1, True)

        def is_noise(self, errors):
            return bool(np.all(errors < noise**2))

    monkeypatch.setattr(choosing, "look_ahead", lambda search, first: [first])
    choosing.first_rounds([Asked(0), Asked(1)], [stood(1.0)] * 2)
    assert asked == rounds_of


def test_fits_begin_where_those_of_another_method_ended_too(monkeypatch):
    """With the declared values and the effect of that end, and the problem's own values of this method."""
    search = next_effect.new_search(Line(clipped))
    by_key = {c.key: c for c in search.lab.problem.candidates}
    base = base_fits.base_fit(search)
    begun = []
    contest = contests.contest

    def seen(lab, free, starts, *args, **options):
        begun.extend(starts)
        return contest(lab, free, starts, *args, **options)

    monkeypatch.setattr(contests, "contest", seen)
    end = {"a": 3.1, "height": 7.0, "clip.inverse": 1.0 / 1.61}
    look = next_effect.first_look(search, base.fit, base.floor, led=looked({"clip": (by_key["clip"], replace(base.fit, point=end))}).led)
    (begin,) = [begin for c, begin, _ in begun if c.key == "clip" and begin["clip.inverse"] == end["clip.inverse"]]
    assert begin == {**base.fit.point, "a": 3.1, "clip.inverse": end["clip.inverse"]}
    assert search.seen is look and look.contest.best["clip"][1].cost == min(fit.cost for _, fit in look.contest.best.values())
    asked = search.lab.memo.simulations
    first = next_effect.find(search, base.fit, base.floor, [])
    assert first.trials[0].candidate.key == "clip" and search.lab.memo.simulations - asked < 100  # nothing is screened again


def looked(best, **chosen):
    """A look of another method, with the best fit of each candidate and the start that it was given."""
    return Look(None, Promising([], (), {}, {}, chosen, [], {}), contests.Contest(best, None, {}), [])


def test_by_another_method_those_are_fitted_that_led_by_the_first(monkeypatch):
    """The others are screened in the shape that they were fitted in, and the first of them alone are fitted."""
    monkeypatch.setattr(prospects, "OWN", 1)
    monkeypatch.setattr(search_state, "LED_BY", 1)
    monkeypatch.setattr(refining, "leaves_much", lambda lab, errors: False)  # no fits that grow
    screen = directions.screen
    screened = []
    monkeypatch.setattr(
        directions, "screen", lambda lab, at, candidates, *rest: screened.append(candidates) or screen(lab, at, candidates, *rest)
    )
    search = next_effect.new_search(Line(clipped), keep=1)
    by_key = {c.key: c for c in search.lab.problem.candidates}
    clip = by_key["clip"]
    assert len(clip.starts) > 1
    base = base_fits.base_fit(search)
    ends = {
        key: (by_key[key], replace(base.fit, point=base.fit.point | by_key[key].starts[0], cost=cost))
        for key, cost in (("cube", 1.0), ("clip", 2.0))
    }
    next_effect.first_look(search, base.fit, base.floor)
    whole = next_effect.first_look(next_effect.new_search(search.lab.problem, keep=1), base.fit, base.floor, led=looked(ends, clip=1).led)
    shapes = {c.key: c.starts for c in screened[1]}
    assert shapes["clip"] == clip.starts[1:2] and shapes["cube"] == by_key["cube"].starts and set(shapes) == set(by_key)
    assert len(whole.contest.best) == 2 and "cube" in whole.contest.best


@pytest.mark.parametrize(("together", "fitted"), [(True, ["late", "low", "square"]), (False, ["cube", "low", "square"])])
def test_by_another_method_what_promises_nothing_at_first_is_tried_at_larger_sizes(together, fitted, monkeypatch):
    """In one launch; the best of them by that is kept."""
    monkeypatch.setattr(prospects, "OWN", 2)
    problem = Late(lambda t: 3.0 * t + 0.5 * np.sin(62 * t) + 0.1 * np.sin(40 * t))
    problem.__dict__["_together"] = together
    search = next_effect.new_search(problem)
    base = base_fits.base_fit(search)
    best = {c.key: (c, replace(base.fit, point=base.fit.point | c.starts[0])) for c in problem.candidates if c.key == "square"}
    asked = prospects.promising(search, base.fit, base.floor, led=looked(best).led)
    own = [c.key for c, *_ in asked.starts if len(c.parameters) == 1]
    assert sorted(dict.fromkeys(own)) == fitted and set(asked.chosen) == set(own) | {c.key for c, *_ in asked.starts}
    assert not together or len(asked.chosen) == 3


@pytest.mark.parametrize("together", [True, False])
def test_fits_begin_at_the_size_that_leaves_least(together):
    """A slope at nothing says little of what a large effect does, and what the base fit made up for is no place to begin at."""
    problem = Line(clipped, together=together)
    search = next_effect.new_search(problem)
    base = base_fits.base_fit(search)
    by_key = {c.key: c for c in problem.candidates}
    slopes = directions.slopes(search.lab, problem.declared, base.fit.point, search.lab.scored_recordings)
    clip, cube = by_key["clip"], by_key["cube"]
    starts = [(clip, {**base.fit.point, **start}, None) for start in clip.starts] + [(cube, {**base.fit.point, **cube.starts[0]}, None)]
    kept, least = contests.sized(search.lab, starts, base.fit, slopes, base.floor)
    places = [begin for c, begin, _ in starts if c is clip] + [
        {**contests.at_declared(search.lab, base.fit.point), **start} for start in clip.starts
    ]
    tried = search.lab.costs(places, base.floor)
    costs = search.lab.costs([begin for _, begin, _ in kept], base.floor)
    assert [c.key for c, *_ in kept[:-1]] == ["clip", "clip"], "with the base fit's values and as declared"
    assert costs[0] == min(tried)
    before = search.lab.costs([base.fit.point], base.floor)[0]
    assert least["clip"] == pytest.approx(min(tried) / before) and least["cube"] <= costs[-1] / before


@pytest.mark.parametrize("takes", [("a",), ()])
def test_what_stiffens_is_tried_with_less_of_what_stood_for_it(takes):
    problem = Line(lambda t: 1.65 * t + 1.8 * t**3)
    search = next_effect.new_search(problem)
    base = base_fits.base_fit(search)
    cube = replace(next(c for c in problem.candidates if c.key == "cube"), takes=takes)
    high = replace(base.fit, point={"a": 3.0})
    slopes = directions.slopes(search.lab, problem.declared, high.point, search.lab.scored_recordings)
    kept, _ = contests.sized(search.lab, [(cube, {"a": 3.0, "cube.c": 0.3}, None)], high, slopes, base.floor)
    best = dict(kept[0][1])
    assert (best == pytest.approx({"a": 0.55 * 3.0, "cube.c": 6.0 * 0.3})) is bool(takes)


def test_what_does_not_act_in_proportion_is_tried_as_declared_too():
    """The base fit may stand for it with values with which it does nothing, or too much."""
    problem = Line(lambda t: np.minimum(1.1 * t, 0.8))
    search = next_effect.new_search(problem)
    base = base_fits.base_fit(search)
    clip = next(c for c in problem.candidates if c.key == "clip")
    clip = replace(clip, starts=({"clip.inverse": 0.05}, {"clip.inverse": 1.3}))
    astray = replace(base.fit, point={"a": -6.0})
    kept, _ = contests.sized(search.lab, [(clip, {**astray.point, **clip.starts[0]}, None)], astray, {}, base.floor)
    assert dict(kept[0][1]) == {"a": 1.0, "clip.inverse": 1.3}


def test_what_got_no_fit_for_want_of_time_is_said_to(monkeypatch):
    """Past its share of the time a look tries no sizes, and ends the fits that it begins."""
    clock = [0.0]
    budget = Budget(100.0, spent=lambda: clock[0])
    search = next_effect.new_search(Line(lambda t: 3.0 * t + 2.0 * np.sin(9.0 * t), wiggle=0.0), budget=budget)
    base = base_fits.base_fit(search)
    clock[0] = 60.0
    monkeypatch.setattr(contests, "sized", None)
    look = next_effect.first_look(search, base.fit, base.floor, until=0.5)
    assert look.contest.best and set(look.contest.unfitted.values()) == {contests.NO_TIME}
    assert all(fit.evaluations == 1 and not fit.converged for _, fit in look.contest.best.values())  # those that began end at once
    first = next_effect.find(search, base.fit, base.floor, [])
    assert first.unfitted and not set(first.unfitted) & {t.candidate.key for t in first.trials}


class Turned(Line):
    """What is added goes as the time or as its square, by a shape which no slope at the one that is screened first tells of."""

    def __init__(self, *idle):
        super().__init__(lambda t: 3.0 * t + 6.0 * t**3, wiggle=0.0)
        size = Parameter("turned.c", "1", 0.0, 0.3, 0.0, 30.0)
        shape = [Parameter(f"turned.{name}", "rad", 0.0, 0.2, -7.0, 7.0) for name in ("angle", *idle)]
        starts = tuple({"turned.c": 1.0, "turned.angle": a} | {f"turned.{name}": 0.0 for name in idle} for a in (0.0, 2.0, 4.0))
        self.__dict__["candidates"] = (Candidate("turned", (size, *shape), starts, "flight", sizes=("turned.c",)),)

    def predict(self, points, recording, setting=0):
        c, at = (np.array([[p.get(f"turned.{name}", 0.0)] for p in points]) for name in ("c", "angle"))
        return super().predict(points, recording, setting) + c * (T**3 * np.cos(at - 4.0) + T**2 * np.sin(at - 4.0))


def test_what_the_base_fit_made_up_for_is_no_faint_promise(monkeypatch):
    """A start with the declared values that leaves no more than the base fit, which went far from these, promises twice as much."""
    search = next_effect.new_search(Line(clipped))
    base, square = base_fits.base_fit(search), search.lab.problem.candidates[0]
    slopes = directions.slopes(search.lab, search.lab.problem.declared, base.fit.point, search.lab.scored_recordings)
    least, begun = {}, [(square, {**base.fit.point, **square.starts[0]}, None)]
    for far in (contests.LED_FAR + 0.1, contests.LED_FAR - 0.1):
        monkeypatch.setattr(comparing, "moved", lambda lab, point, far=far: far)
        monkeypatch.setattr(
            Laboratory, "costs", lambda self, points, floor: [1.0] + [1.2 + (contests.at_declared(self, p) != p) for p in points[1:]]
        )
        least[far > contests.LED_FAR] = contests.sized(search.lab, begun, base.fit, slopes, base.floor)[1]["square"]
    assert least == {True: pytest.approx(1.2 / contests.BESIDE), False: 2.2}


def test_fits_begin_half_way_to_what_is_stated_where_the_base_fit_went_far_from_it():
    search = next_effect.new_search(Line(clipped))
    square, point = search.lab.problem.candidates[0], {"a": 3.0}
    base, size = Fit(point, ("a",), 1.0, np.zeros(1), 1, True), 0.3 * contests.FAR
    for far in (True, False):
        made = contests.tried(search.lab, (square, {**point, **square.starts[0]}, None), base, led_far=far)
        half = sorted(p["square.c"] for _, p, _ in made if p["a"] == pytest.approx(2.0))
        assert half == pytest.approx([-size, size] if far else [])


@pytest.mark.parametrize(("idle", "shapes", "kept"), [([], 4, 1), (["tilt"], 4, 3), (["tilt"], 2, 2)])
def test_sizes_are_tried_in_every_shape(idle, shapes, kept, monkeypatch):
    """One start of a candidate of few parameters, and one in each of so many shapes of one with more, the best first."""
    monkeypatch.setattr(contests, "SHAPES", shapes)
    search = next_effect.new_search(Turned(*idle))
    base, (turned,) = base_fits.base_fit(search), search.lab.problem.candidates
    slopes = directions.slopes(search.lab, search.lab.problem.declared, base.fit.point, search.lab.scored_recordings)
    begun, least = contests.sized(search.lab, [(turned, {**base.fit.point, **turned.starts[0]}, None)], base.fit, slopes, base.floor)
    angles = [begin["turned.angle"] for _, begin, _ in begun]
    assert len(set(angles)) == len(angles) == kept
    assert angles[0] == 4.0 and begun[0][1]["turned.c"] == contests.FAR
    costs = search.lab.costs([begin for _, begin, _ in begun], base.floor)
    assert costs == sorted(costs) and least["turned"] == pytest.approx(costs[0] / search.lab.costs([base.fit.point], base.floor)[0])


@pytest.mark.parametrize("together", [True, False])
def test_a_look_that_is_late_tries_no_further_sizes(together, monkeypatch):
    """A batch may take long; what was not tried keeps its starts, and says nothing of what it leaves."""
    monkeypatch.setattr(contests, "TRIED_AT_ONCE", 1)
    clock = [0.0]
    search = next_effect.new_search(Line(clipped, together=together), budget=Budget(100.0, spent=lambda: clock[0]))
    base = base_fits.base_fit(search)
    by_key = {c.key: c for c in search.lab.problem.candidates}
    slopes = directions.slopes(search.lab, search.lab.problem.declared, base.fit.point, search.lab.scored_recordings)
    starts = [(by_key[key], {**base.fit.point, **by_key[key].starts[0]}, None) for key in ("clip", "cube")]
    costs = Laboratory.costs

    def slow(self, points, floor):
        clock[0] += 30.0
        return costs(self, points, floor)

    monkeypatch.setattr(Laboratory, "costs", slow)
    kept, least = contests.sized(search.lab, starts, base.fit, slopes, base.floor, until=0.2)
    assert set(least) == {"clip"} and [entry for entry in kept if entry[0] is by_key["cube"]] == starts[1:]
    clock[0] = 0.0
    assert set(contests.sized(search.lab, starts, base.fit, slopes, base.floor, until=0.9)[1]) == {"clip", "cube"}
