"""The table of what laboratories measure names tests that exist, and cases that can be drawn."""

import re
from pathlib import Path

import numpy as np
import pytest

from neuido.data.undeclared import curves, guided_tracks, laboratory_tests
from neuido.data.undeclared.driven_bodies import DRIVEN
from neuido.physics.effects.library import LIBRARY
from neuido.physics.effects.point_library import POINT_ENTRIES
from tests.discrepancy.library_coverage import ENTRIES, page

TESTS = Path(__file__).parents[1]
FORMS = ("creep_test", "oscillation", "fluid_curves", "held_ramps", "periodic_cycles", "repeated_specimens")


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda entry: entry.what)
def test_each_entry_has_its_tests(entry):
    for test in (entry.closed, entry.gradient, *([entry.measured] if "::" in entry.measured else [])):
        file, _, name = test.partition("::")
        assert re.search(rf"^def {name}\(", (TESTS / file).read_text(), re.MULTILINE), test
    kinds = {
        "material_test": ("none", *curves.TEST_KINDS), "guided": tuple(guided_tracks.KINDS), "driven": DRIVEN,
        **dict.fromkeys(FORMS, ("none", *curves.TEST_KINDS)),
    }  # fmt: skip
    assert "::" in entry.measured or entry.kind in kinds[entry.measured]


def test_every_effect_of_a_specimen_or_a_guided_point_is_in_the_table():
    named = {entry.name for entry in ENTRIES}
    plane = {"volumetric", "geometric_nonlinearity"}  # of plane specimens, whose tests are their own
    assert {entry.name for entry in POINT_ENTRIES} - plane <= named
    assert named & {entry.name for entry in LIBRARY}


def test_the_page_is_that_of_the_script():
    own = TESTS.parent / "research" / "results" / "loop_library.md"
    assert own.read_text() == page(), "run python -m tests.discrepancy.library_coverage --out research/results/loop_library.md"


@pytest.mark.parametrize(
    ("form", "kind"),
    [("held_ramps", "none"), ("held_ramps", "fractional"), ("periodic_cycles", "viscosity_shear"), ("periodic_cycles", "hysteresis"),
     ("repeated_specimens", "second_invariant")],
)  # fmt: skip
def test_forms_of_laboratories_are_drawn_written_and_read(tmp_path, form, kind):
    write, truth = getattr(laboratory_tests, form)(np.random.default_rng(10), kind, 40.0, "made", lambda count: None)
    write(tmp_path)  # which reads it again
    assert [one["kind"] for one in truth["undeclared"]] == ([] if kind == "none" else [kind])
    assert kind == "none" or truth["tests"][0]["separation_over_noise"] > 15
