"""What does not change the motion changes no answer: real flights with another clock, unit, axis, order, sampling or with a repeat."""

import pytest

from tests.discrepancy.real_rows import DRAG, FEWER, answered, problem_of, ways_of, written

KNOWN = {
    "bowling-ball": set(),
    "golf-ball": set(),
    "whiffle-ball-1": {"drag_linear", "drag_quadratic"},
    "volleyball": {"drag_linear", "drag_quadratic"},
}
"""What a ball may lack: drag that a heavy and small one does not show."""


def answer_of(folder, body):
    """The answer and all effects of its classes; the drag that such a ball has is not excluded where no drag is named."""
    problem = problem_of(folder, body)
    answer, names, found = answered(problem, DRAG, most=1)
    ordinary = problem.labels["ordinary"].get("drag_quadratic.k", 0.0)
    assert names or all(one.up_to is None or one.up_to > ordinary for one in found.power if one.name == "drag_quadratic")
    return answer, names


@pytest.mark.slow
@pytest.mark.parametrize("body", KNOWN)
def test_no_answer_changes(data_root, tmp_path, body):
    answer, names = answer_of(written(data_root, tmp_path / "plain", body), body)
    assert names <= KNOWN[body] and bool(names) == bool(KNOWN[body])
    for name, options in ways_of(body).items():
        again, same = answer_of(written(data_root, tmp_path / name, body, **options), body)
        if name in FEWER:
            assert bool(same) == bool(names) and same <= KNOWN[body], name
        else:
            assert (again, same) == (answer, names), name
