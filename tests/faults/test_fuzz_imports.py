"""Damaged files for the readers of exports of machines and trackers: a result, or one line that names the file."""

import pytest

from tests.faults.fuzzing import fuzz, summary
from tests.faults.readers import GROUPS


@pytest.mark.parametrize("reader", GROUPS["imports"], ids=lambda reader: reader.name)
def test_damaged_files(tmp_path, reader):
    faults, tried, _ = fuzz(reader, tmp_path, range(reader.quick))
    assert tried == reader.quick and not faults, summary(faults)


def test_damaged_matlab_files_that_end_a_process_in_scipy(tmp_path):
    (reader,) = (reader for reader in GROUPS["imports"] if reader.name == "import-ncorr")
    faults, tried, _ = fuzz(reader, tmp_path, (210, 566, 654))  # sizes that lie, and repeated parts: segmentation faults of SciPy 1.17
    assert tried == 3 and not faults, summary(faults)
