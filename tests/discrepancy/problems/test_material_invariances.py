"""What does not change the tests changes no answer: real material tests with another clock, unit, axis, order, sampling or a repeat."""

import pytest

from tests.discrepancy.real_rows import FEWER, ROWS, answered, problem_of, ways_of, written


def answer_of(folder, row):
    """The answer, and all effects of its classes; of a row with three effects two may be named."""
    return answered(problem_of(folder, row), ROWS[row], most=ROWS[row].count(","))[:2]


@pytest.mark.slow
@pytest.mark.parametrize("row", ROWS)
def test_no_answer_changes(data_root, tmp_path, row):
    effects = ROWS[row]
    answer, names = answer_of(written(data_root, tmp_path / "plain", row), row)
    assert answer in ("effect", "class") and effects.partition(",")[0] in names
    for name, options in ways_of(row).items():
        again, same = answer_of(written(data_root, tmp_path / name, row, **options), row)
        if name in FEWER:
            assert again in ("effect", "class") and effects.partition(",")[0] in same, name
        else:
            assert (again, same) == (answer, names), name
