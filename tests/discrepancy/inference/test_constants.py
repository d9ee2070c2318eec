"""Every constant that a decision depends on is listed, explained and counted."""

import importlib.util
from pathlib import Path

import pytest

FILE = Path(__file__).parents[3] / "docs" / "_ext" / "decision_constants.py"
if not FILE.is_file():
    pytest.skip("the documentation does not come with the installed package", allow_module_level=True)
spec = importlib.util.spec_from_file_location("decision_constants", FILE)
listed = importlib.util.module_from_spec(spec)
spec.loader.exec_module(listed)


@pytest.mark.parametrize("module", sorted({*listed.DECIDES, *listed.SHADOW, *listed.SEARCHES, "decision"}))
def test_each_constant_is_said_to_decide_or_not(module):
    deciding = {**listed.DECIDES.get(module, {}), **listed.SHADOW.get(module, {})}
    there = listed.constants(module)
    assert set(there) == {*deciding, *listed.SEARCHES.get(module, ())}
    assert all(there[name][1] for name in deciding)


def test_unnamed_figures_stand_where_they_are_said_to():
    for module, function, *_ in listed.UNNAMED:
        assert f"def {function}(" in listed.file_of(module).read_text()


def test_no_figure_is_added():
    present, shadow = listed.counts()
    assert present <= 25 and shadow <= 2
    page = listed.constant_page()
    assert f"**{present} figures" in page and "| `judging.GAIN_IN_FLOOR` | `math.log(4.0)` | nulls |" in page
