"""A diagnosis that has to come to its end: what it says then, and what it leaves out."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from neuido.discrepancy import store
from neuido.discrepancy.inference import discretisation
from neuido.discrepancy.inference.laboratory import Laboratory
from neuido.discrepancy.inference.search import attribution, base_fits, next_effect
from neuido.discrepancy.inference.search.attribution import diagnose
from neuido.discrepancy.problems.body import body_problem
from neuido.discrepancy.report import next_experiment
from neuido.discrepancy.store import AFTER, LEAST_SEARCH, SEARCH, Budget
from neuido.discrepancy.workflow import restricted
from tests import command
from tests.discrepancy import made
from tests.discrepancy.inference.test_rounds import Line


class Clock:
    """Seconds that go on by themselves, one a look."""

    def __init__(self, step: float) -> None:
        self.now, self.step = 0.0, step

    def __call__(self) -> float:
        self.now += self.step
        return self.now


def test_a_step_ends_at_its_share_of_the_work():
    spent = [40.0]
    limit = Budget(100.0, spent=lambda: spent[0], clock=Clock(1e9))
    assert not limit.skips("first", 0.5) and not limit.cut and limit.ended_by == ""
    spent[0] = 60.0
    assert limit.skips("first", 0.5) and limit.left_out.pop() == "first" and limit.ended_by == "effort"
    assert not limit.over and not limit.skips("this") and limit.left_out == []
    spent[0] = 101.0
    assert limit.over and limit.skips("this") and limit.skips("that") and limit.skips("this")
    assert limit.left_out == ["this", "that"] and not limit.ends(math.inf)
    limit.conclude()
    assert not limit.over, "the last fit is no part of it"


def test_the_time_ends_all_steps_alike():
    """No share of a clock decides what a search does."""
    clock = Clock(0.0)
    limit = Budget(seconds=100.0, clock=clock)
    clock.now = 100.0 * SEARCH
    assert not limit.over and not limit.skips("this", 0.1)
    clock.now += 1.0
    assert limit.over and limit.skips("this") and limit.cut and limit.ended_by == "time" and not limit.ends(math.inf)
    limit.conclude()
    assert not limit.over
    clock.now = 101.0
    assert limit.over


def test_the_time_of_others_does_not_count(monkeypatch):
    elapsed, used = Clock(0.0), Clock(0.0)
    monkeypatch.setattr(store.time, "monotonic", elapsed)
    monkeypatch.setattr(store.time, "process_time", used)
    clock = store.own_clock()
    elapsed.now, used.now = 20.0, 3.0  # beside other processes
    assert clock() == 3.0
    elapsed.now, used.now = 20.0, 35.0  # two threads
    assert clock() == 20.0


def test_where_a_simulation_is_slow_the_search_is_stopped_earlier():
    """So that what follows it has the time that it takes there."""
    clock = Clock(0.0)
    for pace, share in ((0.01, SEARCH), (0.15, 1.0 - AFTER * 0.15 / 100.0), (1.0, LEAST_SEARCH)):
        limit = Budget(seconds=100.0, clock=clock, pace=lambda pace=pace: pace)
        assert limit.share == pytest.approx(share)
        limit.conclude()
        assert limit.share == 1.0


def told(passes: float, clock: Clock, monkeypatch, seconds: float = 1000.0):
    """What a search by two methods says, what it left out, and what it ran."""
    monkeypatch.setattr(attribution, "Budget", lambda work, **options: Budget(work, **(options | {"clock": clock})))
    problem = Line(lambda t: 3.0 * t + 2.0 * np.sin(9.0 * t) + 0.3 * np.sin(33 * t), wiggle=0.1, solvers=(0, 1), together=False)
    found = diagnose(problem, draws=19, passes=passes, seconds=seconds)
    return found.answer, found.left_out, found.after, [w.simulations for w in found.work.values()], found.budget.ended_by


@pytest.mark.parametrize("passes", [150.0, *(pytest.param(n, marks=pytest.mark.slow) for n in (600.0, math.inf))])
def test_the_speed_of_a_machine_changes_nothing(passes, monkeypatch):
    """Neither where the work is enough nor where it is not; a clock that stops the search gives `unfinished`, whatever it found."""
    fast = told(passes, Clock(0.0), monkeypatch)
    looks = Clock(1.0)
    told(passes, looks, monkeypatch, seconds=math.inf)
    slow = 0.75 * SEARCH * 1000.0 / looks.now  # it ends three quarters of the way to where the time is up
    assert told(passes, Clock(slow), monkeypatch) == fast
    assert (fast[0] == "unfinished") is (fast[-1] == "effort") is (passes < math.inf)
    answer, left_out, *_, ended_by = told(passes, Clock(10.0 * slow), monkeypatch)
    assert answer == "unfinished" and left_out and ended_by == "time"


@pytest.mark.slow
def test_what_takes_long_after_the_search_is_left_out_too(block, monkeypatch):
    """A class whose next experiment would be simulated past the end."""
    clock = Clock(0.0)
    monkeypatch.setattr(attribution, "Budget", lambda work, **options: Budget(work, **(options | {"clock": clock})))
    found = diagnose(restricted(body_problem(block), "drag_linear,drag_quadratic"), draws=39, most=1, seconds=60.0)
    found.rounds[0].members = found.rounds[0].trials[:2]
    assert next_experiment.propose(found) is not None and found.left_out == ()
    clock.now = 61.0
    assert next_experiment.propose(found) is None and found.left_out == ("the next experiment",)


def test_the_floor_is_the_same_after_the_search_has_ended(block):
    """The motions under other settings are refitted whatever is left to do it: left as they are, any residual would lie within them."""
    laboratory = Laboratory(replace(body_problem(block), solvers=(0,)))
    point = dict(laboratory.as_declared)
    floor, _ = discretisation.stand(laboratory, point)
    free = laboratory.problem.declared
    before = discretisation.floors(laboratory, point, free, floor)
    laboratory.budget = Budget(0.0, spent=lambda: 1.0, seconds=1.0, clock=Clock(1e6))
    assert laboratory.budget.ends() and laboratory.budget.cut
    np.testing.assert_array_equal(discretisation.floors(laboratory, point, free, floor), before)
    assert (before < laboratory.noise_squares + floor.spread_squares(laboratory.parts)).all()


def test_without_a_limit_nothing_is_left_out():
    clock = Clock(1e9)
    assert not Budget(clock=clock).over and not Budget(spent=lambda: 1e30, clock=clock).skips("this")


@pytest.fixture(scope="module")
def block(tmp_path_factory):
    return made.experiment(tmp_path_factory.mktemp("budget") / "block", {"drag_linear.k": 3.0})


@pytest.mark.parametrize("step", [0.0, 1e6])
@pytest.mark.slow
def test_a_search_without_time_answers_from_its_first_fits(step, block, monkeypatch):
    """The direction of a drag is all but exact, so that even the start of its fit is worth naming; nothing is refined, and it is told."""
    monkeypatch.setattr(attribution, "Budget", lambda work, **options: Budget(work, **(options | {"clock": Clock(step)})))
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
    monkeypatch.setattr(attribution, "Budget", lambda work, **options: Budget(work, **(options | {"clock": clock})))
    sought, finished = next_effect.find, base_fits.finished

    def late(self, *args, **options):
        found = sought(self, *args, **options)
        clock.now = 0.9 * 60.0
        return found

    def seen(self, stand):
        over.append(self.budget.over)
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
    status, _, err = command.run(capsys, *asked, "--effort", "some")
    assert (status, len(err.splitlines())) == (2, 1) and "effort = 'some' is not known" in err
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
