"""Damaged files for the readers of weights, results and sweeps: a result, or one line that names the file."""

import pytest

from tests.faults.fuzzing import fuzz, summary
from tests.faults.readers import GROUPS


@pytest.mark.parametrize("reader", GROUPS["results"], ids=lambda reader: reader.name)
def test_damaged_files(tmp_path, reader):
    faults, tried, _ = fuzz(reader, tmp_path, range(reader.quick))
    assert tried == reader.quick and not faults, summary(faults)


FOUND = {
    "nclaw": (184, 519),
    "sweep": (498,),
    "runs": (163,),
    "clips": (326,),
    "trajectories": (615,),
    "checkpoint": (477,),
    "setting": (911,),
    "diagnosis": (904,),
}
"""Inputs that once ended in a traceback or took the memory."""


@pytest.mark.parametrize("name", FOUND)
def test_damaged_files_that_were_faults(tmp_path, name):
    (reader,) = (reader for reader in GROUPS["results"] if reader.name == name)
    faults, tried, _ = fuzz(reader, tmp_path, FOUND[name])
    assert tried == len(FOUND[name]) and not faults, summary(faults)
