"""Untrusted files: every failure of a parser is one line with the file, and sizes are checked before memory is asked for."""

import io
import struct
import zipfile
import zlib

import cv2
import numpy as np
import pytest
import torch

from neuido.data.files.parsing import image_size, parser_errors, read_arrays, read_image, read_json, read_table, read_yaml
from neuido.errors import UserError
from neuido.physics.runtime.limits import limit


def refused(call, path, match):
    with pytest.raises(UserError, match=match) as error:
        call(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("content", "match"),
    [
        (b"[" * 100_000, "not valid YAML: it is nested too deeply"),
        (b"a: 2026-13-45", "not valid YAML: month must be in"),
        (b"a: " + b"9" * 5000, "not valid YAML: Exceeds the limit"),
        (b"a: !!timestamp x", "not valid YAML"),
        (b"? [a]\n: 1", "not valid YAML: while constructing a mapping"),
        (b"a: &a [*a]", "not valid YAML: line 1: an alias refers to a node that contains it"),
        (b"a: *b", "not valid YAML: found undefined alias"),
        (b"a: \xff", "not valid YAML: 'utf-8' codec"),
        (b"a: \x01", "not valid YAML: unacceptable character"),
        (b"a: !!python/object/apply:os.getcwd []", "not valid YAML: could not determine a constructor"),
        (b"", "must contain a mapping"),
    ],
)
def test_yaml_that_cannot_be_read(tmp_path, content, match):
    path = tmp_path / "a.yaml"
    path.write_bytes(content)
    refused(read_yaml, path, match)


def test_yaml_whose_aliases_expand(tmp_path, monkeypatch):
    path = tmp_path / "a.yaml"
    path.write_text(
        "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n" + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 9))
    )
    refused(
        read_yaml,
        path,
        "aliases expand to too many values, more than the limit of 1000000: raise it with the environment variable NEUIDO_MAX_YAML_NODES",
    )
    path.write_text("a: &a [1, 2]\nb: *a\nc: 1e5\n")
    assert read_yaml(path) == {"a": [1, 2], "b": [1, 2], "c": 1e5}
    monkeypatch.setenv("NEUIDO_MAX_YAML_NODES", "5")
    refused(read_yaml, path, "more than the limit of 5")
    monkeypatch.setenv("NEUIDO_MAX_YAML_NODES", "many")
    with pytest.raises(UserError, match="NEUIDO_MAX_YAML_NODES must be a positive whole number, got 'many'"):
        limit("NEUIDO_MAX_YAML_NODES")


@pytest.mark.parametrize("content", [b"[" * 100_000, b"{", b"\xff", b"9" * 5000, b"", b"NaN x"])
def test_json_that_cannot_be_read(tmp_path, content):
    path = tmp_path / "a.json"
    path.write_bytes(content)
    refused(read_json, path, "is not valid JSON: .")


def test_byte_order_mark_is_no_content(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"\xef\xbb\xbf" + b'{"a": 1}')
    assert read_json(path) == read_yaml(path) == {"a": 1}
    path.write_bytes(b"\xef\xbb\xbft,x\r\n\r\n0,1\r\n")
    assert read_table(path) == [["t", "x"], ["0", "1"]]


@pytest.mark.parametrize("content", [b'a,"b\n1,2', b"\xff\xfe", b"a," + b"1" * 200_000])
def test_csv_that_cannot_be_read(tmp_path, content):
    path = tmp_path / "a.csv"
    path.write_bytes(content)
    refused(read_table, path, "is not a valid CSV file: .")


def npy(header: str, data: bytes = b"", version: bytes = b"\x01\x00") -> bytes:
    text = header.encode() + b"\n"
    return b"\x93NUMPY" + version + struct.pack("<H", len(text)) + text + data


def archive(path, member: bytes, name: str = "x.npy"):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as out:
        out.writestr(name, member)


@pytest.mark.parametrize(
    ("member", "match"),
    [
        (
            npy("{'descr': '<f8', 'fortran_order': False, 'shape': (1000000, 1000000), }"),
            "has 1000000000000 elements, .*NEUIDO_MAX_ARRAY_ELEMENTS",
        ),
        (npy("{'descr': '|O', 'fortran_order': False, 'shape': (1,), }"), "not numbers"),
        (npy("{'descr': '<f8', 'fortran_order': False, 'shape': (4,), }", b"abc"), "is not a valid archive of x: "),
        (npy("{'descr': '<f8', 'fortran_order': False, 'shape': (4,)"), "is not a valid archive of x: "),
        (npy("x" * 30000), "is not a valid archive of x: "),
        (npy("{'descr': '<f8', 'fortran_order': False, 'shape': (-1,), }"), "is not a valid archive of x: "),
        (npy("", version=b"\x09\x00"), r"version \(9, 0\)"),
        (b"", "is not a valid archive of x: "),
    ],
)
def test_arrays_that_cannot_be_read(tmp_path, member, match):
    path = tmp_path / "a.npz"
    archive(path, member)
    refused(lambda p: read_arrays(p, ["x"]), path, match)


def test_damaged_archives(tmp_path):
    path = tmp_path / "a.npz"
    np.savez_compressed(path, x=np.arange(1000.0))
    whole = path.read_bytes()
    start = whole.index(b"x.npy") + 40
    for content in (b"", whole[:300], whole[:start] + b"\xff" * 60 + whole[start + 60 :]):
        path.write_bytes(content)
        refused(lambda p: read_arrays(p, ["x"]), path, "is not a valid archive of x: .")
    path.write_bytes(whole)
    refused(lambda p: read_arrays(p, ["y"]), path, "lacks the array 'y'; it has x")
    refused(lambda p: read_arrays(p, [], ["y"], others=False), path, "unknown array 'x'; it takes y")
    assert (read_arrays(path, ["x"], ["y"])["x"] == np.arange(1000.0)).all()
    with pytest.raises(UserError, match="is missing"):
        read_arrays(tmp_path / "b.npz", ["x"])


@pytest.mark.parametrize("kind", ["f8", "f4", "f2", "i4", "u2"])
def test_arrays_of_another_byte_order_are_read_as_native_ones(tmp_path, kind):
    given = np.arange(6).reshape(2, 3)
    np.savez(tmp_path / "a.npz", x=given.astype(f">{kind}"), y=given.astype(f"<{kind}"))
    for array in read_arrays(tmp_path / "a.npz", ["x", "y"]).values():
        assert array.dtype == np.dtype(kind) and array.dtype.isnative and np.array_equal(array, given)
        assert torch.from_numpy(array.astype(np.float64, copy=False)).sum() == 15


def test_images(tmp_path):
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), np.zeros((3, 5, 4), np.uint16))
    assert image_size(path) == (5, 3) and read_image(path).shape == (3, 5, 4)
    header = struct.pack(">IIBBBBB", 100_000, 100_000, 8, 2, 0, 0, 0)
    chunk = b"IHDR" + header
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + struct.pack(">I", 13)
        + chunk
        + struct.pack(">I", zlib.crc32(chunk))
        + struct.pack(">I", 9)
        + b"IDAT"
        + bytes(13)
    )
    for call in (image_size, read_image):
        refused(call, path, "has more than the limit of 134217728 pixels: raise it with the environment variable NEUIDO_MAX_IMAGE_PIXELS")
    path.write_bytes(io.BytesIO(b"no image").getvalue())
    for call in (image_size, read_image):
        refused(call, path, "not an image")


def test_a_panic_of_a_parser_is_a_refusal_and_an_interruption_is_none(tmp_path):
    """Parsers in Rust panic by an exception that is no `Exception`."""
    panic = type("PanicException", (BaseException,), {})
    with pytest.raises(UserError, match=r"book\.xlsx is not a valid spreadsheet: byte index 9 is out of bounds"):
        with parser_errors(tmp_path / "book.xlsx", "spreadsheet"):
            raise panic("byte index 9 is\nout of bounds")
    for stop in (KeyboardInterrupt, SystemExit):
        with pytest.raises(stop), parser_errors(tmp_path / "book.xlsx", "spreadsheet"):
            raise stop
