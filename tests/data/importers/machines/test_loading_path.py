import numpy as np
import pytest

import neuido
from neuido.data.importers.machines.loading_path import MAX_ROWS, Preparation, holds_stress, loading_parts, prepare
from neuido.data.importers.machines.material_folder import modulus
from neuido.data.importers.machines.testing_machine import Specimen
from neuido.errors import UserError
from tests.data.importers.test_importing import write

pytest.importorskip("pint")
STRAIN = np.linspace(0, 0.1, 101)
YOUNG = 2e6


def test_slack_is_said_and_taken_up():
    """A specimen that hangs loose for 2 % strain."""
    stress = YOUNG * np.maximum(STRAIN - 0.02, 0.0)
    notes: list[str] = []
    prepare({"stretch": 1 + STRAIN, "nominal_stress": stress}, Preparation(), notes)
    assert "slack? (--zero toe)" in " ".join(notes)
    notes = []
    columns, _ = prepare({"stretch": 1 + STRAIN, "nominal_stress": stress}, Preparation(zero="toe"), notes)
    np.testing.assert_allclose(columns["nominal_stress"], YOUNG * (columns["stretch"] - 1), atol=1)
    assert columns["stretch"][0] == pytest.approx(1.0) and "shifted by 0.02, 20 rows before it left out" in " ".join(notes)
    notes = []
    prepare({"stretch": 1 + STRAIN, "nominal_stress": YOUNG * STRAIN}, Preparation(), notes)
    assert not any("slack" in note for note in notes)


def test_zero_at_the_first_row_and_at_a_preload():
    path, stress = 1.3 + STRAIN, 5e3 + YOUNG * STRAIN
    columns, _ = prepare({"stretch": path, "nominal_stress": stress}, Preparation(zero="first"), [])
    np.testing.assert_allclose(columns["stretch"], 1 + STRAIN)
    np.testing.assert_allclose(columns["nominal_stress"], YOUNG * STRAIN, atol=1e-6)
    raw = {"stretch": 1 + STRAIN, "nominal_stress": YOUNG * STRAIN}
    columns, _ = prepare(raw, Preparation(zero="20.001 kPa"), [])
    assert columns["stretch"][0] == 1.0 and columns["nominal_stress"][0] == pytest.approx(YOUNG * 0.011)
    columns, _ = prepare(raw, Preparation(zero="0.20001 N"), [], area=1e-5)
    assert columns["nominal_stress"][0] == pytest.approx(YOUNG * 0.011)


@pytest.mark.parametrize(
    ("how", "words"),
    [
        (Preparation(zero="0.5 N"), "--zero '0.5 N' is a force, and the table has stresses"),
        (Preparation(zero="5 GPa"), r"largest stress is 2e\+05 Pa, below this preload"),
        (Preparation(zero="soon"), "--zero 'soon' must be none, first, toe or a preload"),
        (Preparation(cycles="some"), "--cycles some is unknown"),
        (Preparation(average=0), "--average 0 must be"),
        (Preparation(average=50), "2 rows remain"),
        (Preparation(rows="90:92"), "leaves 2 of 101 data rows"),
        (Preparation(rows="a:b"), "must be START:STOP"),
        (Preparation(rows="::0"), "must be START:STOP"),
    ],
)
def test_options_that_cannot_be_followed(how, words):
    with pytest.raises(UserError, match=words):
        prepare({"stretch": 1 + STRAIN, "nominal_stress": YOUNG * STRAIN}, how, [])


def test_rows_means_and_thinning():
    n = 10 * MAX_ROWS
    time = 0.01 * np.arange(n)
    noise = np.random.default_rng(0).normal(0, 1e3, n)
    raw = {"log_strain": 0.01 * time, "true_stress": 1e4 * time + noise, "time": 5 + time}
    notes: list[str] = []
    columns, _ = prepare(raw, Preparation(), notes)
    assert len(columns["time"]) == MAX_ROWS and columns["time"][0] == 0 and "one row in 10" in " ".join(notes)
    notes = []
    columns, _ = prepare(raw, Preparation(rows="100:2105", average=20), notes)
    assert len(columns["time"]) == 100 and "the last 5 rows, too few for a mean, are left out" in " ".join(notes)
    left = columns["true_stress"] - np.polyval(np.polyfit(columns["time"], columns["true_stress"], 1), columns["time"])
    assert left.std() == pytest.approx(1e3 / np.sqrt(20), rel=0.3)
    with pytest.raises(UserError, match="the time does not increase in"):
        prepare(raw | {"time": raw["time"][::-1]}, Preparation(), [])


def test_cycles_become_loadings_and_unloadings_of_one_specimen(tmp_path):
    strain = np.concatenate([np.linspace(0, e, 20)[:: 1 if up else -1][1:] for e in (0.1, 0.2) for up in (True, False)])
    assert [part.name for part in loading_parts(strain)] == ["load-1", "unload-1", "load-2", "unload-2"]
    rows = [f"{e:.6f},{YOUNG * e:.3f}" for e in strain]
    path = write(tmp_path / "cycles.csv", ["Strain (mm/mm),Stress (Pa)", *rows])
    neuido.import_file(path, tmp_path / "out", preparation=Preparation(cycles="split"), held_out=["cycles-load-2", "cycles-unload-2"])
    tests = neuido.read_material_tests(tmp_path / "out")
    assert [test.role for test in tests.tests] == ["fit", "fit", "held_out", "held_out"]
    assert tests.histories() == ((0, 1, 2, 3),)
    np.testing.assert_allclose(np.concatenate([test.path[:, 0] for test in tests.tests]), 1 + strain, atol=1e-6)


def test_start_of_the_modulus():
    """By the first loading: a plastic strain before the second would make a secant too soft or too stiff."""
    loading, unloading = YOUNG * STRAIN, YOUNG * (STRAIN[::-1] - 0.05)
    path, stress = np.concatenate([STRAIN, STRAIN[::-1]]), np.concatenate([loading, unloading])
    assert modulus({"stretch": 1 + path, "nominal_stress": stress}) == pytest.approx(YOUNG)
    assert modulus({"shear": path, "shear_stress": stress}) == pytest.approx(3 * YOUNG)
    with pytest.raises(UserError, match="the stress is zero"):
        modulus({"stretch": 1 + path, "nominal_stress": 0 * stress})


SHEET = np.linspace(0.02, 0.4, 20)


@pytest.mark.parametrize(
    ("titles", "columns", "options", "path", "stress"),
    [
        ("Compressive strain (%),Compressive stress (kPa)", (100 * SHEET, 3e3 * SHEET), {}, 1 - SHEET, -3e6 * SHEET),
        ("Compression (mm),Load (N)", (30 * SHEET, 60 * SHEET),
         {"mode": "compression", "specimen": Specimen("30 mm", "10 mm", "2 mm")}, 1 - SHEET, -3e6 * SHEET),
        ("Strain (%),Load (N)", (-100 * SHEET, 60 * SHEET),
         {"mode": "compression", "specimen": Specimen(width="10 mm", thickness="2 mm")}, 1 - SHEET, -3e6 * SHEET),
        ("Strain (%),Stress (MPa)", (100 * SHEET, 3 * SHEET), {"compression": True}, 1 - SHEET, -3e6 * SHEET),
        ("True strain,True stress (MPa)", (SHEET, 3 * SHEET), {"mode": "equibiaxial"}, np.exp(SHEET), 3e6 * SHEET),
        ("Stretch,Stress (psi)", (1 + SHEET, 500 * SHEET), {"mode": "pure_shear"}, 1 + SHEET, 500 * 6894.757 * SHEET),
        ("Extension (in),Load (lbf)", (2 * SHEET, 10 * SHEET), {"specimen": Specimen("2 in", "0.5 in", "0.1 in")},
         1 + SHEET, 200 * 6894.757 * SHEET),
        ("Displacement (mm),Force (N)", (2 * SHEET, 1000 * SHEET),
         {"mode": "simple_shear", "specimen": Specimen("25 mm", "20 mm", "2 mm")}, SHEET, 2e6 * SHEET),
        ("Time;Dehnung;Spannung", (SHEET, 100 * SHEET, 3 * SHEET),
         {"units": {"strain": "percent", "nominal_stress": "MPa", "time": "min"}}, 1 + SHEET, 3e6 * SHEET),
        ("Force / N,Weg / mm", (60 * SHEET, 30 * SHEET), {"specimen": Specimen("30 mm", diameter="5.0463 mm")},
         1 + SHEET, 3e6 * SHEET),
    ],
)  # fmt: skip
def test_modes_signs_and_units(tmp_path, titles, columns, options, path, stress):
    separator = ";" if ";" in titles else ","
    file = write(tmp_path / "a.csv", [titles, *(separator.join(f"{v:.9f}" for v in row) for row in zip(*columns))])
    said = neuido.import_file(file, tmp_path / "out", **options)
    (test,) = neuido.read_material_tests(tmp_path / "out").tests
    np.testing.assert_allclose(test.path[:, 0], path, atol=1e-6)
    np.testing.assert_allclose(test.stress[:, 0], stress, rtol=1e-4)
    assert any("friction at the platens" in line for line in said) == (options.get("mode") == "compression" or "Compressive" in titles)


def test_two_axes(tmp_path):
    rows = [f"{50 * a:.6f},{40 * b:.6f},{20 * a:.6f},{30 * b:.6f}" for a in (0.1, 0.2, 0.3) for b in (0.1, 0.2, 0.3)]
    path = write(tmp_path / "cross.csv", ["Extension 1 (mm),Extension 2 (mm),Load 1 (N),Load 2 (N)", *rows])
    neuido.import_file(path, tmp_path / "out", mode="biaxial", specimen=Specimen("50 mm", "10 mm", "2 mm"))
    (test,) = neuido.read_material_tests(tmp_path / "out").tests
    np.testing.assert_allclose(test.path[1], [1.1, 1.16], atol=1e-6)
    np.testing.assert_allclose(test.stress[1], [2 / 20e-6, 6 / 20e-6], rtol=1e-5)


@pytest.mark.parametrize(
    ("titles", "columns"),
    [
        ("Green-Lagrange strain E11 (%),Green-Lagrange strain E22", {}),
        ("green_strain_xx [%],Green strain 2", {}),
        ("E11 (%),E22", {"green_strain_1": "E11 (%)", "green_strain_2": "E22"}),
    ],
)
def test_a_green_strain_along_each_of_two_axes(tmp_path, titles, columns):
    grid = np.array([(a, b) for a in (1.1, 1.2, 1.3) for b in (0.95, 1.1, 1.25)])
    rows = [f"{50 * (a * a - 1):.6f},{(b * b - 1) / 2:.8f},{a:.3f},{2 * b:.3f}" for a, b in grid]
    path = write(tmp_path / "cross.csv", [f"{titles},Stress 1 (MPa),Stress 2 (MPa)", *rows])
    if columns:
        with pytest.raises(UserError, match=r"'E11.*' may be a Green or an engineering strain: give --columns\.green_strain_1"):
            neuido.import_file(path, None, mode="biaxial")
    neuido.import_file(path, tmp_path / "out", mode="biaxial", columns=columns)
    (test,) = neuido.read_material_tests(tmp_path / "out").tests
    np.testing.assert_allclose(test.path, grid, atol=1e-6)
    np.testing.assert_allclose(test.stress, 1e6 * grid * [1, 2], rtol=1e-5)


def test_a_strain_in_percent_without_a_unit_is_asked_for(tmp_path):
    path = write(tmp_path / "a.csv", ["Strain,Stress (MPa)", *(f"{100 * e:.4f},{3 * e:.6f}" for e in SHEET)])
    with pytest.raises(UserError, match=r"'Strain' has no unit: give --units\.strain percent"):
        neuido.import_file(path, None)
    path = write(tmp_path / "b.csv", ["Strain,Stress (MPa)", *(f"{e:.4f},{3 * e:.6f}" for e in SHEET)])
    assert any("taken as a ratio, up to 0.4" in line for line in neuido.import_file(path, None))


def crept(t, level):
    """A Burgers body under a stress that ends after 300 s."""

    def compliance(t):
        return np.where(t > 0, 1 / 30e6 + -np.expm1(-np.maximum(t, 0) / 40) / 25e6 + np.maximum(t, 0) / 9e9, 0.0)

    return np.where((t > 0) & (t <= 300), level, 0.0), level * (compliance(t) - compliance(t - 300))


def test_a_table_of_creep_prescribes_its_stress(tmp_path):
    """A stress that stays at its levels was taken for a measured one, and two levels for repeats of one test."""
    from neuido.discrepancy.problems.specimens.repeats import are_repeats, scatter

    t = np.r_[np.linspace(0, 4, 9), np.geomspace(5, 300, 50), 300 + np.r_[np.linspace(1, 4, 5), np.geomspace(5, 300, 50)]]
    files = []
    for i, level in enumerate((2e5, 3e5)):
        stress, strain = crept(t, level)
        rows = [f"{a:.3f},{b / 1e6:.3f},{100 * c:.5f}" for a, b, c in zip(t, stress, strain, strict=True)]
        files.append(write(tmp_path / f"step{i}.csv", ["Time (s),Stress (MPa),Strain (%)", *rows]))
    said = neuido.import_file(files, tmp_path / "out")
    assert any("the stress is prescribed" in line for line in said)
    tests = neuido.read_material_tests(tmp_path / "out")
    assert [test.control for test in tests.tests] == ["stress", "stress"]
    assert not are_repeats(*tests.tests) and not scatter(tests)


def test_a_stress_that_yields_or_relaxes_is_not_prescribed():
    t = np.linspace(0, 100, 200)
    stress, strain = crept(np.linspace(0, 250, 200), 2e5)
    table = {"stretch": 1 + strain, "nominal_stress": stress, "time": t}
    assert holds_stress(table)
    assert not holds_stress({key: values for key, values in table.items() if key != "time"})
    even = 0.1 * t / 100
    assert not holds_stress(table | {"stretch": 1 + even, "nominal_stress": np.minimum(1e9 * even, 2e5)})
    held = np.minimum(even, 0.01)
    assert not holds_stress(table | {"stretch": 1 + held, "nominal_stress": 2e6 * held * (1 + np.exp(-t / 5))})
    assert not holds_stress(table | {"stretch": 1 + even, "nominal_stress": 2e6 * even})
