"""Damaged files for the readers of measured data and scenes: a result, or one line that names the file."""

import pytest

from tests.faults.fuzzing import fuzz, summary
from tests.faults.readers import GROUPS


@pytest.mark.parametrize("reader", GROUPS["measured"], ids=lambda reader: reader.name)
def test_damaged_files(tmp_path, reader):
    faults, tried, _ = fuzz(reader, tmp_path, range(reader.quick))
    assert tried == reader.quick and not faults, summary(faults)
