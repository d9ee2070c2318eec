"""Predictions are computed once, and counted; fits that have lost stop, and the one that wins is not disturbed."""

import numpy as np
import pytest

from neuido.discrepancy.inference.least_squares import Race, levenberg_marquardt, run
from neuido.discrepancy.problems.planes.plane_problem import PlaneProblem
from neuido.discrepancy.problems.problem import Parameter, Problem, Recording
from neuido.discrepancy.problems.rollouts import BodyRollouts
from neuido.discrepancy.problems.specimens.material import MaterialProblem
from neuido.discrepancy.problems.tracks.track_problem import TrackProblem
from neuido.discrepancy.store import CachedProblem, Memo

T = np.linspace(0.0, 1.0, 40)


class Lines(Problem):
    """y = a t + b t^2 with a record of every point that was run."""

    def __init__(self, together: bool = True) -> None:
        y = 2.0 * T + 3.0 * T**2
        parameters = tuple(Parameter(name, "1", 0.5, 1.0, -9.0, 9.0) for name in "ab")
        super().__init__("lines", "rmse", "1", parameters, (), (), (Recording("r", "fit", y, 0.1, np.zeros(40, int), T),), settings=2)
        self.ran: list[tuple] = []

    def predict(self, points, recording, setting=0):
        self.ran += [(recording, setting, tuple(sorted(p.items()))) for p in points]
        return np.stack([p.get("a", 0.5) * T + p.get("b", 0.5) * np.sin(2 * T) ** setting * T**2 for p in points])


def test_a_point_is_run_once_for_each_setting():
    problem = Lines()
    memo = Memo(problem)
    one, two = {"a": 1.0, "b": 2.0}, {"b": 3.0, "a": 1.0}
    with memo.during("first"):
        rows = memo.predict([one, two, one], 0)
    assert np.array_equal(rows[0], rows[2])
    with memo.during("second"):
        again = memo.predict([dict(reversed(two.items())), {"a": 5.0}], 0)
        other = memo.predict([one], 0, 1)
    assert np.array_equal(again[0], rows[1])
    assert not np.array_equal(other[0], rows[0])
    assert len(problem.ran) == len(set(problem.ran)) == memo.simulations == 4
    assert (memo.work["first"].simulations, memo.work["first"].reused) == (2, 1)
    assert (memo.work["second"].simulations, memo.work["second"].reused) == (2, 1)
    assert memo.work["second"].effort == 2 * len(T)
    assert memo.predict([], 0).shape == (0, len(T))


def test_several_asks_at_once_are_those_one_after_the_other(tmp_path):
    asks = [
        ([{"a": 1.0}, {"a": 2.0}], 0, 0),
        ([{"a": 1.0}], 0, 1),
        ([], 0, 0),
        ([{"a": 2.0}, {"a": 3.0}], 0, 0),
        ([{"a": float(a)} for a in range(70)], 0, 1),
    ]
    plain = [Lines().predict(*ask) if ask[0] else np.empty((0, len(T))) for ask in asks]
    for problem in (Lines(), CachedProblem(Lines(), tmp_path), CachedProblem(Lines(), tmp_path)):
        memo = Memo(problem)
        for got, want in zip(memo.predict_several(asks), plain, strict=True):
            assert np.array_equal(got, want)
        assert (memo.simulations, memo.work["other"].reused) == (73, 2)
    assert problem.problem.ran == []  # all of it was kept
    assert problem.found > 0


def test_the_memory_is_bounded_and_an_answer_is_no_view():
    problem = Lines()
    memo = Memo(problem, limit=2 * T.nbytes)
    for a in (1.0, 2.0, 1.0, 3.0, 1.0, 2.0):  # 2 goes when 3 comes: 1 was asked for since
        memo.predict([{"a": a}], 0)[0][:] = np.nan
    assert [dict(key)["a"] for _, _, key in problem.ran] == [1.0, 2.0, 3.0, 2.0]
    assert all(np.isfinite(memo.predict([{"a": a}], 0)).all() for a in (1.0, 2.0))


@pytest.mark.parametrize("together", [True, False])
def test_both_ways_to_try_dampings_end_alike(together):
    problem = Lines()
    (fit,) = run(problem, [levenberg_marquardt(problem.declared, {}, together=together)], lambda r, n: r / 0.1, [0])
    assert fit.converged
    assert fit.point["a"] == pytest.approx(2.0, abs=1e-3)
    assert fit.point["b"] == pytest.approx(3.0, abs=1e-3)
    assert len(problem.ran) == fit.evaluations


def test_the_boldest_damping_alone_is_cheaper():
    counts = []
    for together in (True, False):
        problem = Lines()
        run(problem, [levenberg_marquardt(problem.declared, {}, together=together)], lambda r, n: r / 0.1, [0])
        counts.append(len(problem.ran))
    assert counts[1] < counts[0]


class Bounded(Lines):
    """It runs where a + 2 b <= 5, and not at the end of a free fit, a = 2 and b = 3."""

    def predict(self, points, recording, setting=0):
        rows = super().predict(points, recording, setting)
        rows[[self.margin(p) < 0 for p in points]] = np.nan
        return rows

    def margin(self, point, setting=0):
        return 5.0 - point.get("a", 1.0) - 2.0 * point.get("b", 1.0)


@pytest.mark.parametrize("together", [True, False])
def test_a_fit_goes_along_the_edge_of_what_runs(together):
    start = {"a": -4.0, "b": 4.48}  # next to the edge, and far from the best point on it

    def fit(**options):
        request = levenberg_marquardt(problem.declared, start, together=together, **options)
        return run(problem, [request], lambda r, n: r / 0.1, [0])[0]

    problem = Bounded()
    along = np.linspace(-5.0, 5.0, 20001)
    y = problem.recordings[0].y
    costs = [np.sum((a * T + (5.0 - a) / 2 * T**2 - y) ** 2) / 0.01 for a in along]
    best = float(along[int(np.argmin(costs))])
    found, stuck = fit(margin=problem.margin), fit()
    assert 0 <= problem.margin(found.point) < 0.03
    assert found.point["a"] == pytest.approx(best, abs=0.1)
    assert found.cost < 1.2 * min(costs) < 0.2 * stuck.cost
    counts = len(problem.ran)
    fit(margin=lambda point: np.inf)
    again = len(problem.ran) - counts
    fit()
    assert len(problem.ran) == counts + 2 * again, "where nothing is known of an edge a fit is as without one"


class Decays(Problem):
    """y = sum_k exp(-a_k t) / (k + 1), nonlinear in six parameters."""

    def __init__(self) -> None:
        self.true = np.array([0.5, 1.5, 3.0, 5.0, 8.0, 12.0])
        parameters = tuple(Parameter(f"a{k}", "1", 1.1 * v, 0.3, 0.0, 40.0) for k, v in enumerate(self.true))
        record = Recording("r", "fit", self.motion(self.true), 0.1, np.zeros(40, int), T)
        super().__init__("decays", "rmse", "1", parameters, (), (), (record,))

    @staticmethod
    def motion(a):
        return np.sum(np.exp(-np.outer(T, a)) / np.arange(1, 7), axis=1)

    def predict(self, points, recording, setting=0):
        return np.stack([self.motion([p.get(q.name, q.value) for q in self.declared]) for p in points])


def test_slopes_of_one_step_serve_the_next():
    problem = Decays()

    def fit(**options):
        return run(problem, [levenberg_marquardt(problem.declared, {}, **options)], lambda r, n: r / 1e-6, [0])[0]

    anew, kept = fit(together=True, iterations=40), fit(together=False, iterations=40)
    assert kept.cost < 1e-4 * fit(iterations=1).cost
    assert kept.cost < 3.0 * anew.cost + 1.0
    assert kept.evaluations < 0.6 * anew.evaluations


def test_slopes_that_are_given_save_a_round_and_wrong_ones_are_measured_anew():
    problem = Lines()
    right = np.stack([T, T**2], axis=1) / 0.1
    costs = {}
    for name, slopes in {"none": None, "right": right, "wrong": right[:, ::-1], "opposite": -right}.items():
        (fit,) = run(problem, [levenberg_marquardt(problem.declared, {}, together=False, slopes=slopes)], lambda r, n: r / 0.1, [0])
        assert fit.converged
        assert fit.point["a"] == pytest.approx(2.0, abs=1e-3), name
        assert fit.point["b"] == pytest.approx(3.0, abs=1e-3), name
        costs[name] = fit.evaluations
    assert costs["right"] < costs["none"]


def test_a_fit_that_cannot_catch_up_stops_and_the_others_do_not():
    def fits(race):
        problem = Lines()
        held = [problem.declared[0]], {"b": 9.0}  # its best is far above that of both parameters
        requests = [levenberg_marquardt(problem.declared, {}, race=race), levenberg_marquardt(*held, race=race, tolerance=0.0)]
        return run(problem, requests, lambda r, n: r / 0.1 + 1e-3, [0])

    free, raced = fits(None), fits(Race())
    assert raced[0].point == free[0].point
    assert raced[1].evaluations <= free[1].evaluations
    assert Race(1.0).lost([100.0, 50.0, 49.0], 9)
    assert Race(1.0).lost([100.0, 50.0, 50.0, 50.0], 9)
    assert not Race(1.0).lost([100.0, 50.0, 50.0], 9)  # the next step is less bold
    assert not Race(1.0).lost([100.0, 50.0, 20.0], 9)  # at this pace it ends below
    assert Race(1.0).lost([1e6, 1e5, 1e4], 9)  # no fit keeps this pace up
    assert not Race(1.0).lost([100.0, 90.0], 10)  # one iteration says little
    assert not Race().lost([100.0, 99.0, 98.0], 9)  # nobody is ahead


def test_the_store_passes_on_whatever_a_problem_answers():
    """`shown` and the errors of the instruments had been those of a problem without any, in every run of the command line."""
    kinds = (TrackProblem, MaterialProblem, PlaneProblem, BodyRollouts)
    asked = {name for kind in kinds for name in vars(kind) if not name.startswith("_") and name in vars(Problem)}
    assert {"shown", "instrument_errors", "noise_with"} <= asked <= set(vars(CachedProblem))
