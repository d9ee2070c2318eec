"""A diagnosis that has to come to its end: what it says then, and what it leaves out."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from neuido.discrepancy.inference import discretisation
from neuido.discrepancy.inference.laboratory import Laboratory
from neuido.discrepancy.inference.search import attribution, base_fits, next_effect
from neuido.discrepancy.inference.search.attribution import diagnose
from neuido.discrepancy.problems.body import body_problem
from neuido.discrepancy.report import next_experiment
from neuido.discrepancy.store import AFTER, LEAST_SEARCH, SEARCH, Deadline
from neuido.discrepancy.workflow import restricted
from tests import command
from tests.discrepancy import made


class Clock:
    """Seconds that go on by themselves, one a look."""

    def __init__(self, step: float) -> None:
        self.now, self.step = 0.0, step

    def __call__(self) -> float:
        self.now += self.step
        return self.now


def test_the_search_has_a_share_and_the_end_the_rest():
    clock = Clock(0.0)
    limit = Deadline(100.0, clock=clock)
    clock.now = 100.0 * SEARCH
    assert not limit.over and not limit.skips("this") and limit.left_out == []
    assert Deadline(100.0, clock=Clock(0.0)).skips("first", 0.5) is False
    assert limit.skips("first", 0.5) and limit.left_out.pop() == "first"
    clock.now += 1.0
    assert limit.over and limit.skips("this") and limit.skips("that") and limit.skips("this")
    assert limit.left_out == ["this", "that"]
    limit.conclude()
    assert not limit.over
    clock.now = 101.0
    assert limit.over


def test_where_a_simulation_is_slow_the_search_ends_earlier():
    """So that what follows it has the time that it takes there."""
    clock = Clock(0.0)
    for pace, share in ((0.01, SEARCH), (0.15, 1.0 - AFTER * 0.15 / 100.0), (1.0, LEAST_SEARCH)):
        limit = Deadline(100.0, clock=clock, pace=lambda pace=pace: pace)
        assert limit.share == pytest.approx(share)
        limit.conclude()
        assert limit.share == 1.0


@pytest.mark.slow
def test_what_takes_long_after_the_search_is_left_out_too(block, monkeypatch):
    """A class whose next experiment would be simulated past the end."""
    clock = Clock(0.0)
    monkeypatch.setattr(attribution, "Deadline", lambda seconds, **options: Deadline(seconds, clock=clock, **options))
    found = diagnose(restricted(body_problem(block), "drag_linear,drag_quadratic"), draws=39, most=1, seconds=60.0)
    found.rounds[0].members = found.rounds[0].trials[:2]
    assert next_experiment.propose(found) is not None and found.left_out == ()
    clock.now = 61.0
    assert next_experiment.propose(found) is None and found.left_out == ("the next experiment",)


def test_the_floor_is_the_same_after_the_deadline(block):
    """The motions under other settings are refitted whatever the clock says: left as they are, any residual would lie within them."""
    laboratory = Laboratory(replace(body_problem(block), solvers=(0,)))
    point = dict(laboratory.as_declared)
    floor, _ = discretisation.stand(laboratory, point)
    free = laboratory.problem.declared
    before = discretisation.floors(laboratory, point, free, floor)
    laboratory.deadline = Deadline(1.0, clock=Clock(1e6))
    assert laboratory.deadline.ends() and laboratory.deadline.cut
    np.testing.assert_array_equal(discretisation.floors(laboratory, point, free, floor), before)
    assert (before < laboratory.noise_squares + floor.spread_squares(laboratory.parts)).all()


def test_without_a_limit_nothing_is_left_out():
    clock = Clock(1e9)
    assert not Deadline(clock=clock).over and not Deadline(math.inf, clock=clock).skips("this")


@pytest.fixture(scope="module")
def block(tmp_path_factory):
    return made.experiment(tmp_path_factory.mktemp("deadline") / "block", {"drag_linear.k": 3.0})


@pytest.mark.parametrize("step", [0.0, 1e6])
@pytest.mark.slow
def test_a_search_without_time_answers_from_its_first_fits(step, block, monkeypatch):
    """The direction of a drag is all but exact, so that even the start of its fit is worth naming; nothing is refined, and it is told."""
    monkeypatch.setattr(attribution, "Deadline", lambda seconds, **options: Deadline(seconds, clock=Clock(step), **options))
    problem = restricted(body_problem(block), "drag_linear,viscosity_shear,time_force")
    found = diagnose(problem, draws=39, most=2, seconds=60.0)
    assert math.isfinite(found.errors["after"]["drop"]) and found.evaluations > 0
    if step == 0.0:
        assert found.left_out == () and [t.candidate.name for t in found.effects] == ["drag_linear"]
        assert found.after["drag_linear.k"] == pytest.approx(3.0, rel=0.05)
    else:
        assert {"the declared model again", "refining the best fits"} <= set(found.left_out)
        assert found.answer == "unfinished" and found.effects == [] and not any("drag" in name for name in found.after)
        assert [t.candidate.name for t in found.leads] == ["drag_linear"]
        assert all(np.isfinite(found.intervals[name]).all() for name in found.intervals)


@pytest.mark.parametrize("settled", [True, False])
@pytest.mark.slow
def test_the_last_fit_has_what_is_left_of_the_time(settled, block, monkeypatch):
    """When the search ends with an effect named, that is fitted to its end, and nothing is looked for beside it."""
    clock, over, asked = Clock(0.0), [], []
    monkeypatch.setattr(attribution, "Deadline", lambda seconds, **options: Deadline(seconds, clock=clock, **options))
    sought, finished = next_effect.find, base_fits.finished

    def late(self, *args, **options):
        found = sought(self, *args, **options)
        clock.now = 0.9 * 60.0
        return found

    def seen(self, stand):
        over.append(self.deadline.over)
        return finished(self, stand)

    monkeypatch.setattr(next_effect, "find", late)
    monkeypatch.setattr(base_fits, "finished", seen)
    monkeypatch.setattr(attribution, "two_effects", lambda search, *rest: asked.append(rest) or (search, []))
    problem = restricted(body_problem(block), "drag_linear,viscosity_shear")
    noise = 1.0 if settled else 0.25  # stated too small, it is never reached
    recordings = tuple(replace(r, noise=noise * r.noise) for r in problem.recordings)
    found = diagnose(replace(problem, recordings=recordings, solvers=(0,)), draws=39, most=2, seconds=60.0)
    assert over == [False] and not asked
    if settled:
        assert found.answer == "effect" and found.left_out == ()
        assert found.after["drag_linear.k"] == pytest.approx(3.0, rel=0.02)
    else:
        assert found.answer == "unfinished" and found.left_out == ("a further effect",)
        assert found.leads[0].fit.point["drag_linear.k"] == pytest.approx(3.0, rel=0.05)


@pytest.mark.slow
def test_more_minutes_go_on_from_there(block, tmp_path, capsys):
    out = tmp_path / "out"
    asked = ["diagnose", block.folder, "--out", out, "--draws", "19", "--device", "cpu", "--progress", "false"]
    asked += ["--effects", "drag_linear,viscosity_shear"]
    status, _, err = command.run(capsys, *asked, "--minutes", "-1")
    assert (status, len(err.splitlines())) == (2, 1) and "minutes = -1.0 must not be negative" in err
    status, told, _ = command.run(capsys, *asked, "--minutes", "0.0001")
    content = json.loads((out / "diagnosis.json").read_text())
    assert status == 0 and content["left_out"] and "with more minutes goes on" in told
    page = (out / "report.html").read_text()
    assert (
        content["answer"] == "unfinished" and content["effects"] == content["rejected"] == [] and told.startswith("The search was cut off")
    )
    assert (out / ".work").is_dir() and "nothing is named yet" in page and ">Rejected</h3>" not in page
    status, told, _ = command.run(capsys, *asked, "--minutes", "0")
    content = json.loads((out / "diagnosis.json").read_text())
    assert status == 0 and content["left_out"] == [] and content["effects"][0]["name"] == "drag_linear" and "more minutes" not in told
    assert not (out / ".work").exists()
