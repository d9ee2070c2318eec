"""Tables of DeepLabCut in HDF5, in both layouts of pandas, without pandas and without unpickling."""

import io
import pickle

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import neuido
from neuido.data.importers.pandas_hdf5 import read_frame
from neuido.errors import UserError

h5py = pytest.importorskip("h5py")
NAMES = [("net", part, kind) for part in ("ball", "nose") for kind in ("x", "y", "likelihood")]
T = np.arange(12)
VALUES = np.stack([200 + 4 * T, 300 - 9 * T + 0.6 * T**2, np.full(12, 0.99), 5 * T, 5 * T, np.where(T == 3, 0.2, 0.9)], 1)


def table(path, *, names=None, values=VALUES, protocol=0):
    """Write the layout `table` as pandas does."""
    with h5py.File(path, "w") as file:
        group = file.create_group("df_with_missing")
        rows = np.zeros(len(values), [("index", "<i8"), ("values_block_0", "<f8", (values.shape[1],))])
        rows["index"], rows["values_block_0"] = np.arange(len(values)), values
        own = group.create_dataset("table", data=rows)
        own.attrs["values_block_0_kind"] = np.void(pickle.dumps(NAMES if names is None else names, protocol))
    return path


def fixed(path):
    """Write the layout `fixed` as pandas does."""
    with h5py.File(path, "w") as file:
        group = file.create_group("df_with_missing")
        group.attrs["block0_items_nlevels"] = 3
        group["block0_values"], group["axis1"] = VALUES, np.arange(12)
        for level in range(3):
            texts = sorted({name[level] for name in NAMES})
            group[f"block0_items_level{level}"] = np.array([text.encode() for text in texts])
            group[f"block0_items_label{level}"] = np.array([texts.index(name[level]) for name in NAMES], np.int8)
    return path


@pytest.mark.parametrize("write", [table, fixed])
def test_both_layouts_become_a_track(tmp_path, write):
    path = write(tmp_path / "dlc.h5")
    neuido.import_file(path, tmp_path / "out", point="ball", scale=0.01, frame_rate=30.0, y_down=True)
    (track,) = neuido.read_tracks(tmp_path / "out").recordings
    np.testing.assert_allclose(track.t, T / 30)
    np.testing.assert_allclose(np.diff(track.x, axis=0), np.diff(VALUES[:, :2] * [0.01, -0.01], axis=0), atol=1e-12)
    with pytest.raises(UserError, match="--frame_rate"):
        neuido.import_file(path, tmp_path / "none", point="ball", scale=0.01)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    names=st.lists(st.tuples(st.text(max_size=8), st.text(max_size=8), st.sampled_from(["x", "y", "likelihood"])), min_size=1, max_size=6),
    protocol=st.integers(0, 5),
)
def test_names_are_read_as_they_were_written(tmp_path, names, protocol):
    path = table(tmp_path / "a.h5", names=names, values=np.zeros((3, len(names))), protocol=protocol)
    assert read_frame(path)[0] == names


class Calling:
    def __reduce__(self):
        return print, ("executed",)


@pytest.mark.parametrize("names", [[Calling()], {"a": 1}, [("a", 1)], "text", [["a"]], [("net", "ball", "x")]])
def test_other_names_are_refused_and_nothing_is_called(tmp_path, capsys, names):
    with pytest.raises(UserError, match=r"a\.h5"):
        read_frame(table(tmp_path / "a.h5", names=names))
    assert capsys.readouterr().out == ""


def test_files_that_lead_elsewhere_are_refused(tmp_path):
    (tmp_path / "secret").write_bytes(np.zeros(72).tobytes())
    with h5py.File(tmp_path / "a.h5", "w") as file:
        group = file.create_group("df")
        group.attrs["block0_items_nlevels"] = 0
        group.create_dataset("block0_values", (12, 6), "f8", external=[(str(tmp_path / "secret"), 0, 576)])
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["df"] = h5py.ExternalLink(str(tmp_path / "a.h5"), "/df")
    with h5py.File(tmp_path / "c.h5", "w") as file:
        file.create_group("df")["table"] = h5py.ExternalLink(str(tmp_path / "a.h5"), "/df/block0_values")
    for name, words in (("a.h5", "lies in another file"), ("b.h5", "has no table"), ("c.h5", "lies in another file")):
        with pytest.raises(UserError, match=words):
            read_frame(tmp_path / name)
    (tmp_path / "d.h5").write_bytes(b"\x89HDF\r\n\x1a\n" + io.BytesIO(b"\0" * 60).getvalue())
    with pytest.raises(UserError, match="not a valid HDF5 file of pandas"):
        read_frame(tmp_path / "d.h5")


def test_an_array_that_claims_more_numbers_than_a_word_counts(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        group = file.create_group("df")
        group.attrs["block0_items_nlevels"] = 0
        group.create_dataset("block0_values", (2**33, 2**31), "f8", chunks=(1, 8))
    with pytest.raises(UserError, match=f"block0_values has {2**64} numbers, more than the limit"):
        read_frame(tmp_path / "a.h5")
