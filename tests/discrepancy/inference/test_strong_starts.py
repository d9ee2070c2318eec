"""Where fits of an effect begin that is no direction: a part of a body many times as stiff as the rest."""

import math
from dataclasses import replace

import numpy as np
import pytest

from neuido.discrepancy.inference import comparing, directions
from neuido.discrepancy.inference.laboratory import Laboratory
from neuido.discrepancy.inference.least_squares import Fit
from neuido.discrepancy.inference.search import base_fits, contests, next_effect
from neuido.discrepancy.inference.search.attribution import diagnose
from neuido.discrepancy.inference.search.contests import LED_FAR
from neuido.discrepancy.problems.problem import Candidate, Parameter, Problem, Recording

S = np.linspace(-1.0, 1.0, 200)
NOISE = 0.01
PLACES = (-0.6, 0.0, 0.6)


class Bar(Problem):
    """Stretches of a bar under two loads, 1 / E(s), with a part of another stiffness about `part.c`."""

    def __init__(self, truth, *, far: float = math.log(8.0)) -> None:
        size = Parameter("part.log_ratio", "1", 0.0, 0.5, -4.0, 4.0)
        place = Parameter("part.c", "m", PLACES[0], 0.1, -1.0, 1.0)
        starts = tuple({size.name: 1.0, place.name: c} for c in PLACES)
        part = Candidate(
            "part", (size, place), starts, "internal modes", sizes=(size.name,), apart=size.name, far=far, beside={"young": -1 / 6}
        )
        slope = Parameter("slope.k", "1", 0.0, 0.3, -3.0, 3.0)
        candidates = (part, Candidate("slope", (slope,), ({slope.name: 0.3},), "internal modes"))
        rng = np.random.default_rng(0)
        recordings = tuple(
            Recording(name, role, stretch(truth) + NOISE * rng.normal(size=len(S)), NOISE, np.zeros(len(S), int), S)
            for name, role in (("one", "fit"), ("two", "held_out"))
        )
        declared = (Parameter("young", "Pa", 1.0, 0.15, 0.01, 100.0, log=True),)
        super().__init__("bar", "rmse", "1", declared, (), candidates, recordings)

    def predict(self, points, recording, setting=0):
        return np.stack([stretch(p) for p in points])


def stretch(p):
    bump = np.exp(-(((S - p.get("part.c", 0.0)) / 0.15) ** 2))
    return np.exp(-p.get("slope.k", 0.0) * S - p.get("part.log_ratio", 0.0) * bump) / p.get("young", 1.0)


TRUTH = {"young": 0.5, "part.log_ratio": math.log(15.0), "part.c": 0.5}


def test_each_sign_begins_at_its_best_place():
    problem = Bar(TRUTH)
    search = next_effect.new_search(problem)
    base = base_fits.base_fit(search)
    part = problem.candidates[0]
    stiff, soft = contests.strong(search.lab, part, part.starts, base.fit.point, base.floor)
    assert stiff["part.log_ratio"] == pytest.approx(math.log(8.0)) and stiff["part.c"] == 0.6
    assert soft["part.log_ratio"] == pytest.approx(-math.log(8.0))
    young = base.fit.point["young"]
    assert stiff["young"] == pytest.approx(young * 8.0 ** (-1 / 6)) and soft["young"] == pytest.approx(young * 8.0 ** (1 / 6))
    others = [{**stiff, "part.c": c} for c in PLACES if c != 0.6]
    assert search.lab.costs([stiff], base.floor)[0] < min(search.lab.costs(others, base.floor))


def test_fits_begin_there(monkeypatch):
    begun = []
    request = Laboratory.request

    def seen(self, parameters, start, **options):
        begun.append(start)
        return request(self, parameters, start, **options)

    monkeypatch.setattr(Laboratory, "request", seen)
    found = diagnose(Bar(TRUTH), draws=39)
    assert found.after["part.log_ratio"] == pytest.approx(math.log(15.0), abs=0.2) and found.after["part.c"] == pytest.approx(0.5, abs=0.01)
    assert any(p.get("part.log_ratio") == pytest.approx(math.log(8.0)) for p in begun)
    begun.clear()
    diagnose(Bar(TRUTH, far=0.0), draws=39)
    assert not any(p.get("part.log_ratio") == pytest.approx(math.log(8.0)) for p in begun)


def test_large_sizes_and_the_declared_values_are_tried_where_the_base_fit_went_far():
    """A large slope changes the mean stretch too, for which the declared model's fit takes another modulus."""
    problem = Bar({"young": 1.0, "slope.k": 2.4})
    search = next_effect.new_search(problem)
    base = base_fits.base_fit(search)
    slope = problem.candidates[1]
    slopes = directions.slopes(search.lab, problem.declared, base.fit.point, search.lab.scored_recordings)
    begin = (slope, {**base.fit.point, "slope.k": 0.3}, None)
    assert comparing.moved(search.lab, base.fit.point) > LED_FAR
    kept, least = contests.sized(search.lab, [begin], base.fit, slopes, base.floor)
    half_way = math.sqrt(base.fit.point["young"])  # the stated modulus is one
    assert [place for _, place, _ in kept] == [{"young": pytest.approx(half_way), "slope.k": pytest.approx(6 * 0.3)}]
    places = [place for _, place, _ in contests.tried(search.lab, begin, base.fit, led_far=True)]
    assert {"young": 1.0, "slope.k": pytest.approx(6 * 0.3)} in places
    assert least["slope"] < 0.3
    near = Fit({"young": 1.0}, ("young",), 1.0, np.zeros(1), 1, True)  # where it did not go far these are the base's
    kept, _ = contests.sized(search.lab, [(slope, {"young": 1.0, "slope.k": 0.3}, None)], near, slopes, base.floor)
    assert [place for _, place, _ in kept] == [{"young": 1.0, "slope.k": pytest.approx(1.8)}]


def test_a_size_is_tried_with_what_goes_with_it():
    """A modulus that falls is at its mean where the declared model's fit takes one for the whole time."""
    problem = Bar({"young": 1.0, "slope.k": 2.4})
    search = next_effect.new_search(problem)
    (slope,) = (replace(c, beside={"young": 0.5}) for c in problem.candidates if c.key == "slope")
    base = Fit({"young": 3.0}, ("young",), 1.0, np.zeros(1), 1, True)
    begin = (slope, {"young": 3.0, "slope.k": 0.3}, None)
    without = [place for _, place, _ in contests.tried(search.lab, (problem.candidates[1], *begin[1:]), base, led_far=False)]
    places = [place for _, place, _ in contests.tried(search.lab, begin, base, led_far=False)]
    assert places[: len(without)] == without
    along = {place["slope.k"]: place["young"] for place in places[len(without) :]}
    sizes = [sign * f * 0.3 for f in (1, math.sqrt(6), 6) for sign in (1, -1)]
    assert along == pytest.approx({size: 3.0 * math.exp(0.5 * size) for size in sizes})


def test_the_secant_to_a_size_is_its_slope():
    problem = Bar({"young": 1.0, "slope.k": 0.5})
    search = next_effect.new_search(problem)
    base = base_fits.base_fit(search)
    slope, part = problem.candidates[1], problem.candidates[0]
    slopes = directions.slopes(search.lab, problem.declared, base.fit.point, search.lab.scored_recordings)
    point = {**base.fit.point, "slope.k": 0.01}
    J = contests.secant(search.lab, slope, point, base.fit.point, slopes, base.floor)
    p = slope.parameters[0]
    exact = -S * stretch(base.fit.point) * p.scale
    assert J[:, 1] == pytest.approx(base.floor.whitener(search.lab.parts)(exact, 0), rel=0.02, abs=0.02 * np.abs(J[:, 1]).max())
    assert contests.secant(search.lab, slope, {**point, "young": 3.0}, base.fit.point, slopes, base.floor) is None
    assert contests.secant(search.lab, part, {**base.fit.point, **part.starts[0]}, base.fit.point, slopes, base.floor) is None
