"""Tracks of bodies that are held before they fly."""

import warnings

import numpy as np
import pytest

import neuido
from neuido.data.measured.held_start import held_rows
from neuido.data.measured.track import read_tracks
from neuido.errors import PlausibilityWarning

G = [0.0, -9.81]
T = np.arange(72) / 120


def drop(held: float, *, noise: float = 2e-4, speed: float = 0.0, seed: int = 0) -> np.ndarray:
    fallen = np.maximum(T - held, 0.0)
    path = np.stack([0.3 * fallen, 1.0 + speed * fallen - 4.905 * fallen**2], 1)
    return path + noise * np.random.default_rng(seed).standard_normal(path.shape)


@pytest.mark.parametrize("held", [0.1, 0.2, 0.3])
@pytest.mark.parametrize("noise", [0.0, 2e-4, 1e-3])
def test_a_held_start_is_found(held, noise):
    """At the first row that is off, the body has fallen by no more than the band of the noise."""
    late = T[held_rows(T, drop(held, noise=noise), G)] - held
    assert 0 <= late <= np.sqrt(2 * 9 * noise / 9.81) + 2 / 120


@pytest.mark.parametrize("speed", [0.0, 0.5, 2.0])
@pytest.mark.parametrize("noise", [0.0, 2e-4, 5e-3])
def test_a_flight_from_the_first_row_is_none(speed, noise):
    assert all(held_rows(T, drop(0.0, noise=noise, speed=speed, seed=seed), G) == 0 for seed in range(50))


def test_what_has_no_weight_or_never_leaves_is_none():
    assert held_rows(T, drop(0.2), [0.0, 0.0]) == 0
    assert held_rows(T, drop(1.0), G) == 0
    assert held_rows(T[:6], drop(0.02)[:6], G) == 0


def write(path, x):
    np.savetxt(path, np.column_stack([T, x]), delimiter=",", header="t,x,y", comments="")
    return path


def test_an_import_leaves_the_held_rows_out_and_a_folder_is_told(tmp_path):
    files = [write(tmp_path / "a.csv", drop(0.1)), write(tmp_path / "b.csv", drop(0.2, seed=1))]
    lines = neuido.import_file(files, tmp_path / "out", kind="track")
    assert sum("held at first" in line for line in lines) == 2
    with warnings.catch_warnings():
        warnings.simplefilter("error", PlausibilityWarning)
        tracks = read_tracks(tmp_path / "out")
    assert all(held_rows(track.t, track.x, G) == 0 for track in tracks.recordings)
    file = tmp_path / "out" / "a.csv"
    write(file, drop(0.1))
    with pytest.warns(
        PlausibilityWarning, match=r"keeps its height for 0\.1\d* s, longer than a free body can: leave the first 1\d data rows"
    ):
        read_tracks(tmp_path / "out")
    header = tmp_path / "out" / "track.yaml"
    header.write_text(header.read_text().replace("nuisances: {", "nuisances: {release_time: 0.2, "))
    with warnings.catch_warnings():
        warnings.simplefilter("error", PlausibilityWarning)
        read_tracks(tmp_path / "out")
