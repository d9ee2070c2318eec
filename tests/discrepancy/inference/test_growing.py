"""Fits that read more and more of a recording: a motion whose phase a wrong law turns many times over has a valley for each turn."""

import numpy as np
import pytest

from neuido.discrepancy.inference import comparing
from neuido.discrepancy.inference.laboratory import Laboratory
from neuido.discrepancy.inference.search import attribution, base_fits, contests, next_effect, pairs, refining
from neuido.discrepancy.inference.search.attribution import diagnose
from neuido.discrepancy.problems.problem import Candidate, Parameter, Problem, Recording

T = np.linspace(0.01, 1.0, 300)
NOISE = 0.02


class Swing(Problem):
    """sin(40 sqrt(a) t) with what candidates do to it: `chirp` turns the phase as t^2, `wind` shifts all, `tide` shifts it in time.

    With `jerk` that turns the phase as t^3 too. Setting 1 has a wiggle more.
    """

    def __init__(self, truth, *, together: bool = False, declared: float = 1.0, jerk: bool = False) -> None:
        chirp = Parameter("chirp.c", "1", 0.0, 0.3, -30.0, 30.0)
        wind = Parameter("wind.c", "1", 0.0, 0.3, -5.0, 5.0)
        turn = Parameter("jerk.c", "1", 0.0, 0.3, -30.0, 30.0)
        tide = tuple(Parameter(f"tide.c{k}", "1", 0.0, 0.1, -5.0, 5.0) for k in range(6))
        candidates = (
            Candidate("chirp", (chirp,), ({chirp.name: 0.3},), "flight"),
            Candidate("wind", (wind,), ({wind.name: 0.3},), "flight"),
            *((Candidate("jerk", (turn,), ({turn.name: 0.3},), "flight"),) if jerk else ()),
            Candidate("tide", tide, ({p.name: 0.1 for p in tide},), "flight"),
        )
        rng = np.random.default_rng(0)
        recordings = tuple(
            Recording(name, role, swing(truth, n) + NOISE * rng.normal(size=len(T)), NOISE, np.zeros(len(T), int), T)
            for n, (name, role) in enumerate((("one", "fit"), ("two", "held_out")))
        )
        free = (Parameter("a", "1", declared, 0.15, 0.05, 20.0, log=True),)
        super().__init__("swing", "rmse", "1", free, (), candidates, recordings, settings=2)
        self.__dict__["_together"] = together

    @property
    def together(self):
        return self._together

    def predict(self, points, recording, setting=0):
        return np.stack([swing(p, recording) + 0.02 * setting * np.sin(55 * T) for p in points])


def swing(p, recording):
    start = 0.4 * recording
    phase = start + 40 * np.sqrt(p.get("a", 1.0)) * T + p.get("chirp.c", 0.0) * T**2 + p.get("jerk.c", 0.0) * T**3
    tide = sum(p.get(f"tide.c{k}", 0.0) * np.sin((k + 1) * 2.0 * T) for k in range(6))
    return np.sin(phase) + p.get("wind.c", 0.0) * T + tide


def without(monkeypatch):
    """Fits of the whole alone."""
    monkeypatch.setattr(base_fits, "refit_by_growing", lambda search, made: [])
    monkeypatch.setattr(refining, "growing", lambda *_, **__: {})


@pytest.mark.parametrize("together", [True, False])
def test_the_declared_model_is_found_past_side_valleys(together, monkeypatch):
    problem = Swing({"a": 1.3}, together=together)
    found = base_fits.base_fit(next_effect.new_search(problem))
    assert found.fit.point["a"] == pytest.approx(1.3, rel=0.005)
    assert comparing.is_noise(next_effect.new_search(problem).lab, found.errors)
    without(monkeypatch)
    astray = base_fits.base_fit(next_effect.new_search(problem))
    assert abs(astray.fit.point["a"] - 1.3) > 0.05 and not comparing.is_noise(next_effect.new_search(problem).lab, astray.errors)


@pytest.mark.parametrize("together", [True, False])
def test_an_effect_is_found_past_side_valleys(together, monkeypatch):
    problem = Swing({"a": 1.2, "chirp.c": 20.0}, together=together)
    found = diagnose(problem, draws=39)
    assert [t.candidate.name for t in found.effects] == ["chirp"]
    assert found.after["chirp.c"] == pytest.approx(20.0, abs=0.1) and found.after["a"] == pytest.approx(1.2, rel=0.005)
    without(monkeypatch)
    assert not diagnose(problem, draws=39).effects


def test_what_the_first_fits_bring_near_the_noise_does_not_grow(monkeypatch):
    def fail(*_, **__):
        raise AssertionError

    monkeypatch.setattr(refining, "growing", fail)
    found = diagnose(Swing({"a": 1.0, "wind.c": 1.0}), draws=39)
    assert [t.candidate.name for t in found.effects] == ["wind"]


@pytest.mark.parametrize("together", [True, False])
def test_where_nothing_is_named_from_a_base_that_is_led_away_fits_grow_at_last(together, monkeypatch):
    monkeypatch.setattr(refining, "leaves_much", lambda lab, errors: False)  # as after first fits that came nearer
    problem = Swing({"a": 1.2, "chirp.c": 20.0}, together=together)
    monkeypatch.setattr(next_effect, "LED_AWAY", 2.0)
    assert not diagnose(problem, draws=39).effects
    monkeypatch.setattr(next_effect, "LED_AWAY", 1.1)
    found = diagnose(problem, draws=39)
    assert [t.candidate.name for t in found.effects] == ["chirp"]
    assert found.after["chirp.c"] == pytest.approx(20.0, abs=0.1)


def test_what_had_no_first_fit_may_grow_at_last(monkeypatch):
    """There may have been no time for it, or no hope by the directions at the base."""
    contest = contests.contest

    def without_chirp(*given, **options):
        fits = contest(*given, **options)
        return fits._replace(best={key: fit for key, fit in fits.best.items() if key != "chirp"})

    monkeypatch.setattr(refining, "leaves_much", lambda lab, errors: False)
    monkeypatch.setattr(contests, "contest", without_chirp)
    monkeypatch.setattr(next_effect, "LED_AWAY", 1.1)
    found = diagnose(Swing({"a": 1.2, "chirp.c": 20.0}), draws=39)
    assert [t.candidate.name for t in found.effects] == ["chirp"]


@pytest.mark.parametrize("together", [True, False])
def test_where_the_base_fit_is_astray_fits_grow_after_the_first(together, monkeypatch):
    """They set the pace of the others then; where these cost nothing, they come after all of them."""
    monkeypatch.setattr(contests, "LEADERS", 1)
    problem = Swing({"a": 1.2, "chirp.c": 20.0}, together=together)
    search = next_effect.new_search(problem)
    base = base_fits.base_fit(search)
    assert search.begun["a"] == pytest.approx(1.6, abs=0.2), "the phase of the first quarter, the chirp's too"
    assert refining.is_astray(search, base.fit, base.floor)
    events, grow, fits = [], refining.growing, Laboratory.fits
    monkeypatch.setattr(refining, "growing", lambda *args, **o: events.append("growing") or grow(*args, **o))
    monkeypatch.setattr(Laboratory, "fits", lambda self, *args, **o: events.append("fits") or fits(self, *args, **o))
    look = next_effect.first_look(search, base.fit, base.floor)
    assert look.contest.best["chirp"][1].point["chirp.c"] == pytest.approx(20.0, abs=0.2)
    assert events.count("growing") == 1
    after = len(events) - 1 - events.index("growing")
    assert after == 4 if together else after > 4
    search.begun, search.seen = {"a": base.fit.point["a"]}, None
    assert not refining.is_astray(search, base.fit, base.floor)


def test_an_early_floor_weighs_nothing_later():
    problem = Swing({"a": 1.0})
    search = next_effect.new_search(problem)
    floor = base_fits.early(search.lab, search.lab.noise(), 0.4)
    here = floor.whitener(search.lab.parts)(np.ones(len(T)), 0)
    assert here[T <= 0.01 + 0.4 * 0.99] == pytest.approx(1.0 / NOISE) and not here[T > 0.41].any()
    assert floor.weight[1] is not None and (floor.weight[1] > 0).all(), "what is held out is scored whole"


def test_few_candidates_grow_where_every_point_costs(monkeypatch):
    monkeypatch.setattr(refining, "ONE_BY_ONE", 2)
    told = []
    problem = Swing({"a": 1.2, "chirp.c": 20.0})
    search = next_effect.new_search(problem, tell=told.append)
    base = base_fits.base_fit(search)
    grown = refining.growing(search, base.fit, base.floor, problem.candidates)
    (line,) = (t for t in told if t.startswith("growing fits of"))
    assert line.count(",") == 1 and "chirp" in grown
    assert grown["chirp"][1].cost == pytest.approx(search.lab.costs([grown["chirp"][1].point], base.floor)[0])


@pytest.mark.parametrize("together", [True, False])
def test_one_of_many_parameters_does_not_grow_where_every_point_costs(together):
    told = []
    problem = Swing({"a": 1.2, "chirp.c": 20.0}, together=together)
    search = next_effect.new_search(problem, tell=told.append)
    base = base_fits.base_fit(search)
    grown = refining.growing(search, base.fit, base.floor, problem.candidates)
    (line,) = (t for t in told if t.startswith("growing fits of"))
    assert ("tide" in line) is together and "chirp" in grown


@pytest.mark.parametrize(("over", "horizons"), [(False, 4), (True, 1)])
def test_growing_fits_end_with_the_time(over, horizons, monkeypatch):
    problem = Swing({"a": 1.2, "chirp.c": 20.0})
    search = next_effect.new_search(problem)
    base = base_fits.base_fit(search)
    asked, fits = [], search.lab.fits
    monkeypatch.setattr(type(search.lab.budget), "ends", lambda self, share=1.0: over)
    monkeypatch.setattr(Laboratory, "fits", lambda self, *args, **options: asked.append(1) or fits(*args, **options))
    grown = refining.growing(search, base.fit, base.floor, problem.candidates)
    assert len(asked) == horizons
    for c, fit in grown.values():
        assert fit.cost == pytest.approx(search.lab.costs([fit.point], base.floor)[0]), c.key


PAIR = {"a": 1.21, "chirp.c": 19.1, "jerk.c": 21.5}
"""Two effects of which neither, alone, comes near to what they do together."""


@pytest.mark.slow
def test_two_effects_grow_together_where_neither_is_named_alone(monkeypatch):
    problem = Swing(PAIR, together=True, jerk=True)
    found = diagnose(problem, draws=39)
    assert {t.candidate.name for t in found.effects} == {"chirp", "jerk"}
    assert dict(found.after) == pytest.approx(PAIR, rel=0.02)
    assert comparing.is_noise(next_effect.new_search(problem).lab, np.square(list(found.errors["after"].values())))
    monkeypatch.setattr(attribution, "by_growing", lambda *_: None)
    alone = diagnose(problem, draws=39)
    assert alone.answer == "unknown" and not alone.effects


def test_two_that_grow_together_take_the_place_of_one_that_was_named(monkeypatch):
    truth = {"a": 1.23, "chirp.c": -17.0, "jerk.c": -17.6}
    problem = Swing(truth, together=True, jerk=True)
    found = diagnose(problem, draws=39)
    assert {t.candidate.name for t in found.effects} == {"chirp", "jerk"}
    monkeypatch.setattr(attribution, "by_growing", lambda *_: None)
    assert [t.candidate.name for t in diagnose(problem, draws=39).effects] == ["chirp"]


def test_pairs_do_not_grow_where_little_is_left_or_late(monkeypatch):
    def fail(*_):
        raise AssertionError

    monkeypatch.setattr(refining, "growing_pairs", fail)
    found = diagnose(Swing({"a": 1.2, "chirp.c": 20.0}, together=True, jerk=True), draws=39)
    assert [t.candidate.name for t in found.effects] == ["chirp"]
    monkeypatch.setattr(pairs, "IN_TIME", -1.0)
    monkeypatch.setattr(base_fits, "STEPWISE_ONE_BY_ONE", 6)
    late = diagnose(Swing(PAIR, jerk=True), draws=39, seconds=1e6)
    assert late.answer == "unfinished" and not late.effects and "two effects that grow together" in late.left_out


@pytest.mark.parametrize("together", [True, False])
def test_enough_iterations_at_a_horizon_follow_two_effects(together):
    problem = Swing(PAIR, together=together, jerk=True)
    search = next_effect.new_search(problem)
    base = base_fits.base_fit(search)
    made = refining.growing_pairs(search, {**base.fit.point, "a": 1.0}, base.floor)
    assert {c.name for c in made[0].candidates} == {"chirp", "jerk"} and comparing.is_noise(
        search.lab, search.lab.mean_squares([made[0].fit.point], base.floor)[0]
    )


def test_pairs_that_cost_least_go_on(monkeypatch):
    monkeypatch.setattr(refining, "PAIRS", refining.PAIRS._replace(pairs=2))
    problem = Swing(PAIR, together=True, jerk=True)
    search = next_effect.new_search(problem)
    base = base_fits.base_fit(search)
    asked, fits = [], search.lab.fits
    monkeypatch.setattr(search.lab, "fits", lambda requests, *args, **o: asked.append(len(requests)) or fits(requests, *args, **o))
    made = refining.growing_pairs(search, base.fit.point, base.floor)
    firsts, together, *later = asked
    assert firsts == 3 and together == 3 and max(later) <= 2, "three small candidates and as many pairs, each once"
    assert {c.name for c in made[0].candidates} == {"chirp", "jerk"} and made[0].fit.cost == min(pair.fit.cost for pair in made)


def test_a_base_that_was_looked_at_without_growing_fits_grows_once_when_it_is_asked_again(monkeypatch):
    search = next_effect.new_search(Swing({"a": 1.2, "chirp.c": 20.0}))
    base = base_fits.base_fit(search)
    grown, grow = [], refining.growing
    monkeypatch.setattr(refining, "growing", lambda *args, **o: grown.append(1) or grow(*args, **o))
    first = next_effect.first_look(search, base.fit, base.floor, grows=False)
    assert not first.grown and not grown and not comparing.is_noise(search.lab, first.least[0])
    again = next_effect.first_look(search, base.fit, base.floor)
    assert again.grown and grown == [1] and comparing.is_noise(search.lab, again.least[0])
    assert again.contest.best["chirp"][1].point["chirp.c"] == pytest.approx(20.0, abs=0.2)
    assert next_effect.first_look(search, base.fit, base.floor) is again
