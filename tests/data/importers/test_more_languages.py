"""Tables of further languages, encodings and spellings of numbers, and exports of further trackers, give the same numbers."""

import numpy as np
import pytest

import neuido
from neuido.data.importers.machines.testing_machine import Specimen
from neuido.errors import UserError

pytest.importorskip("pint")
STRETCH = np.linspace(1, 1.5, 26)
SHORT = np.linspace(1, 0.7, 26)
SPECIMEN = Specimen("50 mm", "10 mm", "2 mm")
T = np.arange(31) / 30
FLIGHT = np.stack([0.3 + 2 * T, 1 + 4 * T - 4.905 * T**2, 0.2 + 0.1 * T], 1)


def stress(stretch):
    return 4e5 * (stretch - stretch**-2)


def write(path, lines, encoding="utf-8"):
    path.write_bytes("\n".join([*lines, ""]).encode(encoding))
    return path


@pytest.mark.parametrize(
    ("titles", "encoding"),
    [
        ("Tempo [s];Forza [N];Spostamento [mm]", "cp1252"),
        ("Tempo (s);Força (N);Deslocamento (mm)", "latin-1"),
        ("Tijd (s);Kracht (N);Verplaatsing (mm)", "utf-8"),
        ("Czas [s];Siła [N];Przemieszczenie [mm]", "cp1250"),
        ("Время, с;Нагрузка, Н;Перемещение, мм", "cp1251"),
        ("时间(s);力(N);位移(mm)", "gbk"),
        ("時間;荷重;変位\nsec;N;mm", "shift_jis"),
        ("時間(s);荷重(N);変位(mm)", "utf-16"),
    ],
)
def test_forces(tmp_path, titles, encoding):
    rows = [f"{i / 10};{20e-6 * stress(a):.8f};{50 * (a - 1):.6f}".replace(".", ",") for i, a in enumerate(STRETCH)]
    neuido.import_file(write(tmp_path / "a.csv", [titles, *rows], encoding), tmp_path / "out", specimen=SPECIMEN)
    (test,) = neuido.read_material_tests(tmp_path / "out").tests
    np.testing.assert_allclose(test.path[:, 0], STRETCH, atol=1e-6)
    np.testing.assert_allclose(test.stress[:, 0], stress(STRETCH), rtol=1e-4, atol=1)
    np.testing.assert_allclose(test.time, np.arange(26) / 10)


@pytest.mark.parametrize(
    "titles",
    ["Deformazione [%],Sforzo [MPa]", "Deformação (%),Tensão (MPa)", "Rek (%),Spanning (MPa)", "Töjning (%),Spänning (MPa)",
     "Odkształcenie [%],Naprężenie [MPa]", "Деформация (%),Напряжение (МПа)", "应变(%),应力(MPa)", "ひずみ(%),応力(MPa)"],
)  # fmt: skip
def test_stresses(tmp_path, titles):
    rows = [f"{100 * (a - 1):.6f},{stress(a) / 1e6:.9f}" for a in STRETCH]
    neuido.import_file(write(tmp_path / "a.csv", [titles, *rows]), tmp_path / "out")
    (test,) = neuido.read_material_tests(tmp_path / "out").tests
    np.testing.assert_allclose(test.path[:, 0], STRETCH, atol=1e-6)
    np.testing.assert_allclose(test.stress[:, 0], stress(STRETCH), rtol=1e-4, atol=1)


@pytest.mark.parametrize(
    ("head", "spelled"),
    [
        ("Strain,Stress (Pa)", lambda v: f"{v:.8E}".replace("E", "D")),
        ("Strain,Stress (Pa)", lambda v: f"{v:.8f}".replace("-", "−")),
        ("Strain,Stress (Pa)", lambda v: f"({-v:.8f})" if v < 0 else f"{v:.8f}"),
        ("| Strain | Stress [Pa] |\n| :--- | ---: |", lambda v: f"{v:.8f}"),
        ("   Strain      Stress\n     [-]         [Pa]\n--------  ----------", lambda v: f"{v:.8f}"),
        ("   Strain      Stress\n     [-]         [Pa]\n====================", lambda v: f"{v:.8f}"),
    ],
)
def test_numbers_and_rules(tmp_path, head, spelled):
    mark = ("| ", " | ", " |") if head[0] == "|" else (" ", "  ", "") if head[0] == " " else ("", ",", "")
    rows = [f"{mark[0]}{spelled(a - 1)}{mark[1]}{spelled(s)}{mark[2]}" for a, s in zip(SHORT, stress(SHORT))]
    neuido.import_file(write(tmp_path / "a.txt", [head, *rows]), tmp_path / "out")
    (test,) = neuido.read_material_tests(tmp_path / "out").tests
    np.testing.assert_allclose(test.path[:, 0], SHORT, atol=1e-6)
    np.testing.assert_allclose(test.stress[:, 0], stress(SHORT), rtol=1e-4, atol=1)


def test_what_is_no_negative_number(tmp_path):
    """A number in brackets without a decimal sign may be a footnote: its row is told, and not taken for a negative one."""
    rows = [f"{a - 1:.4f},{stress(a):.1f}" if i != 12 else "0.24,(3)" for i, a in enumerate(STRETCH)]
    neuido.import_file(write(tmp_path / "a.csv", ["Strain,Stress (Pa)", *rows]), tmp_path / "out")
    (test,) = neuido.read_material_tests(tmp_path / "out").tests
    assert len(test.path) == 25 and test.stress.min() >= 0


def test_a_unit_in_words_above_is_none_of_the_columns(tmp_path):
    rows = [f"{20e-6 * stress(a):.8f},{50 * (a - 1):.6f}" for a in STRETCH]
    path = write(tmp_path / "a.csv", ["Units: Force = N; Displacement = mm", "Force,Displacement", *rows])
    with pytest.raises(UserError, match=r"column 'Displacement' has no unit: give --units.displacement"):
        neuido.import_file(path, None, specimen=SPECIMEN)


def xyz(x, factor=1.0, separator=","):
    return separator.join(f"{factor * value:.6f}" for value in x)


QUALISYS = ["NO_OF_FRAMES\t31", "NO_OF_MARKERS\t1", "FREQUENCY\t30", "DATA_INCLUDED\t3D", "MARKER_NAMES\tball"]
TRACKERS = {
    "TrackMate": (
        ["LABEL,ID,TRACK_ID,POSITION_X,POSITION_Y,POSITION_Z,POSITION_T,FRAME", "Label,Spot ID,Track ID,X,Y,Z,T,Frame",
         ",,,(micron),(micron),(micron),(sec),",
         *(f"ID{i},{i},0,{xyz(x, 1e6)},{t:.6f},{i}" for i, (t, x) in enumerate(zip(T, FLIGHT)))], {}),
    "Qualisys": ([*QUALISYS, *(xyz(x, 1e3, "\t") for x in FLIGHT)], {}),
    "Qualisys with titles": (
        [*QUALISYS, "Frame\tTime\tball X\tball Y\tball Z",
         *(f"{i + 1}\t{t:.5f}\t{xyz(x, 1e3, chr(9))}" for i, (t, x) in enumerate(zip(T, FLIGHT)))], {}),
    "ROS": (
        ["%time,field.header.seq,field.pose.position.x,field.pose.position.y,field.pose.position.z",
         *(f"{1700000000000000000 + round(1e9 * t)},{i},{xyz(x)}" for i, (t, x) in enumerate(zip(T, FLIGHT)))], {}),
    "rows are frames": (["pt1_X,pt1_Y,pt1_Z", *map(xyz, FLIGHT)], {"frame_rate": 30.0}),
    "microseconds": (["timestamp_us,x_mm,y_mm,z_mm", *(f"{round(1e6 * t)},{xyz(x, 1e3)}" for t, x in zip(T, FLIGHT))], {}),
}  # fmt: skip


@pytest.mark.parametrize("kind", TRACKERS)
def test_trackers(tmp_path, kind):
    lines, options = TRACKERS[kind]
    neuido.import_file(write(tmp_path / "a.tsv", lines), tmp_path / "out", **options)
    (track,) = neuido.read_tracks(tmp_path / "out").recordings
    np.testing.assert_allclose(track.t - track.t[0], T, atol=1e-5)
    np.testing.assert_allclose(track.x, FLIGHT, atol=1e-5)


def test_rows_without_a_time_are_asked_for(tmp_path):
    with pytest.raises(UserError, match=r"no time .* or give --frame_rate if each row is a frame"):
        neuido.import_file(write(tmp_path / "a.csv", TRACKERS["rows are frames"][0]), None)


@pytest.mark.parametrize("missing", ["FREQUENCY", "MARKER_NAMES"])
def test_a_header_of_qualisys_that_lacks_a_line(tmp_path, missing):
    lines = [line for line in TRACKERS["Qualisys"][0] if not line.startswith(missing)]
    with pytest.raises(UserError, match="FREQUENCY and MARKER_NAMES"):
        neuido.import_file(write(tmp_path / "a.tsv", lines), None)
