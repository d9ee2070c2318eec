"""PLY files of Gaussians: what editors and other tools write is read, or named for what it is."""

import gzip
import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from neuido.data.formats.gaussian_ply import column_names, read_gaussian_vertices
from neuido.errors import UserError
from tests.data.formats.ply_samples import write_ply


def write(path: Path, rows: int = 5, *, names=None, text: bool = False, comments=(), change=lambda v: None) -> Path:
    names = names or column_names(0)
    vertices = np.zeros(rows, [(name, "f4") for name in names])
    for i, name in enumerate(names):
        vertices[name] = np.arange(rows) + 0.1 * i
    change(vertices)
    return write_ply(path, vertices, form="text" if text else "little", comments=comments)


def refused(path: Path, match: str) -> None:
    with pytest.raises(UserError, match=match) as error:
        read_gaussian_vertices(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("text", [False, True])
def test_comment_that_is_not_ascii(tmp_path, text):
    path = write(tmp_path / "a.ply", text=text, comments=["exported by Mueller"])
    path.write_bytes(path.read_bytes().replace(b"Mueller", "M\u00fcller \u751f\u6210".encode()))
    read = read_gaussian_vertices(path)
    assert len(read) == 5 and read["rot_3"][4] == pytest.approx(4 + 0.1 * column_names(0).index("rot_3"))


@pytest.mark.parametrize("column", ["x", "f_dc_1", "opacity", "rot_0"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_rows_that_are_not_finite_are_left_out_and_named(tmp_path, column, value):
    def set_rows(vertices):
        vertices[column][[1, 3]] = value

    path = write(tmp_path / "a.ply", change=set_rows)
    with pytest.warns(UserWarning, match="2 of 5 Gaussians contain a NaN or an infinity and are dropped: rows 1, 3"):
        assert len(read_gaussian_vertices(path)) == 3
    refused(write(tmp_path / "b.ply", change=lambda v: v[column].fill(value)), "all 5 Gaussians contain a NaN or an infinity")


def test_normals_may_be_anything(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(read_gaussian_vertices(write(tmp_path / "a.ply", change=lambda v: v["nx"].fill(np.nan)))) == 5


def test_other_kinds_of_files_are_named(tmp_path):
    packed = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
    refused(write(tmp_path / "a.ply", names=packed), "compressed PLY file .* export the Gaussians as an uncompressed .ply")
    refused(write(tmp_path / "b.ply", names=[n for n in column_names(0) if n not in ("scale_2",)]), "2D Gaussians")
    refused(write(tmp_path / "c.ply", names=["x", "y", "z"]), "not a 3DGS file: its vertices lack the columns f_dc_0")
    refused(write(tmp_path / "d.ply", names=[*column_names(0), "f_rest_0"]), "1 f_rest columns")
    refused(write(tmp_path / "e.ply", rows=0), "contains no Gaussian")
    whole = write(tmp_path / "f.ply").read_bytes()
    for name, content, match in (
        ("g.ply", gzip.compress(whole), "not a PLY file .a gzip file"),
        ("h.ply", np.arange(64, dtype="f4").tobytes(), "perhaps a .splat file"),
        ("i.ply", whole[:40], "its header lacks end_header"),
        ("j.ply", whole[:-9], "not a valid PLY file with vertices"),
        ("k.ply", whole.replace(b"vertex 5", b"vertex 500000"), "is truncated: element vertex has 500000 rows"),
        ("l.ply", whole.replace(b"vertex 5", b"vertex 99999999999"), "NEUIDO_MAX_PARTICLES"),
        ("m.ply", whole.replace(b"vertex 5", b"vertex -5"), "count '-5'; it must be a whole number"),
        ("n.ply", whole.replace(b"element vertex", b"element points"), "not a valid PLY file with vertices"),
        ("o.ply", whole.replace(b"float x", b"quark x"), "not a valid PLY file with vertices"),
    ):
        (tmp_path / name).write_bytes(content)
        refused(tmp_path / name, match)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(cut=st.integers(0, 700), noise=st.binary(max_size=12), text=st.booleans())
def test_damaged_files_end_in_one_line(tmp_path, cut, noise, text):
    whole = write(tmp_path / "whole.ply", text=text).read_bytes()
    path = tmp_path / "a.ply"
    path.write_bytes(whole[:cut] + noise + whole[cut + len(noise) :])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            read = read_gaussian_vertices(path)
            message = f"{path}"
            assert np.isfinite(read["x"]).all() and len(read) <= 5
        except UserError as error:
            message = str(error)
    assert str(path) in message and "\n" not in message


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    rest=st.sampled_from([0, 9, 24, 45]),
    normals=st.booleans(),
    order=st.randoms(use_true_random=False),
    form=st.sampled_from(["text", "little", "big"]),
    kind=st.sampled_from(["f4", "f8"]),
    bad=st.dictionaries(st.integers(0, 4), st.sampled_from([np.nan, np.inf, -np.inf]), max_size=4),
    comment=st.text(st.characters(min_codepoint=32, exclude_categories=["Cs", "Cc", "Zl", "Zp"]), max_size=12),
)
def test_any_kind_of_gaussians_is_read_as_it_was_written(tmp_path, rest, normals, order, form, kind, bad, comment):
    names = [name for name in column_names(rest) if normals or not name.startswith("n")]
    column = order.choice([name for name in names if not name.startswith("n")])
    order.shuffle(names)
    vertices = np.zeros(5, [(name, kind) for name in names])
    for i, name in enumerate(names):
        vertices[name] = np.arange(5) + 0.25 * i
    for row, value in bad.items():
        vertices[column][row] = value
    path = tmp_path / "a.ply"
    write_ply(path, vertices, form=form)
    path.write_bytes(path.read_bytes().replace(b"end_header", f"comment {comment}\nend_header".encode(), 1))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        read = read_gaussian_vertices(path)
    kept = [row for row in range(5) if row not in bad]
    assert all(np.allclose(read[name], vertices[name][kept]) for name in names)
