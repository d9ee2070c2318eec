"""One made sample of each layout, imported to a folder and read back: the table of importers.

    python -m tests.data.importers.round_trips --write

The samples are those of the tests, whose names the table gives. --write puts it into research/results/importers.md.
"""

import argparse
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

import neuido
from neuido.data.files.writing import write_text
from neuido.data.importers.machines.testing_machine import Specimen
from tests.data.importers import test_importing, test_kinovea, test_more_languages, test_pandas_hdf5
from tests.data.importers.fields import test_fields, test_plane_folder
from tests.data.importers.machines import test_layouts

PAGE = Path(__file__).parents[3] / "research" / "results" / "importers.md"
HEAD = """# Importers, layout by layout

A made sample of each layout is imported to a folder and read back (`tests/data/importers/round_trips.py`). "Apart" is the largest
difference of the columns from the numbers that the sample was made of, relative to the largest number of each; samples have 6 to 9 digits,
those of full fields noise of 1e-5 of the strip.

"""
SIZES = Specimen("50 mm", "10 mm", "2 mm")


class Sample(NamedTuple):
    """A made file of one layout, and what is read back of it."""

    layout: str
    make: Callable[[Path], object]
    """Writes the file or files into a folder; returns their paths."""
    options: dict
    columns: Callable[[Path], list[tuple[str, np.ndarray, np.ndarray]]]
    """Reads the folder of the import; returns name, values and right values of each column."""
    test: str


def uniaxial(stretch: np.ndarray, stress: np.ndarray, count: int = 1):
    """Return a reader of material tests: stretch and nominal stress, the stress of the second specimen that of the samples."""

    def read(folder: Path):
        tests = neuido.read_material_tests(folder).tests
        assert len(tests) == count
        out = []
        for n, (test, factor) in enumerate(zip(tests, (1.0, test_layouts.SOFT))):
            name = f" of specimen {n + 1}" if count > 1 else ""
            out += [(f"stretch{name}", test.path[:, 0], stretch), (f"stress [Pa]{name}", test.stress[:, 0], factor * stress)]
        return out

    return read


def flight(axes: int = 3, times: np.ndarray = test_importing.T, places: np.ndarray = test_importing.FLIGHT):
    """Return a reader of tracks: times from the first one, and places."""

    def read(folder: Path):
        (track,) = neuido.read_tracks(folder).recordings
        return [("t [s]", track.t - track.t[0], times), (f"{'xyz'[:axes]} [m]", track.x, places[:, :axes])]

    return read


def language(kind: str):
    """Return what writes a tracker's export of `test_more_languages`."""
    return lambda folder: test_more_languages.write(folder / "a.tsv", test_more_languages.TRACKERS[kind][0])


def kinovea(folder: Path) -> Path:
    """Write a table of Kinovea."""
    rows = [["Time", "Marker 1/0/X", "Marker 1/0/Y"], *test_kinovea.CENTIMETRES]
    (folder / "kinovea.csv").write_text(test_kinovea.quoted(rows, ",", "."), newline="")
    return folder / "kinovea.csv"


def deeplabcut(folder: Path):
    """Read the moves of the ball of DeepLabCut's sample, whose origin is free."""
    (track,) = neuido.read_tracks(folder).recordings
    moves = np.diff(test_pandas_hdf5.VALUES[:, :2] * [0.01, -0.01], axis=0)
    return [("t [s]", track.t, test_pandas_hdf5.T / 30), ("moves of x, y [m]", np.diff(track.x, axis=0), moves)]


def plane(folder: Path):
    """Read displacements and forces of the sample of a finite element program."""
    found = neuido.read_plane_experiment(folder)
    x = np.array([row[:2] for row in test_plane_folder.NODES])
    moved = np.stack([1e-3 * np.array([0.01, -0.003]) * step * x for step in (2, 10)])
    force = np.array([[20.0, -20.0, 0.0]]) * [[2], [10]]
    return [("u [m]", found.recordings[0].displacement, moved), ("forces [N]", found.recordings[0].force, force)]


def samples() -> list[Sample]:
    """Return the samples of all layouts."""
    one, several = "test_importing.py::", "machines/test_layouts.py::test_several_specimens"
    strained = uniaxial(test_importing.STRETCH, test_importing.STRESS)
    both = uniaxial(test_importing.STRETCH, test_importing.STRESS, 2)
    pulled = uniaxial(test_fields.STRETCH, test_fields.STRESS)
    out = [
        Sample(name, make, {}, strained, f"{one}test_testing_machines")
        for name, make in (("Instron csv", test_importing.instron), ("Zwick txt", test_importing.zwick),
                           ("TRIOS txt", test_importing.trios), ("Excel xlsx", test_importing.excel))
    ]  # fmt: skip
    out += [
        Sample(name, make, {} if make is test_layouts.stacked_instron else {"specimen": SIZES}, both, several)
        for name, make in (("Bluehill, specimens below each other", test_layouts.stacked_instron),
                           ("testXpert, specimens side by side", test_layouts.beside_zwick),
                           ("Bluehill xlsx, a sheet each", test_layouts.sheets),
                           ("xls, a sheet each", test_layouts.old_excel), ("a column of specimens", test_layouts.column_of_specimens))
    ]  # fmt: skip
    out += [
        Sample(name, make, {}, flight(), f"{one}test_tracks")
        for name, make in (("Tracker txt", test_importing.tracker), ("t, x, y, z in ms and mm", test_importing.millimetres),
                           ("Unix times, unsorted", test_importing.epoch), ("OptiTrack csv", test_importing.optitrack),
                           ("Vicon csv", test_importing.vicon), ("TRC", test_importing.trc), ("C3D", test_importing.c3d))
    ]  # fmt: skip
    out += [
        Sample(name, language(kind), test_more_languages.TRACKERS[kind][1], flight(3, test_more_languages.T, test_more_languages.FLIGHT),
               "test_more_languages.py::test_trackers")
        for name, kind in (("Qualisys tsv", "Qualisys"), ("TrackMate csv", "TrackMate"), ("ROS csv", "ROS"))
    ]  # fmt: skip
    out.append(Sample("Kinovea csv", kinovea, test_kinovea.GIVEN, flight(2), "test_kinovea.py::test_a_table_of_one_or_two_trajectories"))
    ways = {"point": "ball", "scale": 0.01, "frame_rate": 30.0, "y_down": True}
    out.append(Sample("DeepLabCut h5", lambda f: test_pandas_hdf5.table(f / "a.h5"), ways, deeplabcut,
                      "test_pandas_hdf5.py::test_both_layouts_become_a_track"))  # fmt: skip
    out += [
        Sample(name, lambda f, write=write: test_fields.files(f, write), {"specimen": test_fields.SPECIMEN, "forces": "forces.csv"}, pulled,
               "fields/test_fields.py::test_a_pulled_strip_becomes_a_material_test")
        for name, write in (("VIC-2D csv", test_fields.vic2d), ("VIC-3D csv", test_fields.vic3d), ("ARAMIS csv", test_fields.aramis),
                            ("pyvale csv", test_fields.pyvale), ("DICe txt", test_fields.dice), ("Ncorr mat", test_fields.ncorr),
                            ("muDIC npy", test_fields.mudic))
    ]  # fmt: skip
    shaped = {"elements": "elements.csv", "forces": "reactions_*.csv", "specimen": Specimen(None, None, "2 mm", None, None)}
    out.append(Sample("nodes, elements, reactions csv", test_plane_folder.raw, test_plane_folder.OPTIONS | shaped, plane,
                      "fields/test_plane_folder.py::test_steps_of_a_finite_element_program"))  # fmt: skip
    return out


def row(sample: Sample) -> tuple[str, float]:
    """Import a sample and read it back; return the line of the table, and the largest relative difference."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        given = sample.make(folder)
        options = {key: str(folder / value) if key in ("forces", "elements") else value for key, value in sample.options.items()}
        neuido.import_file(given, folder / "out", **options)
        columns = sample.columns(folder / "out")
    apart = [
        float(np.abs(found - right).max() / np.abs(right).max()) if found.shape == right.shape else np.inf for _, found, right in columns
    ]
    names, shape = ", ".join(name for name, _, _ in columns), columns[0][1].shape
    return f"| {sample.layout} | {names} | {shape[0]} | {max(apart):.1g} | `{sample.test}` |", max(apart)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="write the page of results")
    given, lines, largest = parser.parse_args(), [], 0.0
    for sample in samples():
        line, apart = row(sample)
        lines.append(line)
        largest = max(largest, apart)
        print(line, flush=True)
    if given.write:
        title = ["| layout | columns checked | rows | apart | test (in `tests/data/importers`) |", "| --- | --- | --- | --- | --- |"]
        write_text(PAGE, HEAD + "\n".join([*title, *lines]) + "\n")
    return int(largest > 1e-3)


if __name__ == "__main__":
    sys.exit(main())
