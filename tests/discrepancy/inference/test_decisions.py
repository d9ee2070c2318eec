"""Decisions on the smallest bodies that show them: one answer for each stage, and what "take the smallest fitted error" would say instead.

Each case is diagnosed twice, the second time with the decision replaced: no test, no floors, in each step the effect whose fit leaves
least, and all of them kept. What is asserted of the first must not hold of the second.
"""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch

from neuido.commands.demo.closed_loop import ELASTIC, Launch, record
from neuido.data.measured.experiment import Experiment
from neuido.data.measured.material_test import read_material_tests
from neuido.data.measured.track import read_tracks
from neuido.data.undeclared.motion import Solver, simulate_motion
from neuido.discrepancy.inference import comparing
from neuido.discrepancy.inference.floors import Round
from neuido.discrepancy.inference.search import attribution, next_effect
from neuido.discrepancy.inference.search.attribution import Diagnosis
from neuido.discrepancy.inference.search.search_state import Search
from neuido.discrepancy.problems.body import BodyProblem, body_problem
from neuido.discrepancy.problems.problem import Problem
from neuido.discrepancy.problems.specimens.material import MaterialProblem
from neuido.discrepancy.problems.tracks.track_problem import track_problems
from neuido.discrepancy.report import answer, residual
from neuido.discrepancy.report.answer_content import motions
from neuido.discrepancy.store import CachedProblem
from neuido.discrepancy.workflow import restricted
from neuido.errors import UserError
from neuido.types import Plane, Scene
from tests.discrepancy import made


def smallest_error(monkeypatch) -> None:
    """Replace the decision."""
    real = next_effect.find

    def smallest(search: Search, base, floor, found, leaders=None, **options) -> Round:
        result = real(search, base, floor, found, leaders, **options)
        result.chosen = min(result.trials, key=lambda t: t.fit.cost, default=None)
        result.members = [result.chosen] if result.chosen else []
        return result

    monkeypatch.setattr(next_effect, "find", smallest)
    monkeypatch.setattr(comparing, "is_noise", lambda *_, **__: False)
    monkeypatch.setattr(comparing, "is_settled", lambda *_, **__: False)


def says(d: Diagnosis) -> tuple[str, ...]:
    """The answer, and the effects that were added."""
    return d.answer, *(t.candidate.name for t in d.effects)


def both(problem: Problem, effects: str, folder: Path, monkeypatch, most: int) -> tuple[Diagnosis, Diagnosis]:
    """The diagnosis with the named candidates, and the same with the decision replaced."""
    folder.mkdir()
    cached = CachedProblem(restricted(problem, effects), folder)
    sound = attribution.diagnose(cached, draws=39, most=most)
    smallest_error(monkeypatch)
    monkeypatch.setattr(attribution, "CLEAR", 0.0)
    monkeypatch.setattr(attribution, "two_effects", lambda search, *rest: (search, []))
    monkeypatch.setattr(attribution, "drop", lambda search, at, floor, found: (at, found))
    monkeypatch.setattr(attribution, "narrow", lambda search, at, floor, found, rounds: (at, found))
    return sound, attribution.diagnose(cached, draws=39, most=most)


def over(friction: float) -> Scene:
    """A scene with a floor."""
    return Scene(cells=14, dt=1e-3, colliders=(Plane((0.0, 0.2, 0.0), (0.0, 1.0, 0.0), "separate", friction),))


FREE, WEIGHTLESS = Scene(cells=14, dt=1e-3), Scene(cells=14, dt=1e-3, gravity=(0.0, 0.0, 0.0))
FLIES = Launch("a", "fit", (1.2, 1.0, 0.3), 2.0, 4.0), Launch("b", "held_out", (-2.0, 0.2, -0.4), -2.0, -4.0)
SPINS = Launch("a", "fit", (0.0, 0.0, 0.0), spin=11.0), Launch("b", "held_out", (0.0, 0.0, 0.0), spin=-8.0)
TURNS = Launch("a", "fit", (0.8, 0.6, 0.2), spin=11.0), Launch("b", "held_out", (-1.0, 0.4, -0.3), spin=-8.0)
RINGS = Launch("a", "fit", (0.3, 0.5, 0.0), 1.0, 6.0), Launch("b", "held_out", (-0.3, 0.5, 0.0), -2.0, -8.0)
SLIDES = (
    Launch("a", "fit", (1.0, -0.3, 0.0), centre=(0.35, 0.36, 0.5)),
    Launch("b", "held_out", (-1.4, -0.3, 0.3), centre=(0.65, 0.36, 0.45)),
)
FALLS = Launch("a", "fit", (0.2, -2.5, 0.0), centre=(0.5, 0.4, 0.5)), Launch("b", "held_out", (-0.2, -3.0, 0.2), centre=(0.5, 0.42, 0.5))


class Case(NamedTuple):
    """A block of 125 particles on 14 cells."""

    truth: dict[str, float]
    launches: tuple[Launch, Launch]
    scene: Scene
    candidates: str
    most: int = 2
    frames: int = 13
    stage: str = ""
    """Of the weak residual, where noise alone must not explain it."""


CASES = {
    "flight": Case({"gravity.g": 5.0}, FLIES, FREE, "gravity,uniform_acceleration,time_force", 1, 17, "flight"),
    "rotation": Case({"drag_linear.k": 6.0}, SPINS, WEIGHTLESS, "drag_linear,viscosity_shear,stiffness_change", stage="rotation"),
    "internal modes": Case(
        {"viscosity_shear.eta": 200.0}, RINGS, FREE, "viscosity_shear,drag_linear,stiffness_change", 2, 13, "internal modes"
    ),
    "contact": Case({"friction.mu": 0.4}, SLIDES, over(0.0), "friction,drag_linear"),
    "spin": Case({"spin_decay.k": 6.0}, TURNS, FREE, "spin_decay,drag_linear,viscosity_shear", stage="rotation"),
    "size": Case({"swelling.rate": 0.6}, FLIES, FREE, "swelling,time_force,stiffness_change,viscosity_bulk"),
    "rest": Case({"yield.inverse": 1 / 3000}, FALLS, over(0.2), "yield,viscosity_shear"),
}


@pytest.mark.parametrize("stage", CASES)
@pytest.mark.slow
def test_each_stage_is_answered(stage, tmp_path, monkeypatch):
    case = CASES[stage]
    experiment = record(tmp_path / "block", case.truth, launches=case.launches, scene=case.scene, frames=case.frames)
    sound, smallest = both(body_problem(experiment), case.candidates, tmp_path / "runs", monkeypatch, case.most)
    ((key, value),) = case.truth.items()
    name = key.partition(".")[0]
    assert name in {t.candidate.name for t in sound.rounds[0].members}
    assert says(sound)[1:] == (name,)
    assert sound.after[key] == pytest.approx(value, rel=0.15)
    before, after = sound.errors["before"]["b"], sound.errors["after"]["b"]
    assert after < 1.3 * sound.floors["noise"] < before / 1.5
    assert says(smallest)[1:] != (name,)
    if case.stage:
        shown, left = excess(sound, case)
        assert shown > 5.0
        assert left < 2.0


def excess(d: Diagnosis, case: Case) -> tuple[float, float]:
    """Mean square of the residual over that of its noise in the case's stage of the fitted recording, before and after."""
    m = motions(d)[0]["a"]
    options = {"mass": 27.0, "sigma": d.rounds[0].floor.noise[0], "planes": case.scene.colliders, "margin": 1.5 * case.scene.dx}
    found = residual.stages(m["measured"], m["t"], m["before"], m["after"], **options)
    (own,) = (s for s in found if s.name == case.stage)
    return own.excess(own.before), own.excess(own.after)


@pytest.mark.slow
def test_nothing_is_missing(tmp_path, monkeypatch):
    experiment = record(tmp_path / "block", {}, launches=FLIES, frames=13)
    sound, smallest = both(body_problem(experiment), "drag_linear,gravity,viscosity_shear", tmp_path / "runs", monkeypatch, 1)
    assert says(sound) == ("none",)
    assert sound.errors["after"]["b"] < 1.3 * sound.floors["noise"]
    assert says(smallest) != ("none",)


@pytest.mark.parametrize("lost", [{1}, {0, 1}])
def test_a_recording_that_does_not_move_is_left_out_of_the_report(lost, tmp_path, monkeypatch):
    """A motion may fail alone that was finite beside others, with their inner steps."""
    problem = body_problem(record(tmp_path / "block", {}, launches=FLIES, frames=13))
    found = attribution.diagnose(restricted(problem, "drag_linear"), draws=39, most=1)
    original_move = BodyProblem._move

    def fails(self, runs, setting, **options):
        if lost & {n for _, n in runs}:
            raise UserError("the motion of scene 0 is not finite from step 420 of 840 on")
        return original_move(self, runs, setting, **options)

    monkeypatch.setattr(BodyProblem, "_move", fails)
    answer.write(tmp_path / "out", [(found, 1.0)], kind="experiment", device="cpu")
    content = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert content["answer"] == "none" and set(content["not_predicted"]) == {"ab"[n] for n in lost}
    assert content["error"]["after"]["by_recording"] == pytest.approx(found.errors["after"])
    page = (tmp_path / "out" / "report.html").read_text()
    assert page.count("is not finite from step 420") == len(lost) and "nan %" not in page
    assert [p.stem for p in (tmp_path / "out" / "predicted").iterdir()] == (["a"] if lost == {1} else [])


@pytest.mark.slow
def test_what_no_effect_explains_is_unknown(tmp_path, monkeypatch):
    """A body that swells, which is not among the candidates here, and many times the floor."""
    experiment = swollen(record(tmp_path / "block", {}, launches=FLIES, frames=13), 1.0)
    sound, smallest = both(body_problem(experiment), "drag_linear,gravity", tmp_path / "runs", monkeypatch, 1)
    assert says(sound) == ("unknown",)
    assert says(smallest) != ("unknown",)


def swollen(experiment: Experiment, rate: float) -> Experiment:
    """The same launches of a body that swells."""
    bodies = [r.body for r in experiment.recordings]
    interval, frames = experiment.recordings[0].frame_interval, len(experiment.recordings[0].t)
    solver = Solver("same", experiment.scene.cells, experiment.scene.dt)
    motion = simulate_motion(
        solver, experiment.scene, bodies, ELASTIC, {"swelling.rate": rate}, seconds=(frames - 1) * interval, interval=interval
    )
    rng = np.random.default_rng(4)
    made = []
    for r, x in zip(experiment.recordings, motion.x, strict=True):
        seen = x[:, r.track.numpy()]
        made.append(replace(r, x=torch.from_numpy(seen + r.noise * rng.standard_normal(seen.shape)).float()))
    return replace(experiment, recordings=tuple(made))


def material_test(folder: Path) -> Problem:
    made.material_test(folder)
    return MaterialProblem(read_material_tests(folder))


def track(folder: Path) -> Problem:
    made.track(folder)
    return track_problems(read_tracks(folder))[0]


@pytest.mark.parametrize(
    ("make", "name", "candidates"),
    [
        (material_test, "strain_stiffening", "strain_stiffening,second_invariant"),
        (track, "drag_quadratic", "drag_linear,drag_quadratic,gravity"),
    ],
)
def test_tests_and_tracks(make: Callable[[Path], Problem], name, candidates, tmp_path, monkeypatch):
    sound, smallest = both(make(tmp_path / "measured"), candidates, tmp_path / "runs", monkeypatch, 2)
    assert says(sound) == ("effect", name)
    assert says(smallest) != ("effect", name)
