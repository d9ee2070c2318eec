"""Decisions from stored fits: as those that were made live, and what a density needs of the data."""

import json
from dataclasses import replace

import numpy as np
import pytest

from neuido.commands.demo.closed_loop import record
from neuido.discrepancy.inference.calibration import Calibration
from neuido.discrepancy.inference.evidence import evidences, judged
from neuido.discrepancy.inference.journal import from_json, to_json
from neuido.discrepancy.inference.search.attribution import diagnose
from neuido.discrepancy.inference.search.decision import decide
from neuido.discrepancy.inference.statistics import read_fits, write_fits
from neuido.discrepancy.problems.body import body_problem
from neuido.discrepancy.problems.problem import Problem
from neuido.discrepancy.workflow import restricted
from neuido.errors import UserError
from tests.discrepancy.inference.test_decisions import FLIES
from tests.discrepancy.inference.test_rounds import Line, Mixed, T, clipped
from tests.discrepancy.report.test_answer import Curve

TONES = {name: (np.sin(w * T), np.cos(w * T)) for name, w in (("low", 40), ("high", 62))}
PROBLEMS = {
    "effect": (lambda: Curve({"young": 1.5, "drag_linear.k": 0.8}), "effect"),
    "none": (lambda: Curve({"young": 1.5}), "none"),
    "clip": (lambda: Line(clipped, together=True), "effect"),
    "within the floor": (lambda: Line(lambda t: 3.0 * t, together=True), None),
    "two effects": (lambda: Mixed(TONES, {"low": 0.5, "high": 0.5}), "class"),
}


@pytest.fixture(scope="module", params=list(PROBLEMS))
def diagnosed(request):
    make, answer = PROBLEMS[request.param]
    found = diagnose(make(), keep=2, draws=39, statistics=True)
    assert answer is None or found.answer == answer
    return found


def test_the_replayed_decision_is_the_live_one(diagnosed, monkeypatch):
    case = from_json(to_json(diagnosed.case))
    assert case == diagnosed.case

    def fails(*_, **__):
        raise AssertionError("a replay simulates nothing")

    monkeypatch.setattr(Problem, "predict", fails)
    decision = decide(case)
    assert decision.differs == ()
    assert (decision.answer, list(decision.why)) == (diagnosed.answer, diagnosed.why)
    assert list(decision.effects) == [t.candidate.key for t in diagnosed.effects]
    named = [r for r in diagnosed.rounds if r.chosen is not None]
    assert [set(c) for c in decision.classes] == [{t.candidate.name for t in r.members} for r in named]


def test_another_figure_gives_another_decision():
    case = diagnose(Curve({"young": 1.5, "drag_linear.k": 0.8}), draws=39).case
    (judged,) = case.judged
    fits = tuple(replace(fit, errors=judged.errors) for fit in judged.fits)  # no effect leaves less than the base
    decision = decide(replace(case, judged=(replace(judged, fits=fits),)))
    assert (decision.answer, decision.effects, decision.differs) == ("unknown", (), (0,))


def test_a_search_that_was_cut_off_names_nothing():
    case = diagnose(Curve({"young": 1.5, "drag_linear.k": 0.8}), draws=39).case
    assert decide(replace(case, facts={**case.facts, "cut": True})).answer == "unfinished"


def test_a_density_of_the_statistics_is_that_of_the_data(diagnosed, tmp_path):
    write_fits(tmp_path / "0.npz", diagnosed.case, diagnosed.statistics)
    case, fits = read_fits(tmp_path / "0.npz")
    assert case == diagnosed.case and fits
    assert {fit.record.effects for fit in fits} >= {fit.effects for fit in case.bases}
    problem = diagnosed.problem
    for fit in fits:
        for part, own in zip(diagnosed.parts, fit.parts, strict=True):
            y = problem.recordings[part.recording].y
            r = (problem.predict([fit.record.point], part.recording, fit.record.method)[0] - y)[part.rows]
            others = [s for s in problem.others(fit.record.method)]
            D = np.stack([problem.predict([fit.record.point], part.recording, s)[0][part.rows] - y[part.rows] - r for s in others] or
                         [np.zeros(len(r))], axis=1)[:, : own.settings.shape[1]]  # fmt: skip
            assert own.rows == len(r) and own.residual @ own.residual == pytest.approx(r @ r, rel=1e-5)
            np.testing.assert_allclose(own.settings.T @ own.residual, D.T @ r, rtol=1e-4, atol=1e-5 * float(r @ r))
            np.testing.assert_allclose(own.settings.T @ own.settings, D.T @ D, rtol=1e-4, atol=1e-8)
            assert own.slopes.shape[1] == len(fit.record.names)


@pytest.mark.slow
def test_a_body_is_decided_again_and_its_fits_have_an_evidence(tmp_path):
    problem = restricted(body_problem(record(tmp_path / "block", {"drag_linear.k": 3.0}, launches=FLIES, frames=13)), "drag_linear,gravity")
    found = diagnose(problem, draws=39, most=1, statistics=True)
    write_fits(tmp_path / "0.npz", found.case, found.statistics)
    case, fits = read_fits(tmp_path / "0.npz")
    decision = decide(case)
    assert (decision.answer, decision.effects, decision.differs) == (found.answer, ("drag_linear",), ())
    assert all(p.smooth.shape[1] == 72 and p.nuisances.shape[1] == 9 for fit in fits for p in fit.parts)
    verdict = judged(
        evidences(case, fits), Calibration(nulls=(0.0, 2.9, 26.5), effects=(0.0, 1.0))
    )  # quiet nulls; the table's are of other solvers
    assert verdict.answer == "effect" and verdict.sets == (("drag_linear",),)
    assert (tmp_path / "0.npz").stat().st_size < 1e5


def test_what_holds_no_fits_is_refused(tmp_path):
    (tmp_path / "0.npz").write_bytes(json.dumps({"case": 1}).encode())
    with pytest.raises(UserError, match="holds no stored fits"):
        read_fits(tmp_path / "0.npz")
