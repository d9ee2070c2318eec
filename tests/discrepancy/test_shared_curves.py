"""Faulty tracks and material tests that people sent, diagnosed: the right answer and error of each, and made ones of the same kinds."""

import numpy as np
import pytest
import yaml

import neuido
from neuido.data.measured.material_test import read_material_tests
from neuido.discrepancy.inference.search.attribution import diagnose
from neuido.discrepancy.problems.specimens.material import MaterialProblem
from neuido.discrepancy.problems.tracks.track_problem import track_problems

NOISE = 2e-3
"""Of the positions [m]."""


def nothing_found(folder):
    """Diagnose flights without drag: nothing is missing, and the flight held out is predicted to within the noise."""
    (problem,) = track_problems(folder)
    found = diagnose(problem, draws=39)
    assert found.answer == "none"
    assert found.errors["after"]["r1"] == pytest.approx(NOISE, rel=0.3)


@pytest.mark.parametrize("name", ["19-track-time-offset", "20-track-epoch-times"])
def test_cases_of_late_clocks(data_root, name):
    nothing_found(data_root / "cases" / name)


@pytest.mark.parametrize("origin", [0.0, -3.0, 12.3, 86399.5, 1.7e9])
def test_clocks_of_any_origin(tmp_path, origin):
    rng = np.random.default_rng(0)
    t = np.arange(40) / 30
    recordings = []
    for name, role, v in (("r0", "fit", (3.0, 5.0)), ("r1", "held_out", (2.5, 4.0))):
        x = np.stack([v[0] * t, 1.5 + v[1] * t - 4.905 * t**2], 1) + NOISE * rng.standard_normal((40, 2))
        np.savetxt(tmp_path / f"{name}.csv", np.c_[origin + t, x], delimiter=",", header="t,x,y", comments="", fmt="%.7f")
        recordings.append({"name": name, "body": "ball", "file": f"{name}.csv", "columns": {"t": "t", "x": "x", "y": "y"}, "role": role})
    content = {
        "format": "neuido-track/1", "name": "flights", "model": {"gravity": [0, -9.81, 0], "effects": {}, "free": []},
        "bodies": {"ball": {"mass": 0.0567, "diameter": 0.066}}, "recordings": recordings,
    }  # fmt: skip
    (tmp_path / "track.yaml").write_text(yaml.safe_dump(content))
    nothing_found(tmp_path)


@pytest.mark.slow
def test_case_of_unseen_markers(data_root):
    """Markers at the origin were not seen: the body lacks nothing, and has the modulus of which it was made."""
    with pytest.warns(UserWarning, match="count as not seen"):
        found = neuido.diagnose(data_root / "cases" / "27-experiment-marker-zeros", device="cpu")
    assert found.answer == "none"
    assert yaml.safe_load(found.model_after.read_text())["elasticity"]["young"] == pytest.approx(5e4, abs=1e3)


def test_case_of_a_biaxial_grid(data_root):
    """The noise is that of the stresses, not a share of their range; so nothing is found in an exact neo-Hooke solid."""
    problem = MaterialProblem(read_material_tests(data_root / "cases" / "24-material-biaxial-grid"))
    assert 1.5e3 < problem.recordings[0].noise < 3e3
    assert diagnose(problem, draws=39).answer in ("none", "insufficient")
