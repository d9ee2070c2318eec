"""Tables of any dialect, with units anywhere, rows in any order and clocks of any origin give the same numbers."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import neuido
from neuido.data.importers.machines.testing_machine import Specimen

pytest.importorskip("pint")
DIALECTS = [(",", "."), (";", ","), (";", "."), ("\t", "."), ("\t", ",")]
STRAIN = np.linspace(0, 0.4, 21)
STRESS = 3e5 * STRAIN
T = np.arange(31) / 30
FLIGHT = np.stack([0.3 + 2 * T, 1 + 4 * T - 4.905 * T**2], 1)


def titled(name, unit, place):
    """A title with its unit in brackets or after a slash, or a title and the unit for a row below."""
    return {"round": f"{name} ({unit})", "square": f"{name} [{unit}]", "slash": f"{name} / {unit}", "row": name}[place]


@settings(max_examples=15, deadline=None)
@given(
    dialect=st.sampled_from(DIALECTS),
    place=st.sampled_from(["round", "square", "slash", "row"]),
    strain=st.sampled_from([("Strain", "%", 100.0), ("Dehnung", "mm/mm", 1.0), ("Extension", "mm", 50.0), ("Weg", "µm", 5e4)]),
    stress=st.sampled_from([("Stress", "MPa", 1e-6), ("Spannung", "kPa", 1e-3), ("Load", "N", 20e-6), ("Kraft", "kN", 2e-8)]),
    clock=st.sampled_from([None, ("Time", "s", 1.0), ("Zeit", "ms", 1e3), ("Total time", "min", 1 / 60)]),
    order=st.permutations([0, 1, 2]),
    preamble=st.lists(st.sampled_from(["Bediener: Müller", "Machine;5900", "# a comment", "Test 12"]), max_size=3),
    encoding=st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "cp1252"]),
)
def test_machines(tmp_path_factory, dialect, place, strain, stress, clock, order, preamble, encoding):
    separator, decimal = dialect
    folder = tmp_path_factory.mktemp("kinds")
    columns = [(*strain, STRAIN), (*stress, STRESS), *([(*clock, 0.1 * np.arange(21))] if clock else [])]
    columns = [columns[i] for i in order if i < len(columns)]
    rows = [[f"{factor * values[i]:.12f}".replace(".", decimal) for _, _, factor, values in columns] for i in range(21)]
    head = [titled(name, unit, place) for name, unit, _, _ in columns]
    lines = [*preamble, separator.join(head), *([separator.join(unit for _, unit, _, _ in columns)] if place == "row" else [])]
    path = folder / "a.csv"
    path.write_bytes("\r\n".join([*lines, *(separator.join(row) for row in rows), ""]).encode(encoding))
    neuido.import_file(path, folder / "out", specimen=Specimen("50 mm", "10 mm", "2 mm"))
    (test,) = neuido.read_material_tests(folder / "out").tests
    np.testing.assert_allclose(test.path[:, 0], 1 + STRAIN, atol=1e-8)
    np.testing.assert_allclose(test.stress[:, 0], STRESS, rtol=1e-4, atol=1.0)
    assert (test.time is None) == (clock is None)
    if clock:
        np.testing.assert_allclose(test.time, 0.1 * np.arange(21), atol=1e-6)


CLOCKS = {
    "seconds": ("t (s)", lambda t: f"{t:.6f}", {}),
    "milliseconds": ("t (ms)", lambda t: f"{1e3 * t:.3f}", {}),
    "Unix time": ("timestamp", lambda t: f"{1.7e9 + t:.6f}", {}),
    "Unix time in ms": ("timestamp", lambda t: f"{1.7e12 + 1e3 * t:.3f}", {}),
    "time of day": ("Time", lambda t: f"12:{int(t) // 60:02d}:{t % 60:09.6f}", {}),
    "date and time": ("Time", lambda t: f"2024-02-29 23:{int(t) // 60:02d}:{t % 60:09.6f}", {}),
    "frames": ("frame", lambda t: f"{round(30 * t)}", {"frame_rate": 30.0}),
}


@settings(max_examples=15, deadline=None)
@given(
    dialect=st.sampled_from(DIALECTS),
    clock=st.sampled_from(list(CLOCKS)),
    start=st.integers(0, 1000),
    length=st.sampled_from([("m", 1.0), ("mm", 1e3), ("cm", 1e2), ("in", 1 / 0.0254)]),
    shuffled=st.booleans(),
    repeated=st.sets(st.integers(0, 30), max_size=4),
    lost=st.sets(st.integers(1, 29), max_size=4),
    mark=st.sampled_from(["", "0", "-9999", "nan"]),
    upside_down=st.booleans(),
)
def test_tracks(tmp_path_factory, dialect, clock, start, length, shuffled, repeated, lost, mark, upside_down):
    separator, decimal = dialect
    folder = tmp_path_factory.mktemp("kinds")
    title, written, options = CLOCKS[clock]
    sign = -1 if upside_down else 1
    rows = []
    for i in [*range(31), *sorted(repeated)]:
        place = [f"{factor * v:.9f}" for factor, v in zip((length[1], sign * length[1]), FLIGHT[i])]
        cells = [written(T[i] + start), *([mark, mark] if i in lost else place)]
        rows.append(separator.join(cell.replace(".", decimal) for cell in cells))
    if shuffled:
        rows = [rows[i] for i in np.random.default_rng(start).permutation(len(rows))]
    head = separator.join([title, f"x ({length[0]})", f"y ({length[0]})"])
    (folder / "a.csv").write_text("\n".join([head, *rows, ""]))
    neuido.import_file(folder / "a.csv", folder / "out", y_down=upside_down, **options)
    (track,) = neuido.read_tracks(folder / "out").recordings
    seen = [i for i in range(31) if i not in lost]
    np.testing.assert_allclose(track.t, T[seen] - T[seen[0]], atol=2e-5 if "Unix" not in clock else 2e-3)
    np.testing.assert_allclose(track.x, FLIGHT[seen], atol=1e-6)


def test_titles_in_a_comment(tmp_path):
    (tmp_path / "a.txt").write_text("# made by savetxt\n# t x y\n" + "\n".join(f"{t} {x} {y}" for t, (x, y) in zip(T, FLIGHT)))
    neuido.import_file(tmp_path / "a.txt", tmp_path / "out")
    np.testing.assert_allclose(neuido.read_tracks(tmp_path / "out").recordings[0].x, FLIGHT)
