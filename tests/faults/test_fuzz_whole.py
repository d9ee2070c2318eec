"""The readers with many more damaged files than the fast tier: up to `Reader.count` each, as many as a quarter of a minute allows."""

import os
import time

import pytest

from tests.faults.fuzzing import fuzz, summary
from tests.faults.readers import READERS

SECONDS = float(os.environ.get("NEUIDO_FUZZ_SECONDS", "14"))
"""For one reader: all of them take some six minutes of two processes. With NEUIDO_FUZZ_SECONDS=3000 each has its 10,000 inputs."""


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_many_damaged_files(tmp_path, name):
    reader = READERS[name]
    faults, tried, _ = fuzz(reader, tmp_path, range(reader.quick, reader.count), stop=time.monotonic() + SECONDS)
    assert tried and not faults, summary(faults)
