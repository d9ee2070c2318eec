import numpy as np
import pytest

from neuido.data.measured.material_test import read_material_tests
from neuido.errors import UserError
from neuido.physics.laws.classical import material
from tests.data.refused import assert_refused

YAML = """format: neuido-material-test/1
name: rubber
model:
  density: 1000.0
  elasticity: {law: neo_hookean, young: 1.0e6, poisson: 0.499}
  plasticity: {law: identity}
  free: [young]
  incompressible: true
  effects: {strain_stiffening: 0.02, second_invariant.c: 0.1}
tests:
  - {name: pull, file: pull.csv, mode: uniaxial, columns: {stretch: L, nominal_stress: S},
     scale: {nominal_stress: 1.0e6}, rows: [0, 4], role: fit}
  - {name: more, file: pull.csv, mode: uniaxial, columns: {stretch: L, nominal_stress: S},
     scale: {nominal_stress: 1.0e6}, rows: [4, 7], role: held_out}
  - {name: sheet, file: sheet.csv, mode: biaxial, direction: [0, 2, 0],
     columns: {log_strain_1: a, log_strain_2: b, true_stress_1: p, true_stress_2: q, time: t}, role: fit}
"""
PULL = "L,S,other\n1.0,0.0,x\n1.1,0.1,x\n1.2,0.2,x\n1.3,0.3,x\n1.4,0.4,x\n1.5,0.5,x\n1.6,0.6,x\n"
SHEET = "t,a,b,p,q\n0,0,0,0,0\n1,0.1,0.05,2,1\n\n2,0.2,0.1,4,2\n"


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "test.yaml").write_text(YAML)
    (tmp_path / "pull.csv").write_text(PULL)
    (tmp_path / "sheet.csv").write_text(SHEET)
    return tmp_path


def test_read(folder):
    tests = read_material_tests(folder)
    assert (tests.name, tests.free, tests.incompressible) == ("rubber", ("young",), True)
    assert tests.model["elasticity"] == {"law": "neo_hookean", "young": 1e6, "poisson": 0.499} and "effects" not in tests.model
    assert tests.effects == {"strain_stiffening.k": 0.02, "second_invariant.c": 0.1}
    pull, more, sheet = tests.tests
    assert tests.of("fit") == (pull, sheet) and tests.of("held_out") == (more,)
    np.testing.assert_allclose(pull.path[:, 0], [1.0, 1.1, 1.2, 1.3])
    np.testing.assert_allclose(more.stress[:, 0], [4e5, 5e5, 6e5])
    assert not pull.true_stress and pull.time is None and pull.direction == (1.0, 0.0, 0.0) and pull.rows == range(0, 4)
    np.testing.assert_allclose(sheet.path, np.exp([[0, 0], [0.1, 0.05], [0.2, 0.1]]))
    np.testing.assert_array_equal(sheet.stress, [[0, 0], [2, 1], [4, 2]])
    np.testing.assert_array_equal(sheet.time, [0, 1, 2])
    assert sheet.true_stress and sheet.direction == (0.0, 1.0, 0.0)
    assert read_material_tests(folder / "test.yaml").name == "rubber"


def test_adjoining_rows_are_one_specimen(folder):
    assert read_material_tests(folder).histories() == ((0, 1), (2,))
    file = folder / "test.yaml"
    file.write_text(YAML.replace("rows: [4, 7]", "rows: [3, 7]"))
    assert read_material_tests(folder).histories() == ((0,), (1,), (2,))
    file.write_text(YAML.replace("rows: [4, 7]", "rows: [4, 7], direction: [0, 0, 1]"))
    assert read_material_tests(folder).histories() == ((0,), (1,), (2,))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("format: neuido-material-test/1", "format: neuido-experiment/1", "format = 'neuido-experiment/1'"),
        ("format: neuido-material-test/1", "form: 1", "format = None"),
        ("name: rubber", "name: 7", "name must be text"),
        ("name: rubber", "name: rubber\nscene: 1", "unknown key 'scene' in the file"),
        ("  density: 1000.0\n", "", "model lacks the key 'density'"),
        ("law: neo_hookean", "law: mooney", "elasticity.law = 'mooney' is not known"),
        ("young: 1.0e6", "young: -1", "young = -1 Pa is out of range"),
        ("free: [young]", "free: [stiffness]", "model.free has the unknown parameter 'stiffness'"),
        ("incompressible: true", "incompressible: perhaps", "model.incompressible must be true or false"),
        ("plasticity: {law: identity}", "plasticity: {law: drucker_prager, friction_angle: 30}", "drucker_prager depends on the pressure"),
        ("strain_stiffening: 0.02", "drag_linear: 0.02", "model.effects has the unknown effect 'drag_linear': choose from"),
        ("strain_stiffening: 0.02", "strain_stiffening: {q: 1}", "unknown key 'q' in model.effects.strain_stiffening"),
        ("strain_stiffening: 0.02", "strain_stiffening: [1, 2]", "model.effects.strain_stiffening takes k"),
        ("strain_stiffening: 0.02", "strain_stiffening: much", "model.effects.strain_stiffening.k must be a finite number"),
        ("tests:\n", "tests: 3\nother:\n", "unknown key 'other'"),
        ("mode: uniaxial", "mode: torsion", r"tests\[0\] \(pull\).mode = 'torsion' is unknown: choose from uniaxial"),
        ("mode: uniaxial", "mode: [uniaxial]", r"mode = \['uniaxial'\] is unknown"),
        ("role: fit", "role: train", "role = 'train' is unknown: choose from fit, held_out"),
        ("name: more", "name: pull", "is the name of another test"),
        ("file: pull.csv", "file: ../pull.csv", "leaves the folder"),
        ("file: pull.csv", "file: /etc/passwd", "leaves the folder"),
        ("file: pull.csv", "file: push.csv", "the file .*push.csv is missing"),
        ("file: pull.csv", "file: 3", "must be the path of a file"),
        ("stretch: L", "stretch: lambda", "columns.stretch = 'lambda' is not in pull.csv, which has L, S, other"),
        ("stretch: L, ", "", "columns lacks the key 'stretch'"),
        ("stretch: L, ", "strech: L, ", "unknown key 'strech' in .*columns"),
        ("stretch: L, ", "stretch: L, log_strain: S, ", "has both stretch, log_strain: give one of the two"),
        ("stretch: L", "stretch: other", "pull.csv, data row 0, other is 'x', which is not a finite number"),
        ("scale: {nominal_stress: 1.0e6}", "scale: {stress: 1.0e6}", "unknown key 'stress' in .*scale"),
        ("scale: {nominal_stress: 1.0e6}", "scale: {nominal_stress: 0}", "scale.nominal_stress must be above 0"),
        ("scale: {nominal_stress: 1.0e6}", "scale: {stretch: 1.7e308}", "exceeds the range of floating point|must be positive and finite"),
        ("rows: [0, 4]", "rows: [4, 0]", r"rows must be \[first row, row after the last\]"),
        ("rows: [0, 4]", "rows: [0, 40]", "exceeds the 7 data rows"),
        ("rows: [0, 4]", "rows: [0, 2]", "has 2 data rows; at least 3"),
        ("rows: [0, 4]", "rows: 4", "rows must be"),
        ("direction: [0, 2, 0]", "direction: [0, 0, 0]", "direction must not be zero"),
        ("direction: [0, 2, 0]", "direction: [0, 1]", "direction must be three numbers"),
        ("time: t", "time: b, x: t", "unknown key 'x'"),
        ("time: t", "time: b", "times must increase from row to row, but 0.01 s follows 0.05 s"),
        ("tests:\n", "tests: [\n", "is not valid YAML"),
    ],
)
def test_malformed(folder, old, new, message):
    if new == "time: b":
        (folder / "sheet.csv").write_text(SHEET.replace("0.2,0.1,4", "0.2,0.01,4"))
    assert_refused(read_material_tests, folder / "test.yaml", old, new, message)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "is empty"),
        ("L,S\n", "has 0 data rows|exceeds the 0"),
        (PULL.replace("1.1,0.1", "nan,0.1"), "data row 1, L is 'nan', which is not a finite number"),
        (PULL.replace("1.1,0.1", "-1.1,0.1"), "stretches must be positive and finite, got -1.1"),
        (PULL.replace("1.1,0.1,x", "1.1"), "data row 1, S is missing"),
        (PULL.replace("1.1,0.1", "1.1,inf"), "data row 1, S is 'inf', which is not a finite number"),
        (PULL.replace("1.1,0.1", '"1.1,0.1'), r"pull\.csv, line 3 is not valid CSV: "),
        (PULL.replace("L,S", "L,L"), "has 2 columns named 'L'|is not in pull.csv"),
        (b"\xff\xfe\x00", r"pull\.csv is not a CSV file: its encoding is none of utf-16"),
    ],
)
def test_malformed_table(folder, content, message):
    (folder / "pull.csv").write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(UserError, match=message) as caught:
        read_material_tests(folder)
    assert "\n" not in str(caught.value)


def test_no_folder(tmp_path):
    with pytest.raises(UserError, match=r"test.yaml is missing"):
        read_material_tests(tmp_path)


@pytest.mark.parametrize(
    ("name", "rows", "histories"),
    [
        ("treloar-rubber", (15, 6), ((0, 1),)),
        ("kawabata-rubber", (70, 47), ((0, 1),)),
        ("diani-rubber", (20, 20, 10, 10), ((0, 2), (1, 3))),
        ("cyclic-steel", (315, 317), ((0, 1),)),
    ],
)
def test_measured(data_root, name, rows, histories):
    tests = read_material_tests(data_root / "measured" / name)
    assert tests.name == name and tuple(len(test.path) for test in tests.tests) == rows and tests.histories() == histories
    material(tests.model["elasticity"], tests.model["plasticity"])
    assert all(1e5 < np.abs(test.stress).max() < 1e9 for test in tests.tests)
