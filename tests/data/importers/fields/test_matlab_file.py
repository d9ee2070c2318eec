"""The reader of MATLAB files gives what SciPy's writer was given, and one line for what it does not read."""

import struct
import zlib

import numpy as np
import pytest
from scipy.io import savemat

from neuido.data.importers.fields.matlab_file import read_variable
from neuido.errors import UserError

RNG = np.random.default_rng(0)
ARRAYS = [RNG.normal(size=(3, 4)), np.arange(6, dtype=np.int16).reshape(2, 3), np.array([[True, False]]), np.zeros((0, 2)), 2.5]


@pytest.mark.parametrize("compressed", [False, True])
def test_numbers_of_structures_come_back(tmp_path, compressed):
    path = tmp_path / "a.mat"
    rows = np.array([(one, {"deep": one}, "text") for one in ARRAYS], dtype=[(name, object) for name in ("plain", "below", "note")])
    content = {"first": np.zeros(3), "as_structures": rows[None], "as_cells": [{"plain": one} for one in ARRAYS]}
    savemat(path, content, do_compression=compressed)
    found = read_variable(path, "as_structures").parts("plain", "below")
    cells = read_variable(path, "as_cells").parts("plain")
    assert len(found) == len(cells) == len(ARRAYS)
    for wanted, one, cell in zip(ARRAYS, found, cells):
        (below,) = one["below"].parts("deep")
        for matrix in (one["plain"], below["deep"], cell["plain"]):
            np.testing.assert_array_equal(matrix.values(), np.atleast_2d(wanted))
    assert found[-1]["plain"].number() == 2.5
    assert read_variable(path, "absent") is None


def test_the_other_byte_order_is_read(tmp_path):
    flags, sizes = struct.pack(">IIII", 6, 8, 6, 0), struct.pack(">IIii", 5, 8, 2, 1)
    content = flags + sizes + struct.pack(">HH4s", 1, 1, b"a") + struct.pack(">IIdd", 9, 16, 1.5, -3.0)
    file = tmp_path / "a.mat"
    file.write_bytes(bytes(124) + struct.pack(">H", 0x0100) + b"MI" + struct.pack(">II", 14, len(content)) + content)
    np.testing.assert_array_equal(read_variable(file, "a").values(), [[1.5], [-3.0]])


@pytest.mark.parametrize(
    ("value", "match"),
    [(np.array([[1j]]), "complex"), ("word", "class 4"), ({"a": 1.0}, "class 2"), (np.ones((2, 2)), "expected a number")],
)
def test_what_is_no_number_is_refused(tmp_path, value, match):
    savemat(tmp_path / "a.mat", {"a": value})
    with pytest.raises(ValueError, match=match):
        read_variable(tmp_path / "a.mat", "a").number()


def test_what_unpacks_to_too_much_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("NEUIDO_MAX_ARRAY_ELEMENTS", "1000")
    packed = zlib.compress(bytes(100_000))
    head = bytes(124) + struct.pack("<H", 0x0100) + b"IM"
    (tmp_path / "a.mat").write_bytes(head + struct.pack("<II", 15, len(packed)) + packed)
    with pytest.raises(UserError, match=r"a\.mat has .* numbers or more, more than the limit of 1000"):
        read_variable(tmp_path / "a.mat", "a")
    (tmp_path / "a.mat").write_bytes(head[:124] + struct.pack("<H", 0x0200) + b"IM")
    with pytest.raises(UserError, match=r"no MATLAB file of version 5 to 7.*-v7"):
        read_variable(tmp_path / "a.mat", "a")
