"""Intervals where slopes say nothing: at a stationary angle, and where another parameter makes up for one."""

import math

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from neuido.discrepancy.inference.floors import Stand
from neuido.discrepancy.inference.laboratory import Laboratory
from neuido.discrepancy.inference.search.intervals import NORMAL, intervals, profiled
from neuido.discrepancy.problems.problem import Parameter, Problem, Recording

T = np.linspace(0.0, 1.0, 60)
NOISE = 0.05


class Fibre(Problem):
    """y = c cos(angle)^2 t + t^2 sin(angle)^2, which does not change to first order at an angle of zero."""

    def __init__(self):
        free = (
            Parameter("c", "Pa", 1.0, 0.1, 0.0, 30.0),
            Parameter("angle", "rad", 0.3, 0.2, -2 * math.pi, 2 * math.pi),
        )
        draws = np.random.default_rng(0).standard_normal((2, len(T)))
        recordings = tuple(
            Recording(role, role, self.curve(1.0, 0.0) + NOISE * own, NOISE, np.zeros(len(T), int), T, "stated")
            for role, own in zip(("fit", "held_out"), draws, strict=True)
        )
        super().__init__("fibre", "rmse", "Pa", free, (), (), recordings, 1)

    def curve(self, c, angle):
        return c * np.cos(angle) ** 2 * T + np.sin(angle) ** 2 * T**2

    def predict(self, points, recording, setting=0):
        return np.array([self.curve(p.get("c", 1.0), p.get("angle", 0.3)) for p in points])


@pytest.fixture(scope="module")
def fitted():
    problem = Fibre()
    lab = Laboratory(problem)
    floor = lab.noise()
    (fit,) = lab.fits([lab.request(problem.declared, {"c": 1.0, "angle": 0.0})], floor)  # the slope there is zero, and so it stays
    return problem, lab, Stand(fit, floor, lab.mean_squares([fit.point], floor)[0])


def least_over_c(problem, angle):
    """The misfit at an angle, by the c that suits it best, in units of the noise."""
    y = problem.recordings[0].y
    return minimize_scalar(lambda c: float(np.sum((problem.curve(c, angle) - y) ** 2)) / NOISE**2, (0.5, 1.5)).fun


def test_a_profile_ends_where_the_misfit_has_risen_as_chance_allows(fitted):
    problem, lab, stand = fitted
    left = least_over_c(problem, stand.fit.point["angle"])
    low, high = intervals(lab, stand.fit, stand.floor, stand.errors)["angle"]
    assert low < 0 < high and high - low < math.pi / 2
    for end in (low, high):
        rise = least_over_c(problem, end) - left
        assert math.sqrt(rise / (left / len(T))) == pytest.approx(NORMAL, rel=0.05)


def test_a_parameter_that_the_angle_makes_up_for_is_profiled_too(fitted):
    problem, lab, stand = fitted
    low, high = profiled(lab, stand.fit, stand.floor, [problem.parameter("c")], [problem.parameter("angle")])["c"]
    alone = NORMAL * NOISE / math.sqrt(np.sum(T**2))
    assert low < 1.0 < high and 2 * alone < high - low < 1.0


def test_a_direction_without_influence_is_every_direction_of_an_axis(fitted):
    problem, lab, stand = fitted
    problem.curve, still = (lambda c, angle: c * T), problem.curve
    try:
        lab = Laboratory(problem)
        low, high = profiled(lab, stand.fit, stand.floor, [problem.parameter("angle")])["angle"]
    finally:
        problem.curve = still
    assert high - low == pytest.approx(math.pi)
