"""What a search moves quickly: longer steps and coarser meshes in the place of the suggested ones, and what is made of it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from neuido.discrepancy.inference import discretisation
from neuido.discrepancy.inference.laboratory import Laboratory
from neuido.discrepancy.inference.search import base_fits, choosing, next_effect, refining
from neuido.discrepancy.inference.search.attribution import diagnose
from neuido.discrepancy.problems.body import BodyProblem, body_problem
from neuido.discrepancy.problems.settings import EVERY, SETTINGS, SOLVERS
from neuido.discrepancy.store import CachedProblem
from tests.discrepancy import made
from tests.discrepancy.inference.test_rounds import Line, clipped


@pytest.fixture(scope="module")
def experiment(tmp_path_factory):
    return made.experiment(tmp_path_factory.mktemp("quick"), {}, frames=8, side=5)


def with_step(experiment, factor):
    """The problem of the same bodies with another suggested step."""
    recordings = tuple(replace(r, scene=replace(r.scene, dt=factor * r.scene.dt)) for r in experiment.recordings)
    return body_problem(replace(experiment, recordings=recordings))


def test_the_longer_step_is_the_longest_that_leaves_a_margin_and_keeps_the_frames(experiment):
    problem = body_problem(experiment)
    every = round(experiment.recordings[0].frame_interval / experiment.recordings[0].scene.dt)
    bears = np.exp(problem.margin({}))
    for factor in (1.0, 0.5, 2.0):
        other = with_step(experiment, factor)
        able = [n for n in (4, 2) if n <= bears / factor / 1.8 and round(every / factor) % n == 0]
        quick = EVERY[other.quick(SOLVERS[0])]
        assert quick.dt == (able[0] if able else 1.0)
        assert (quick.cells, quick.lift) == (1.0, 0.0)
    assert EVERY[with_step(experiment, 0.5).quick(0)].dt > 1.0, "half of a step that is stable bears another one"


def test_only_methods_have_quick_settings(experiment):
    problem = with_step(experiment, 0.5)
    assert EVERY[problem.quick(SOLVERS[1])].elements < 1.0
    quick = [problem.quick(s) for s in SOLVERS]
    assert [problem.quick(s) for s in quick] == quick
    assert [problem.quick(s) for s in range(len(SETTINGS)) if s not in SOLVERS] == [s for s in range(len(SETTINGS)) if s not in SOLVERS]
    alone = replace(problem, settings=1, solvers=(0,))
    assert alone.quick(0) == 0, "without other settings nothing takes up what a longer step does"
    assert [CachedProblem(problem, None).quick(s) for s in SOLVERS] == quick
    assert 0 in problem.others(quick[0]) and SOLVERS[1] in problem.others(quick[1])
    assert all(s not in problem.others(0) for s in quick[:1]), "its differences are not weighed"


def test_a_longer_step_moves_as_the_suggested_one_but_for_what_half_of_it_does(experiment):
    problem = with_step(experiment, 0.5)
    quick = problem.quick(0)
    assert problem.effort(0, quick) == pytest.approx(problem.effort(0) / EVERY[quick].dt)
    here, half, long = (problem.predict([{}], 0, s)[0] for s in (0, 1, quick))
    d, q = half - here, long - here
    assert 0.0 < np.linalg.norm(q) < 1.5 * EVERY[quick].dt * np.linalg.norm(d)


@pytest.mark.parametrize("solver", [*SOLVERS, "quick"], ids=["material points", "finite elements", "quick"])
@pytest.mark.parametrize("regular", [True, False], ids=["frames on substeps", "between substeps"])
def test_what_reads_the_first_part_of_a_recording_simulates_no_more(solver, regular, experiment):
    problem = with_step(experiment, 0.5)
    if not regular:
        moved = tuple(replace(r, t=torch.cat([r.t[:3], r.t[3:] + 3e-4])) for r in problem.measured)
        problem = replace(problem, measured=moved)
    setting = problem.quick(0) if solver == "quick" else solver
    whole = problem.predict([{}], 0, setting)[0]
    times, efforts = problem.recordings[0].times, [problem.effort(0, setting)]
    for share in (1.0, 0.8, 0.6, 0.4, 0.25):
        early = problem.early(setting, share)
        assert problem.early(setting, share - 0.01) == early or share == 1.0
        (found,) = CachedProblem(problem, None).predict([{}], 0, early)
        read = times <= times.min() + share * np.ptp(times)
        np.testing.assert_array_equal(found[read], whole[read])
        assert np.isfinite(found).all() and CachedProblem(problem, None).early(setting, share) == early
        efforts.append(problem.effort(0, early))
    assert efforts[0] == efforts[1] and np.all(np.diff(efforts[1:]) < 0) and efforts[-1] < 0.5 * efforts[0]
    assert problem.margin({}, early) == problem.margin({}, setting) and "first 25% of the time" in problem.setting_name(early)


def test_growing_fits_read_no_more_than_their_horizon(experiment, monkeypatch):
    """They end where fits of whole motions end, for a part of the work."""
    problem = with_step(experiment, 0.5)
    work, ends = [], []
    for whole in (True, False):
        with monkeypatch.context() as patch:
            if whole:
                patch.setattr(BodyProblem, "early", lambda self, setting, share: setting)
            lab = Laboratory(problem)
            floor = lab.noise()
            first = base_fits.first_part(lab, problem.declared, {"young": 7e4}, floor)
            ((_, fit),) = base_fits.grown(lab, [(problem.declared, first)], floor)
            ends.append(fit)
            work.append(lab.memo.effort)
    assert ends[0].point == ends[1].point and ends[0].cost == ends[1].cost and ends[1].setting == lab.own
    assert work[1] < 0.8 * work[0]


@pytest.mark.parametrize("why", ["margin", "run"])
def test_directions_of_nuisances_are_those_of_the_own_setting_where_a_longer_step_does_not_run(why, experiment, monkeypatch):
    problem = with_step(experiment, 0.5)
    quick, several = problem.quick(0), BodyProblem.predict_several
    assert EVERY[quick].dt > 1.0
    with monkeypatch.context() as patch:
        patch.setattr(BodyProblem, "quick", lambda self, setting: setting)
        own = discretisation.nuisance_directions(Laboratory(problem), {}, [0, 1])
    asked = []

    def without(self, asks):
        """The second recording fails with the longer step."""
        for (_, n, setting), rows in zip(asks, several(self, asks), strict=True):
            asked.append((n, setting))
            yield np.full_like(rows, np.nan) if setting == quick and n == 1 else rows

    monkeypatch.setattr(BodyProblem, "predict_several", without)
    if why == "margin":
        monkeypatch.setattr(BodyProblem, "margin", lambda self, point, setting=0: 0.2 if setting == quick else 1.0)
    found = discretisation.nuisance_directions(Laboratory(problem), {}, [0, 1])
    assert asked == ([(0, quick), (1, quick), (1, 0)] if why == "run" else [(0, 0), (1, 0)])
    assert list(found) == [0, 1]
    assert np.abs(own[1]).max() > 1e-4
    np.testing.assert_array_equal(found[1], own[1])
    assert np.isfinite(found[0]).all()


class Hurried(Line):
    """Setting 2 stands in for 0: the same lines, three parts in a thousand too steep, and counted."""

    def __init__(self, y, **options):
        super().__init__(y, **options)
        self.__dict__["counts"] = dict.fromkeys(range(3), 0)

    def quick(self, setting):
        return 2 if setting == 0 else setting

    def others(self, setting):
        return [s for s in (0, 1) if s != setting]

    def predict(self, points, recording, setting=0):
        self.counts[setting] += len(points)
        return 1.003 * super().predict(points, recording, 0) if setting == 2 else super().predict(points, recording, setting)


@pytest.mark.parametrize("together", [True, False])
def test_a_quick_search_ends_with_the_setting_that_predicts(together):
    plain, quick = (diagnose(kind(clipped, together=together), keep=1) for kind in (Line, Hurried))
    assert [t.candidate.name for t in quick.effects] == [t.candidate.name for t in plain.effects] == ["clip"]
    assert quick.after == pytest.approx(plain.after, rel=2e-3)
    assert quick.effects[0].fit.setting == 0
    assert quick.errors["after"] == pytest.approx(plain.errors["after"], rel=0.02)
    counts = quick.problem.counts
    assert counts[2] > counts[0]


def test_what_came_close_ends_under_the_own_setting_and_the_rest_does_not():
    search = next_effect.new_search(Hurried(lambda t: 3.0 * t + 0.8 * t**2), keep=7)
    start = base_fits.base_fit(search)
    look = next_effect.first_look(search, start.fit, start.floor)
    assert search.lab.setting == 0
    fits = {key: fit for key, (_, fit) in look.contest.best.items()}
    assert fits["square"].setting == 0 and {fit.setting for fit in fits.values()} == {0, 2}
    least = min(fit.cost for fit in fits.values())
    assert all(fit.cost > 3.9 * least for fit in fits.values() if fit.setting == 2)
    # each is measured by what made it
    far = next(entry for entry in look.contest.best.values() if entry[1].setting == 2)
    (stand,) = refining.measured(search.lab, {"far": far}, start.floor)
    with search.lab.under(2):
        (squares,) = search.lab.mean_squares([far[1].point], start.floor)
    here = search.lab.mean_squares([far[1].point], start.floor)[0]
    assert np.all(stand.errors <= np.maximum(squares, here) * (1 + 1e-9))


class Exact(Hurried):
    """With a method beside it that differs by a wiggle alone."""

    def __init__(self, y, **options):
        super().__init__(y, solvers=(0, 1), **options)

    def predict(self, points, recording, setting=0):
        lower = [{**p, "a": p.get("a", 1.0) - 2.0 * (setting == 1)} for p in points]
        return super().predict(lower, recording, setting)


@pytest.mark.parametrize(("law", "asked"), [(lambda t: 3.0 * t + 0.8 * t**2, False), (lambda t: 3.0 * t + 0.3 * np.sin(9 * t) * t, True)])
def test_no_other_method_is_begun_where_one_simulation_leaves_the_noise(law, asked, monkeypatch):
    begun, real = [], base_fits.base_fit
    monkeypatch.setattr(base_fits, "base_fit", lambda search, near=None: begun.append(search.lab.setting) or real(search, near))
    monkeypatch.setattr(choosing, "CLEAR", 0.0)
    diagnose(Exact(law), keep=3)
    assert begun == ([0, 1] if asked else [0])


@pytest.mark.parametrize("second", [0.45, 0.65, 0.0])
def test_a_second_effect_near_the_noise_is_told_by_one_simulation(second):
    """What the first one leaves is 1.4 or 1.9 times the noise, a fiftieth or less of what the settings differ by."""
    problem = Exact(lambda t: 3.0 * t + 2.0 * t**2 + second * t**3, wiggle=1.0)
    object.__setattr__(problem, "candidates", tuple(c for c in problem.candidates if len(c.parameters) == 1))
    found = diagnose(problem, keep=3)
    assert sorted(t.candidate.name for t in found.effects) == (["cube", "square"] if second else ["square"])
    if second:
        assert found.after["cube.c"] == pytest.approx(second, rel=0.3)


def test_a_base_is_looked_at_once():
    search = next_effect.new_search(Hurried(lambda t: 3.0 * t + 0.8 * t**2), keep=3)
    start = base_fits.base_fit(search)
    look = next_effect.first_look(search, start.fit, start.floor)
    counts = dict(search.lab.problem.counts)
    assert next_effect.first_look(search, start.fit, start.floor) is look and search.lab.problem.counts == counts
    first = next_effect.find(search, start.fit, start.floor, [])
    assert search.asked is first and search.seen is look
    next_effect.find(search, first.chosen.fit, first.floor, [first.chosen])
    assert search.asked is first and search.seen is look, "a second effect is looked for anew"
