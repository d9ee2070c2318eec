"""Units in the cells of a table, and columns named by a letter or a component, are read by kind or refused by name."""

import numpy as np
import pytest

import neuido
from neuido.data.importers.machines.testing_machine import Specimen
from neuido.errors import UserError

pytest.importorskip("pint")
STRAIN = np.linspace(0, 0.4, 21)
STRETCH = 1 + STRAIN
STRESS = 3e5 * (STRETCH - STRETCH**-2)
"""Nominal [Pa]; the true one is STRETCH times it, the second Piola-Kirchhoff stress the STRETCH-th part."""
GREEN = (STRETCH**2 - 1) / 2
SPECIMEN = Specimen("50 mm", "10 mm", "2 mm")


def table(path, head, *columns, separator=";"):
    rows = (separator.join(cell if isinstance(cell, str) else f"{cell:.9f}" for cell in row) for row in zip(*columns))
    path.write_text("\n".join([head.replace(";", separator), *rows, ""]))
    return path


def cells(values, form, decimal="."):
    return [form.format(value).replace(".", decimal) for value in values]


def same(folder, stress="nominal_stress"):
    (test,) = neuido.read_material_tests(folder).tests
    np.testing.assert_allclose(test.path[:, 0], STRETCH, atol=1e-6)
    np.testing.assert_allclose(test.stress[:, 0], STRESS * (STRETCH if stress == "true_stress" else 1), rtol=1e-4, atol=10)


UNITS = {
    "percent": ("Strain;Stress", cells(100 * STRAIN, "{:.6f} %"), cells(STRESS / 1e6, "{:.9f} MPa"), ","),
    "without a blank": ("Strain;Stress", cells(100 * STRAIN, "{:.6f}%"), cells(STRESS / 1e6, "{:.9f}MPa"), ";"),
    "decimal commas": ("Extension;Load", cells(50 * STRAIN, "{:.6f} mm", ","), cells(20e-6 * STRESS, "{:.9f} N", ","), ";"),
    "one of the columns": ("Extension;Load (N)", cells(50 * STRAIN, "{:.6f} mm"), cells(20e-6 * STRESS, "{:.9f}"), "\t"),
    "ranges that change": (
        "Extension;Load",
        cells(50 * STRAIN, "{:.6f} mm"),
        [f"{s:.6f} N" if s > 1 else f"{1e3 * s:.6f} mN" for s in 20e-6 * STRESS],
        ";",
    ),
    "a texture analyser": ("Distance (mm);Force (g)", cells(50 * STRAIN, "{:.6f}"), cells(20e-6 * STRESS / 9.80665e-3, "{:.7f}"), ","),
    "a number before the table": ("Max;40 %\nStrain;Stress", cells(100 * STRAIN, "{:.6f} %"), cells(STRESS, "{:.3f} Pa"), ";"),
}


@pytest.mark.parametrize("kind", UNITS)
def test_units_in_cells(tmp_path, kind):
    head, strain, stress, separator = UNITS[kind]
    path = table(tmp_path / "a.csv", head, strain, stress, separator=separator)
    neuido.import_file(path, tmp_path / "out", specimen=SPECIMEN if "Load" in head or "Force" in head else None)
    same(tmp_path / "out")


@pytest.mark.parametrize(
    ("changed", "words"), [("20.0", r"row 12: the cell '20.0' has no unit, and others of its column have %"), ("20 mm", "is not in %")]
)
def test_a_cell_without_its_unit_is_refused(tmp_path, changed, words):
    strain = cells(100 * STRAIN, "{:.6f} %")
    strain[10] = changed
    path = table(tmp_path / "a.csv", "Strain;Stress", strain, cells(STRESS, "{:.3f} Pa"))
    with pytest.raises(UserError, match=words):
        neuido.import_file(path, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_track_with_units_in_cells(tmp_path):
    t = np.arange(31) / 30
    x = np.stack([2 * t, 1 + 4 * t - 4.905 * t**2], 1)
    path = table(tmp_path / "a.csv", "t;x;y", cells(1e3 * t, "{:.6f} ms"), cells(100 * x[:, 0], "{:.6f} cm"), cells(x[:, 1], "{:.9f} m"))
    neuido.import_file(path, tmp_path / "out")
    (track,) = neuido.read_tracks(tmp_path / "out").recordings
    np.testing.assert_allclose(track.t, t, atol=1e-8)
    np.testing.assert_allclose(track.x, x, atol=1e-7)


@pytest.mark.parametrize(
    ("head", "path", "stress", "options", "kind"),
    [
        ("stretch;P (kPa)", STRETCH, STRESS / 1e3, {}, ""),
        ("lambda;P [N]", STRETCH, 20e-6 * STRESS, {"specimen": SPECIMEN}, ""),
        ("F11;P11 (Pa)", STRETCH, STRESS, {}, ""),
        ("F11 (N);Strain", 20e-6 * STRESS, STRAIN, {"specimen": SPECIMEN}, ""),
        ("NE11;P11 (Pa)", STRAIN, STRESS, {}, ""),
        ("LE11;S11 (Pa)", np.log(STRETCH), STRESS * STRETCH, {}, "true_stress"),
        ("Green-Lagrange strain;2nd Piola-Kirchhoff stress (kPa)", GREEN, STRESS / STRETCH / 1e3, {}, ""),
        ("Green strain (%);Stress (Pa)", 100 * GREEN, STRESS, {}, ""),
        ("E11;P11 (Pa)", GREEN, STRESS, {"columns": {"green_strain": "E11"}}, ""),
        ("E11;S11 (Pa)", GREEN, STRESS / STRETCH, {"columns": {"green_strain": "E11", "second_piola_stress": "S11 (Pa)"}}, ""),
        ("E11;S11 (Pa)", STRAIN, STRESS * STRETCH, {"columns": {"strain": "E11", "true_stress": "S11 (Pa)"}}, "true_stress"),
        ("Microstrain;Stress (Pa)", 1e6 * STRAIN, STRESS, {}, ""),
        ("µε;Stress (Pa)", 1e6 * STRAIN, STRESS, {}, ""),
        ("Mikrodehnung;Spannung (Pa)", 1e6 * STRAIN, STRESS, {}, ""),
    ],
)
def test_letters_and_components(tmp_path, head, path, stress, options, kind):
    neuido.import_file(table(tmp_path / "a.csv", head, path, stress), tmp_path / "out", **options)
    same(tmp_path / "out", kind)


@pytest.mark.parametrize(
    ("head", "path", "words"),
    [
        ("E11;P11 (Pa)", STRAIN, r"'E11' may be a Green or an engineering strain: give --columns\.green_strain 'E11' or --columns\.strain"),
        ("stretch;S11 (Pa)", STRETCH, r"may be a second Piola-Kirchhoff or a true stress: give --columns\.second_piola_stress"),
        ("strain;P (Pa)", STRAIN, "has no stress or force"),
        ("stretch;P", STRETCH, r"column 'P' has no unit: give --units\.nominal_stress Pa"),
        ("Green strain;Stress (Pa)", STRAIN - 0.6, "a Green strain is above -0.5"),
    ],
)
def test_what_a_name_leaves_open_is_asked_for(tmp_path, head, path, words):
    with pytest.raises(UserError, match=words):
        neuido.import_file(table(tmp_path / "a.csv", head, path, STRESS), tmp_path / "out")
    assert not (tmp_path / "out").exists()
