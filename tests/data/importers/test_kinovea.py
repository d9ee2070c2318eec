"""Kinovea's exports become tracks: the table with cells in quotation marks and its time in ms, and the text of trajectories."""

import numpy as np
import pytest

import neuido
from neuido.data.files.delimited import read_delimited
from neuido.errors import UserError
from tests.data.importers.test_importing import FLIGHT, T

pytest.importorskip("pint")
CENTIMETRES = [[f"{np.float32(v):.7g}" for v in (1e3 * t, 100 * x, 100 * y)] for t, (x, y, _) in zip(T, FLIGHT)]
"""Single precision without units, as Kinovea writes."""
GIVEN = {"scale": 0.01, "units": {"time": "ms"}}


def quoted(rows, separator, decimal):
    cells = ([f'"{cell}"' if cell else "" for cell in row] for row in rows)
    return "".join(separator.join(row).replace(".", decimal) + "\r\n" for row in cells)


def same(folder, name):
    (track,) = neuido.read_tracks(folder).recordings
    assert track.name == name
    np.testing.assert_allclose(track.t, T, atol=1e-6)
    np.testing.assert_allclose(track.x, FLIGHT[:, :2], atol=1e-6)


@pytest.mark.parametrize(("separator", "decimal"), [(",", "."), (",", ","), (";", ",")])
def test_a_table_of_one_or_two_trajectories(tmp_path, separator, decimal):
    """Commas stand between cells also where they are decimal signs, and a point that is not tracked leaves its cells empty."""
    head = ["Time", "Marker 1/0/X", "Marker 1/0/Y"]
    (tmp_path / "one.csv").write_text(quoted([head, *CENTIMETRES], separator, decimal), newline="")
    with pytest.raises(UserError, match=r"cale: \{t: 0\.001\}"):
        neuido.import_file(tmp_path / "one.csv", tmp_path / "one", scale=0.01)
    neuido.import_file(tmp_path / "one.csv", tmp_path / "one", **GIVEN)
    same(tmp_path / "one", "one")
    both = [[*row, *([row[1], row[2]] if i > 4 else ["", ""])] for i, row in enumerate(CENTIMETRES)]
    (tmp_path / "two.csv").write_text(quoted([[*head, "Marker 2/0/X", "Marker 2/0/Y"], *both], separator, decimal), newline="")
    with pytest.raises(UserError, match=r"has the points marker 1/0, marker 2/0: select one with --point"):
        neuido.import_file(tmp_path / "two.csv", tmp_path / "two", **GIVEN)
    neuido.import_file(tmp_path / "two.csv", tmp_path / "two", point="marker 1/0", **GIVEN)
    same(tmp_path / "two", "two")


@pytest.mark.parametrize("decimal", [".", ","])
def test_the_text_of_trajectories(tmp_path, decimal):
    rows = [" ".join(row).replace(".", decimal) for row in CENTIMETRES]
    one = ["#Kinovea Trajectory data export", "#T X Y", "", "# Marker 1", *rows, ""]
    (tmp_path / "one.txt").write_text("\r\n".join(one), newline="")
    neuido.import_file(tmp_path / "one.txt", tmp_path / "one", **GIVEN)
    same(tmp_path / "one", "one")


@pytest.mark.parametrize("named", [True, False])
@pytest.mark.parametrize("later", [0, 5, 10_000])
def test_the_text_of_several_trajectories(tmp_path, named, later):
    """The second one begins with the first, while it goes on, or after it, where the times alone would not tell them apart."""
    second = [f"{float(t) + later:.7g} 9{x} {y}" for t, x, y in CENTIMETRES]
    heads = ["# Marker 1", "# Marker 2"] if named else ["", ""]
    blocks = [[heads[0], *map(" ".join, CENTIMETRES), "", ""], [heads[1], *second, "", ""]]
    (tmp_path / "two.txt").write_text("\n".join(["#Kinovea Trajectory data export", "#T X Y", *blocks[0], *blocks[1]]))
    names = ["Marker 1", "Marker 2"] if named else ["point 1", "point 2"]
    with pytest.raises(UserError, match=f"has the points {', '.join(names)}: select one with --point"):
        neuido.import_file(tmp_path / "two.txt", tmp_path / "two", **GIVEN)
    neuido.import_file(tmp_path / "two.txt", tmp_path / "two", point=names[0], **GIVEN)
    same(tmp_path / "two", "two")
    neuido.import_file(tmp_path / "two.txt", tmp_path / "each", columns={"recording": "point"}, **GIVEN)
    first, last = neuido.read_tracks(tmp_path / "each").recordings
    assert len(first.t) == len(last.t) == len(T)
    np.testing.assert_allclose(first.x, FLIGHT[:, :2], atol=1e-6)


@pytest.mark.parametrize("row", ["0.033;1.250;2.250", "1.033;1.250;2.250", "1,033\t1,250\t2,250", '"0,033","1,250","2,250"'])
def test_three_decimals_are_no_thousands(tmp_path, row):
    separator = next(mark for mark in (";", "\t", ",") if mark in row)
    (tmp_path / "a.csv").write_text("\n".join([separator.join("txy"), *[row] * 4]))
    time, *place = map(float, read_delimited(tmp_path / "a.csv").rows[1])
    assert time in (0.033, 1.033) and place == [1.25, 2.25]
