"""Attacks on the command line: the work is done or refused in one line, and nothing else is left."""

import time

import pytest

from tests.faults.attack import KINDS, attacks
from tests.faults.targets import TARGETS

QUICK = tuple(target for target in TARGETS if target.quick)
SECONDS = 600.0
"""Of the slow tier; the whole list takes some twenty minutes of a core."""


@pytest.fixture(scope="module")
def samples(tmp_path_factory):
    return {}, tmp_path_factory.mktemp("attacks")


@pytest.mark.parametrize("half", [0, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", [pytest.param(k, marks=pytest.mark.slow) if k == "signal" else k for k in dict.fromkeys(KINDS)])
def test_quick_commands(kind, half, samples):
    """One input for each command, every other command by turns; the rest, and signals, whose moment is the machine's, in the slow tier."""
    known, folder = samples
    place = KINDS.index(kind)
    numbers = range(place * len(QUICK) + (place + half) % 2, (place + 1) * len(QUICK), 2)
    found = list(attacks(numbers, folder, QUICK, known))
    assert len(found) == len(numbers) >= len(QUICK) // 2 and {each.kind for each in found} == {kind}
    assert not [each for each in found if each.fault]


@pytest.mark.slow
def test_all_commands(tmp_path):
    stop, tried, faults = time.monotonic() + SECONDS, 0, []
    for found in attacks(range(len(KINDS) * len(TARGETS), 1680), tmp_path):
        tried += 1
        faults += [found] if found.fault else []
        if time.monotonic() > stop:
            break
    assert tried and not faults
