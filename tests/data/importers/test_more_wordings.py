"""Tables that a new user tried: bars between columns, other words, two columns that contradict each other, and feet."""

import numpy as np
import pytest

import neuido
from neuido.data.importers.machines.testing_machine import Specimen
from neuido.data.measured.motion_plausibility import FOOT
from neuido.errors import PlausibilityWarning
from tests.data.importers.test_importing import FLIGHT, T

pytest.importorskip("pint")
STRAIN = np.linspace(0, 0.5, 21)
STRESS = 5e5 * (1 + STRAIN - (1 + STRAIN) ** -2)
"""Of a neo-Hookean strip [Pa]."""
SIZES = Specimen("50 mm", None, None, None, "20 mm^2")


def written(path, title, rows, mark):
    path.write_text("\n".join([title, *(mark.join(f"{value:.6f}" for value in row) for row in rows)]))
    return path


@pytest.mark.parametrize(
    ("title", "mark", "factors"),
    [("Displacement (mm)|Load (N)", "|", (50, 2e-5)), ("Verformung in %;Spannung in kPa", ";", (100, 1e-3)),
     ("Verformung [mm];Kraft [N]", ";", (50, 2e-5))],
)  # fmt: skip
def test_other_words(tmp_path, title, mark, factors):
    path = written(tmp_path / "a.csv", title, np.stack([factors[0] * STRAIN, factors[1] * STRESS], 1), mark)
    neuido.import_file(path, tmp_path / "a", specimen=SIZES)
    (test,) = neuido.read_material_tests(tmp_path / "a").tests
    np.testing.assert_allclose(test.path[:, 0], 1 + STRAIN, atol=1e-6)
    np.testing.assert_allclose(test.stress[:, 0], STRESS, atol=0.06)


@pytest.mark.parametrize(("factor", "said"), [(1.0, False), (2.0, True)])
def test_stress_and_force_that_contradict_each_other_are_said(tmp_path, factor, said):
    rows = np.stack([50 * STRAIN, 2e-5 * STRESS * factor, STRESS / 1e6], 1)
    path = written(tmp_path / "a.csv", "Crosshead (mm),Force (N),Stress (MPa)", rows, ",")
    lines = neuido.import_file(path, tmp_path / "a", specimen=SIZES)
    odd = [line for line in lines if "'Force (N)' over the cross-section of 20 mm^2 is 2 times column 'Stress (MPa)'" in line]
    assert len(odd) == said


def test_an_index_is_a_frame(tmp_path):
    path = written(tmp_path / "a.csv", "index,x,y", [(i, *x[:2]) for i, x in enumerate(FLIGHT)], ",")
    neuido.import_file(path, tmp_path / "a", frame_rate=1 / (T[1] - T[0]))
    (track,) = neuido.read_tracks(tmp_path / "a").recordings
    np.testing.assert_allclose(track.t, T, atol=1e-6)


@pytest.mark.parametrize(("unit", "said"), [(1.0, False), (FOOT, True)])
def test_feet_are_said(tmp_path, unit, said):
    path = written(tmp_path / "a.csv", "t,x,y", [(t, *(x[:2] / unit)) for t, x in zip(T, FLIGHT)], ",")
    lines = neuido.import_file(path, tmp_path / "a")
    assert any("are the positions in feet?" in line for line in lines) == said
    if said:
        with pytest.warns(PlausibilityWarning, match=r"scale: \{y: 0.3048\}, or --units.x ft"):
            neuido.read_tracks(tmp_path / "a")
        lines = neuido.import_file(path, tmp_path / "b", units={"x": "ft"})
        assert not any("in feet?" in line for line in lines)
