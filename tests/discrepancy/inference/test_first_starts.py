"""Where the fit of the declared model begins: a stiffness that is only guessed may be wrong by its order of magnitude."""

import numpy as np
import pytest

from neuido.discrepancy.inference.laboratory import Laboratory
from neuido.discrepancy.inference.search import base_fits, next_effect
from neuido.discrepancy.problems.problem import Parameter, Problem, Recording

T = np.linspace(0.0, 3.0, 120)
TRUE, NOISE = 40.0, 1e-3


class Spring(Problem):
    """A mass of 1 kg that swings on a spring, y = cos(sqrt(k) t), below the stability limit of a time step of 10 ms."""

    def __init__(self, guess: float) -> None:
        rng = np.random.default_rng(0)
        y = np.cos(np.sqrt(TRUE) * T)
        made = tuple(
            Recording(name, role, y + NOISE * rng.standard_normal(len(T)), NOISE, np.zeros(len(T), int), T)
            for name, role in (("one", "fit"), ("two", "held_out"))
        )
        super().__init__("spring", "rmse", "m", (Parameter("stiffness", "N/m", guess, 0.1, 1e-3, 1e9, log=True),), (), (), made)

    def predict(self, points, recording, setting=0):
        stiffness = [p.get("stiffness", self.declared[0].value) for p in points]
        return np.stack([np.cos(np.sqrt(k) * T) if self.margin({"stiffness": k}) >= 0 else np.full(len(T), np.nan) for k in stiffness])

    def margin(self, point, setting=0):
        return np.log(2 / 0.01) - 0.5 * np.log(point.get("stiffness", self.declared[0].value))


@pytest.mark.parametrize("factor", [1.0, 2.0, 0.5, 10.0, 0.1, 25.0, 0.04])
def test_a_guess_of_another_order_reaches_the_truth(factor):
    found = base_fits.base_fit(next_effect.new_search(Spring(factor * TRUE)))
    assert found.fit.point["stiffness"] == pytest.approx(TRUE, rel=1e-3)


def test_a_good_guess_begins_where_it_did():
    lab = Laboratory(Spring(1.1 * TRUE))
    starts = base_fits.scaled_starts(lab, lab.noise())
    assert starts == [{}, {"stiffness": pytest.approx(0.55 * TRUE)}, {"stiffness": pytest.approx(2.2 * TRUE)}]
