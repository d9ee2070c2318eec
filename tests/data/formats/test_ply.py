"""PLY files: elements before the vertices, columns of lists, and headers that promise more than the file holds."""

import tracemalloc

import numpy as np
import pytest

from neuido.data.formats.ply import ply_bytes, read_ply_header, read_ply_vertices
from neuido.errors import UserError
from tests.data.formats.ply_samples import write_ply

VERTICES = np.array([(0.5, -1.25, 7, 255), (1e-30, 3.0, -9, 0)], [("x", "f4"), ("y", "f8"), ("mark", "i4"), ("red", "u1")])


@pytest.mark.parametrize("form", ["text", "little", "big"])
@pytest.mark.parametrize("faces", [None, [], [[0, 1, 1], [1, 0, 1, 0, 1]]])
@pytest.mark.parametrize("end", [b"\n", b"\r\n"])
def test_vertices_are_read_as_they_were_written(tmp_path, form, faces, end):
    path = write_ply(tmp_path / "a.ply", VERTICES, form=form, faces=faces, comments=["element vertex 9", "é"])
    head, mark, body = path.read_bytes().partition(b"end_header\n")
    path.write_bytes(head.replace(b"\n", end) + mark.replace(b"\n", end) + body)
    read = read_ply_vertices(path)
    assert all(np.array_equal(read[name], VERTICES[name]) for name in VERTICES.dtype.names)


def test_columns_of_lists_are_arrays(tmp_path):
    head = "ply\nformat {} 1.0\nelement vertex 2\nproperty float x\nproperty list uchar short near\nend_header\n"
    (tmp_path / "a.ply").write_bytes(head.format("ascii").encode() + b"1.5 2 7 -8\n2.5 0\n")
    rows = np.float32(1.5).tobytes() + b"\x02\x07\x00\xf8\xff" + np.float32(2.5).tobytes() + b"\x00"
    (tmp_path / "b.ply").write_bytes(head.format("binary_little_endian").encode() + rows)
    for name in ("a.ply", "b.ply"):
        read = read_ply_vertices(tmp_path / name)
        assert read["x"].tolist() == [1.5, 2.5] and [each.tolist() for each in read["near"]] == [[7, -8], []]


def test_what_is_written_is_the_usual_form(tmp_path):
    (tmp_path / "a.ply").write_bytes(ply_bytes(VERTICES[["x", "y"]]))
    assert (
        (tmp_path / "a.ply")
        .read_bytes()
        .startswith(b"ply\nformat binary_little_endian 1.0\nelement vertex 2\nproperty float x\nproperty float y\nend_header\n")
    )
    read = read_ply_vertices(tmp_path / "a.ply")
    assert read["x"].tolist() == VERTICES["x"].tolist() and read["y"].tolist() == [-1.25, 3.0]


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        (b"list uchar int", b"list uint double", "it ends inside of a row"),
        (b"list uchar int", b"list float int", "its header has the line 'property list float int"),
        (b"list uchar int", b"list char int", "has the length -1"),
        (b"element face 1", b"element face 900", "is truncated: element face has 900 rows"),
        (b"element face 1", b"element vertex 1", "element vertex is there twice"),
        (b"element face 1", b"element face 0", "needs 50 bytes, and"),
        (b"element vertex 2", b"element vertices 2", "its elements are face, vertices"),
        (b"format", b"formal", "its header has the line 'formal"),
        (b"format binary_little_endian 1.0\n", b"", "its header lacks the line of the format"),
        (b"ply\n", b"ply\nproperty float z\n", "its header has the line 'property float z'"),
        (b"end_header", b"property float x\nend_header", "not a valid PLY file with vertices"),
        (b"end_header", b"end_headers", "its header has the line 'end_headers'"),
    ],
)
def test_headers_that_lie_are_refused_before_memory_is_taken(tmp_path, old, new, match):
    path = write_ply(tmp_path / "a.ply", VERTICES, faces=[[0, 1, 1]])
    if new.startswith(b"list"):
        path.write_bytes(path.read_bytes().replace(b"end_header\n\x03", b"end_header\n\xff"))
    if b"face 0" in new:
        path.write_bytes(path.read_bytes().replace(b"double y", b"double y\nproperty double z"))
    path.write_bytes(path.read_bytes().replace(old, new, 1))
    tracemalloc.start()
    try:
        with pytest.raises(UserError, match=match) as error:
            read_ply_vertices(path)
        assert tracemalloc.get_traced_memory()[1] < 5e6
    finally:
        tracemalloc.stop()
    assert str(path) in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("body", ["1 2 3\n", "1 2\n\n", "1 2\n3 x\n", "1 2\n3 4.5\n"])
def test_damaged_text_is_refused(tmp_path, body):
    head = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty int y\nend_header\n"
    (tmp_path / "a.ply").write_text(head + body)
    assert [each.name for each in read_ply_header(tmp_path / "a.ply").elements] == ["vertex"]
    with pytest.raises(UserError, match="not a valid PLY file with vertices"):
        read_ply_vertices(tmp_path / "a.ply")
