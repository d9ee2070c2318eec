"""Raw files of measured data give the prepared tables beside them, to the digits of these."""

import os
from pathlib import Path

import numpy as np
import pytest

from neuido.data.importers.importing import import_file
from neuido.data.importers.machines.loading_path import Preparation

DATA = os.environ.get("NEUIDO_DATA")
pytestmark = pytest.mark.skipif(DATA is None, reason="NEUIDO_DATA is not set")


def measured() -> Path:
    return Path(DATA) / "measured"


def table(file: Path) -> np.ndarray:
    return np.loadtxt(file, delimiter=",", skiprows=1)


def imported(tmp_path, files, **options) -> dict[str, np.ndarray]:
    import_file(files, tmp_path / "out", **options)
    return {file.stem: table(file) for file in (tmp_path / "out").glob("*.csv")}


def test_a_relaxation_modulus(tmp_path):
    files = [measured() / "fish-relax" / "raw" / "fish.csv"]
    (rows,) = imported(tmp_path, files, step="0.01", preparation=Preparation(rows="::4")).values()
    time, shear, stress = table(measured() / "fish-relax" / "fish.csv").T
    np.testing.assert_allclose(rows, np.stack([shear, stress, time], 1), rtol=5e-4, atol=1e-9)


def test_an_oscillation_without_titles(tmp_path):
    files = [measured() / "laos" / "raw" / "laos0010.txt"]
    columns = {"time": "column 1", "shear": "column 2", "shear_stress": "column 4"}
    units = {"time": "s", "shear": "%", "shear_stress": "Pa"}
    (rows,) = imported(tmp_path, files, mode="simple_shear", columns=columns, units=units, preparation=Preparation(rows="::8")).values()
    time, shear, stress = table(measured() / "laos" / "a10.csv").T
    np.testing.assert_allclose(rows, np.stack([shear, stress, time], 1), rtol=1e-5, atol=1e-8)


def test_compressions_by_an_instron(tmp_path):
    folder = measured() / "silicone-EF30_25T"
    found = imported(tmp_path, sorted((folder / "raw").glob("*.csv")), mode="compression", preparation=Preparation(rows="5::12"))
    for name in ("A1", "A2", "B1"):
        time, _, _, strain, stress, *_ = table(folder / f"{name}.csv").T
        rows = found[f"EF30_25T_{name}"]
        np.testing.assert_allclose(rows, np.stack([1 + strain, 1e3 * stress, time - time[0]], 1), rtol=1e-9, atol=1e-9)


def test_cycles_of_steel_in_blocks(tmp_path):
    files = list((measured() / "steel-s2" / "raw").glob("*.csv"))
    (rows,) = imported(tmp_path, files, units={"nominal_stress": "MPa"}, preparation=Preparation(average=20)).values()
    prepared = table(measured() / "steel-s2" / "cycles.csv")
    rows, (time, percent, stress) = rows[1:], prepared[: len(rows) - 1].T  # the prepared table leaves the first block out
    np.testing.assert_allclose(rows[:, :2], np.stack([1 + percent / 100, 1e6 * stress], 1), rtol=1e-6)
    np.testing.assert_allclose(rows[:, 2] - rows[0, 2], time, atol=0.006)
