"""An error of the length scale as a rival of the effects that a track is said to lack."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

import neuido
from neuido.data.measured.track import read_tracks
from neuido.discrepancy.problems.tracks.track_problem import track_problems
from neuido.discrepancy.report import next_experiment
from tests.discrepancy import made

SAID = "A scale error would explain it as well"


def diagnosed(folder, *, drag, scale, effects):
    made.track(folder, drag=drag)
    for file in folder.glob("*.csv"):
        rows = np.loadtxt(file, delimiter=",", skiprows=1)
        rows[:, 1:] *= scale
        np.savetxt(file, rows, delimiter=",", header="t,x,y", comments="")
    out = folder.with_name("answer")
    neuido.diagnose(folder, out=out, effects=effects, device="cpu")
    content = json.loads((out / "diagnosis.json").read_text())
    return content.get("bodies", [content])[0]


@pytest.mark.parametrize("scale", [0.96, 1.04])
def test_a_gravity_that_a_wrong_ruler_makes_says_so(tmp_path, scale):
    found = diagnosed(tmp_path / "balls", drag=0.0, scale=scale, effects=["gravity", "drag_quadratic"])
    assert [e["name"] for e in found["effects"]] == ["gravity"]
    assert found["scale_error"] == pytest.approx([scale - 1] * 2, abs=0.004)
    words = next(line for line in found["words"] if SAID in line)
    assert f"% too {'long' if scale > 1 else 'short'}: measure a known length" in words


def test_a_drag_that_no_scale_imitates_does_not(tmp_path):
    found = diagnosed(tmp_path / "balls", drag=0.12, scale=1.0, effects=["gravity", "drag_quadratic"])
    assert [e["name"] for e in found["effects"]] == ["drag_quadratic"]
    assert "scale_error" not in found and not any(SAID in line for line in found["words"])


def test_a_ruler_is_not_off_by_a_sixth(tmp_path):
    """The prior of a calibration counts: no ruler explains 16 %."""
    found = diagnosed(tmp_path / "balls", drag=0.0, scale=1.16, effects=["gravity", "drag_quadratic"])
    assert [e["name"] for e in found["effects"]] == ["gravity"]
    assert "scale_error" not in found
    assert found["gravity"] == pytest.approx({"declared": 9.81, "found": 1.16 * 9.81, "length": 0.16, "time": 1.16**-0.5 - 1}, rel=0.03)
    said = r"lengths measured 1[56]? ?% too long or times measured [67]\.?\d* % too short would look the same"
    assert any(re.search(said, line) for line in found["words"])


def test_a_proposal_tells_something(tmp_path):
    """No drop tells a gravity from a constant acceleration along it."""
    found = diagnosed(tmp_path / "balls", drag=0.0, scale=1.16, effects=["gravity", "uniform_acceleration"])
    for e in found["effects"]:
        assert set(e["class"]) <= {"gravity", "uniform_acceleration"}
    proposal = found["next_experiment"]
    assert proposal is None or proposal["expected_log_odds"] >= next_experiment.TELLS


def test_a_drag_below_that_of_a_sphere_is_told(tmp_path):
    """An answer that leaves a flying ball no drag names what is wrong with the data, or is wrong."""
    found = diagnosed(tmp_path / "balls", drag=0.0, scale=1.16, effects=["gravity", "drag_quadratic"])
    (row,) = (row for row in found["power"] if row.get("ordinary"))
    assert row["up_to"] < row["ordinary"] and any("and these data exclude more than" in line for line in found["words"])


@pytest.mark.parametrize(("factor", "said"), [(100.0, "100 times longer"), (0.01, "100 times shorter"), (8.0, "")])
def test_a_recording_in_another_unit_is_told(tmp_path, factor, said):
    made.track(tmp_path / "balls", drag=0.0)
    tracks = read_tracks(tmp_path / "balls")
    first = tracks.recordings[0]
    odd = replace(first, name="odd", x=factor * first.x, role="held_out")
    (problem,) = track_problems(replace(tracks, recordings=(*tracks.recordings, replace(first, name="again"), odd)))
    words = problem.labels.get("unseen", "")
    assert (f"The path of odd is {said}" in words) if said else "path of" not in words
