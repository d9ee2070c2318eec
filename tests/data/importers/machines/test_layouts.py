"""Tables as testing machines and rheometers write them, with several specimens, imported, and their numbers."""

import numpy as np
import pytest

import neuido
from neuido.data.importers.machines.loading_path import Preparation
from neuido.data.importers.machines.testing_machine import Specimen
from neuido.errors import UserError
from tests.data.importers.test_importing import STRESS, STRETCH, comma, write

pytest.importorskip("pint")
TIME = np.arange(26) * 0.1
SOFT = 0.8
"""Stress of the second specimen relative to the first."""


def stacked_instron(path):
    """Two specimens one below the other, each with its own titles and width."""
    lines = []
    for i, (width, factor) in enumerate(((10.0, 1.0), (20.0, SOFT)), 1):
        lines += [f"Specimen # {i}", f"Width:,{width},mm", "Thickness:,2.0,mm", "Length:,50.0,mm", "", "Time,Compressive extension,Load",
                  "(s),(mm),(N)"]  # fmt: skip
        rows = zip(TIME, 50 * (STRETCH - 1), factor * STRESS * width * 2e-6)
        lines += [",".join(f"{v:.8f}" for v in row) for row in rows]
    return write(path / "bluehill.csv", [line.replace("Compressive ", "") for line in lines])


def merged_cells(path):
    """A name in the first row of each specimen alone, as a spreadsheet exports merged cells."""
    rows = column_of_specimens(path).read_text().splitlines()
    kept = [row if i % len(STRETCH) == 0 else row[1:] for i, row in enumerate(rows[1:])]
    return write(path / "merged.csv", [rows[0], *kept])


def beside_zwick(path):
    """Two specimens side by side, with decimal commas."""
    head = ["Probe 1;;Probe 2;", "Dehnung;Standardkraft;Dehnung;Standardkraft", "%;N;%;N"]
    rows = zip(100 * (STRETCH - 1), STRESS * 20e-6, 100 * (STRETCH - 1), SOFT * STRESS * 20e-6)
    return write(path / "testxpert.txt", [*head, *(";".join(map(comma, row)) for row in rows)], "cp1252")


def numbered_titles(path):
    head = "Strain 1 (%),Stress 1 (kPa),Strain 2 (%),Stress 2 (kPa)"
    rows = zip(100 * (STRETCH - 1), STRESS / 1e3, 100 * (STRETCH - 1), SOFT * STRESS / 1e3)
    return write(path / "numbered.csv", [head, *(",".join(f"{v:.8f}" for v in row) for row in rows)])


def column_of_specimens(path):
    rows = [f"{name},{e:.8f},{factor * s:.4f}" for name, factor in (("A", 1.0), ("B", SOFT)) for e, s in zip(STRETCH - 1, STRESS)]
    return write(path / "long.csv", ["Specimen,Strain (mm/mm),Stress (Pa)", *rows])


def sheets(path):
    book = pytest.importorskip("openpyxl").Workbook()
    book.active.title = "Results"
    book.active.append(["Specimen", "E-Modulus"])
    for name, factor in (("Specimen 1", 1.0), ("Specimen 2", SOFT)):
        sheet = book.create_sheet(name)
        for row in (["Extension", "Load"], ["mm", "N"], *zip((50 * (STRETCH - 1)).tolist(), (factor * STRESS * 20e-6).tolist())):
            sheet.append(row)
    book.save(path / "bluehill.xlsx")
    return path / "bluehill.xlsx"


def old_excel(path):
    book = pytest.importorskip("xlwt").Workbook()
    for name, factor in (("Probe 1", 1.0), ("Probe 2", SOFT)):
        sheet = book.add_sheet(name)
        for i, row in enumerate([("Dehnung", "Spannung"), ("%", "MPa"), *zip(100 * (STRETCH - 1), factor * STRESS / 1e6)]):
            for j, cell in enumerate(row):
                sheet.write(i, j, cell)
    book.save(str(path / "zwick.xls"))
    return path / "zwick.xls"


@pytest.mark.parametrize("make", [stacked_instron, beside_zwick, numbered_titles, column_of_specimens, merged_cells, sheets, old_excel])
def test_several_specimens(tmp_path, make):
    specimen = Specimen() if make is stacked_instron else Specimen("50 mm", "10 mm", "2 mm")
    said = neuido.import_file(make(tmp_path), tmp_path / "out", specimen=specimen)
    first, second = neuido.read_material_tests(tmp_path / "out").tests
    for test, factor in ((first, 1.0), (second, SOFT)):
        np.testing.assert_allclose(test.path[:, 0], STRETCH, atol=1e-6)
        np.testing.assert_allclose(test.stress[:, 0], factor * STRESS, rtol=1e-4, atol=10)
    assert (first.role, second.role) == ("fit", "held_out") and any("held out" in line for line in said)


def test_a_specimen_of_two_rows_is_left_out(tmp_path):
    path = column_of_specimens(tmp_path)
    path.write_text(path.read_text().rstrip() + "\nC,0.0,0.0\nC,0.1,50000.0\n")
    said = neuido.import_file(path, tmp_path / "out")
    assert len(neuido.read_material_tests(tmp_path / "out").tests) == 2
    assert "all files: Specimen C has fewer than 3 rows and is left out" in said


def test_one_sheet_by_its_name(tmp_path):
    size = Specimen("50 mm", "10 mm", "2 mm")
    neuido.import_file(sheets(tmp_path), tmp_path / "out", specimen=size, sheet="Specimen 2")
    (test,) = neuido.read_material_tests(tmp_path / "out").tests
    np.testing.assert_allclose(test.stress[:, 0], SOFT * STRESS, rtol=1e-4, atol=10)
    with pytest.raises(UserError, match="no sheet 'Specimen 9': choose from Results, Specimen 1"):
        neuido.import_file(tmp_path / "bluehill.xlsx", None, specimen=size, sheet="Specimen 9")


def test_text_that_is_called_a_spreadsheet(tmp_path):
    rows = ["\t".join(f"{v:.8f}" for v in row) for row in zip(TIME, 50 * (STRETCH - 1), STRESS * 20e-9)]
    path = write(tmp_path / "mts.xls", ["Running Time\tAxial Displacement\tAxial Force", "sec\tmm\tkN", *rows])
    neuido.import_file(path, tmp_path / "out", specimen=Specimen("50 mm", "10 mm", "2 mm"))
    (test,) = neuido.read_material_tests(tmp_path / "out").tests
    np.testing.assert_allclose(test.stress[:, 0], STRESS, rtol=1e-3, atol=10)
    np.testing.assert_allclose(test.time, TIME, atol=1e-9)


def test_steps_of_a_rheometer(tmp_path):
    """The layout of TRIOS: steps one below the other, of which each becomes a test in shear."""
    shear, lines = np.linspace(0, 0.5, 21), ["Filename\tsample.tri", "Geometry\tParallel plate"]
    for i, modulus in enumerate((1e3, 2e3), 1):
        lines += ["[step]", f"Amplitude - {i}", "Step time\tStrain\tStress\tTemperature", "s\t%\tPa\t°C"]
        lines += [f"{0.1 * k:.3f}\t{100 * g:.6f}\t{modulus * g:.6f}\t25.0" for k, g in enumerate(shear)]
    neuido.import_file(write(tmp_path / "trios.txt", lines), tmp_path / "out", mode="simple_shear")
    tests = neuido.read_material_tests(tmp_path / "out").tests
    assert [test.mode for test in tests] == ["simple_shear"] * 2
    for test, modulus in zip(tests, (1e3, 2e3)):
        np.testing.assert_allclose(test.path[:, 0], shear, atol=1e-6)
        np.testing.assert_allclose(test.stress[:, 0], modulus * shear, rtol=1e-5)
        np.testing.assert_allclose(test.time, 0.1 * np.arange(21), atol=1e-9)


def test_relaxation_modulus(tmp_path):
    time = np.geomspace(0.01, 10, 30)
    path = write(tmp_path / "relax.csv", ["Time (s),G(t) (kPa)", *(f"{t:.6f},{3 + 2 * np.exp(-t):.6f}" for t in time)])
    with pytest.raises(UserError, match=r"relax\.csv is a relaxation modulus: .*--step 0\.01"):
        neuido.import_file(path, None, columns={"relaxation_modulus": "G(t) (kPa)"})
    neuido.import_file(path, tmp_path / "out", columns={"relaxation_modulus": "G(t) (kPa)"}, step="1 %")
    (test,) = neuido.read_material_tests(tmp_path / "out").tests
    assert test.mode == "simple_shear" and test.path[0, 0] == test.stress[0, 0] == test.time[0] == 0
    np.testing.assert_allclose(test.path[1:, 0], 0.01)
    np.testing.assert_allclose(test.stress[1:, 0], 10 * (3 + 2 * np.exp(-time)), rtol=1e-5)
    np.testing.assert_allclose(test.time[1:], time, atol=1e-6)


def curve(tmp_path, titles, rows):
    return write(tmp_path / "curve.csv", [titles, *(",".join(f"{value:g}" for value in row) for row in rows)])


@pytest.mark.parametrize(("title", "factor"), [("Angular Frequency (rad/s)", 1.0), ("Frequency (Hz)", 2 * np.pi)])
def test_a_frequency_sweep_is_a_small_oscillation(tmp_path, title, factor):
    w = np.geomspace(0.01, 100, 9)
    rows = np.stack([w, 1e3 * w, 2e3 * np.sqrt(w)], 1)
    lines = neuido.import_file(curve(tmp_path, f"{title},Storage Modulus (Pa),Loss Modulus (kPa)", rows), tmp_path / "out")
    (test,) = neuido.read_material_tests(tmp_path / "out").tests
    assert test.mode == "oscillation" and any("frequency sweep" in line for line in lines)
    np.testing.assert_allclose(test.path[:, 0], factor * w, rtol=1e-5)
    np.testing.assert_allclose(test.stress, np.stack([1e3 * w, 2e6 * np.sqrt(w)], 1), rtol=1e-5)
    with pytest.raises(UserError, match=r"--units\.frequency Hz or rad/s"):
        neuido.import_file(curve(tmp_path, "Frequency,Storage Modulus (Pa),Loss Modulus (Pa)", rows), None)


def test_a_compliance_is_creep_under_a_small_stress(tmp_path):
    t = np.geomspace(0.1, 1e3, 12)
    neuido.import_file(curve(tmp_path, "Time (s),Creep Compliance (1/Pa)", np.stack([t, 1e-5 * t**0.3], 1)), tmp_path / "out")
    (test,) = neuido.read_material_tests(tmp_path / "out").tests
    assert test.control == "stress" and test.mode == "simple_shear" and test.path.max() == pytest.approx(0.01, rel=0.01)
    np.testing.assert_allclose(test.path[:, 0] / test.stress[:, 0], 1e-5 * t**0.3, rtol=1e-5)
    t = np.linspace(0.1, 1e3, 2000)
    neuido.import_file(curve(tmp_path, "Time (s),Creep Compliance (1/Pa)", np.stack([t, 1e-5 * t**0.3], 1)), tmp_path / "long")
    (long,) = neuido.read_material_tests(tmp_path / "long").tests
    assert 70 < len(long.path) <= 150 and long.time[0] == pytest.approx(0.1)


@pytest.mark.parametrize("title", ["Shear stress (Pa)", "Viscosity (Pa s)"])
def test_a_flow_curve_declares_a_fluid(tmp_path, title):
    rate = np.geomspace(0.01, 100, 10)
    seen = 5 * rate**0.5 if "stress" in title else 5 * rate**-0.5
    rows = np.concatenate([[[0.0, 1.0]], np.stack([rate, seen], 1)])
    lines = neuido.import_file(curve(tmp_path, f"Shear Rate (1/s),{title}", rows), tmp_path / "out")
    read = neuido.read_material_tests(tmp_path / "out")
    assert read.fluid and read.model["flow"]["viscosity"] == pytest.approx(5.0, rel=0.02)
    assert any("1 rows without positive values" in line for line in lines)
    np.testing.assert_allclose(read.tests[0].stress[:, 0], 5 * rate**0.5, rtol=1e-5)


@pytest.mark.parametrize(
    ("folder", "raw", "options"),
    [
        ("silicone-EF30_25T", ["EF30_25T_A1.csv", "EF30_25T_A2.csv", "EF30_25T_B1.csv"],
         {"mode": "compression", "preparation": Preparation("5::12")}),
        ("steel-s2", ["s2-first-4000-rows.csv"],
         {"columns": {"log_strain": "Strain 1 (%)", "true_stress": "Stress"}, "units": {"true_stress": "MPa"}, "poisson": 0.3,
          "preparation": Preparation("20:", average=20)}),
        ("laos", ["laos0010.txt"],
         {"columns": {"time": "column 1", "shear": "column 2", "shear_stress": "column 4"}, "mode": "simple_shear",
          "units": {"shear": "percent", "shear_stress": "Pa"}, "preparation": Preparation("::8")}),
        ("fish-relax", ["fish.csv"], {"step": "0.01", "preparation": Preparation("::4")}),
    ],
    ids=["silicone", "steel", "laos", "fish"],
)  # fmt: skip
def test_raw_files_give_the_prepared_folders(data_root, tmp_path, folder, raw, options):
    """Times may start elsewhere; the digits of the prepared files are the only other difference."""
    prepared = neuido.read_material_tests(data_root / "measured" / folder)
    neuido.import_file([data_root / "measured" / folder / "raw" / file for file in raw], tmp_path / "out", **options)
    for test, own in zip(prepared.tests, neuido.read_material_tests(tmp_path / "out").tests):
        n = min(len(test.path), len(own.path))  # a raw file may be a part of what was prepared
        assert n > 60 and own.mode == test.mode and own.true_stress == test.true_stress
        np.testing.assert_allclose(own.path[:n], test.path[:n], rtol=2e-5, atol=2e-6)
        np.testing.assert_allclose(own.stress[:n], test.stress[:n], rtol=1e-3, atol=1e-3 * np.abs(test.stress).max())
        if test.time is not None:
            np.testing.assert_allclose(np.diff(own.time[:n]), np.diff(test.time[:n]), atol=1e-4)
