"""Progress of a diagnosis: what is tried, what leads, and how much of the time is left."""

import csv
import time

import numpy as np

from neuido.discrepancy.diagnosis_log import Log
from neuido.discrepancy.inference.search.attribution import diagnose
from tests.discrepancy.report.test_answer import Curve


def rows(path) -> list[list[str]]:
    with path.open(newline="") as file:
        return list(csv.reader(file))[1:]


def test_a_plain_line_says_what_is_tried_what_leads_and_what_is_left(tmp_path):
    with Log(tmp_path / "log.csv", shown=False, begun=time.monotonic()) as log:
        log.begin("ball", 600.0)
        log.tick(7)
        log("fitting drag_linear, gravity")
        log.lead("time_force:harmonic", 0.0007, 0.04, "m")
        line = log.progress.line(time.monotonic())
        assert line.startswith("diagnosis: 7 simulations, ball: fitting drag_linear, gravity, ")
        assert "in the lead: a force that changes in time, harmonic, which leaves 0.700 mm of 40.0 mm; " in line
        assert line.endswith("10 min 0 s of the time left")
        assert log.progress.line(time.monotonic() + 700).endswith("the time is up: concluding")
        log.begin("", np.inf)
        assert "lead" not in log.progress.line(time.monotonic()) and "time" not in log.progress.line(time.monotonic())
    assert next(row[1:] for row in rows(tmp_path / "log.csv")) == ["ball", "fitting drag_linear, gravity", "7"]


def test_the_search_tells_what_leads(tmp_path):
    with Log(tmp_path / "log.csv", shown=False, begun=time.monotonic()) as log:
        log.begin("", 600.0)
        found = diagnose(Curve({"young": 1.5, "drag_linear.k": 0.8}), draws=39, tell=log, passes=1e4)
        share = found.budget.spent() / found.budget.work
        assert 0 < share < 1 and f"; {share:.0%} of the effort; " in log.progress.line(time.monotonic())
        assert log.progress.leads.startswith("in the lead: linear air drag, which leaves ")
    assert any("in the lead: linear air drag" in row[2] for row in rows(tmp_path / "log.csv"))
