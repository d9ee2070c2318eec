import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neuido.data.files.delimited import read_delimited
from neuido.data.measured.material_test import read_material_tests
from neuido.errors import UserError


@settings(max_examples=40, deadline=None)
@given(
    dialect=st.sampled_from([(",", "."), (";", ","), (";", "."), ("\t", "."), ("\t", ","), (" ", "."), (" ", ",")]),
    encoding=st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "cp1252"]),
    rows=st.lists(st.tuples(*[st.one_of(st.floats(-1e6, 1e6), st.floats(-9, 9))] * 3), min_size=4, max_size=12),
    digits=st.sampled_from([1, 3, 4]),
    preamble=st.lists(st.sampled_from(["# made on a Monday", "Prüfer: Müller", "mass_A"]), max_size=3),
    end=st.sampled_from(["\n", "\r\n"]),
)
def test_any_dialect(tmp_path_factory, dialect, encoding, rows, digits, preamble, end):
    separator, decimal = dialect
    rows = [[round(v, digits) for v in row] for row in rows]
    lines = [separator.join(f"{v:.{digits}f}".replace(".", decimal) for v in row) for row in rows]
    path = tmp_path_factory.mktemp("dialect") / "data.csv"
    path.write_bytes(end.join([*preamble, separator.join("abc"), *lines, ""]).encode(encoding))
    table = read_delimited(path)
    first = table.rows.index(["a", "b", "c"])
    np.testing.assert_array_equal(np.array(table.rows[first + 1 :], dtype=float), np.array(rows))
    assert table.lines[first] == len(preamble) + 1


def test_what_is_no_text(tmp_path):
    (tmp_path / "a.csv").write_bytes(b"PK\x03\x04\0\0")
    with pytest.raises(UserError, match="neuido import"):
        read_delimited(tmp_path / "a.csv")


def test_case_of_decimal_commas(data_root):
    (test,) = read_material_tests(data_root / "cases" / "26-csv-dialects").tests
    assert test.path[1, 0] == 1.05 and test.stress[1, 0] == 56603.6 and len(test.path) == 25


@pytest.mark.parametrize("odd", ["1" * 100_000 + "x", "-" * 100_000 + "x", "--- " * 30_000 + "x", "1" * 100_000 + "d", "(" + "1" * 100_000])
def test_the_time_of_an_odd_line_does_not_grow_with_its_square(tmp_path, odd):
    """Patterns match each character in one way; this file took minutes or for ever."""
    path = tmp_path / "a.csv"
    path.write_text("t,x\n" + "".join(f"{i},{i * i}\n" for i in range(9)) + f"{odd},1\n")
    assert read_delimited(path).separator == ","
