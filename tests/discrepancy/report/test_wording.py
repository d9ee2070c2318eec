"""The answer in plain words, and the units in which a person reads it."""

import pytest

from neuido.discrepancy.report.reader_units import Units, fixed, rounded
from neuido.discrepancy.report.wording import listed, parameter_words, title, titles, worded, words_of
from neuido.physics.effects.library import LIBRARY
from tests.discrepancy.report.report_content import content, stress_curve

QUADRATIC = {"name": "drag_quadratic", "parameters": {"k": {"value": 0.5, "unit": "1/m"}}, "error_ratio": 3.2}


def test_an_effect_opens_with_its_name_size_and_interval():
    words = words_of(content())
    assert words.finding == "The model lacks linear air drag: k = 3.00 per second (90 %: 2.98–3.02)."
    assert words.error == "Held-out error 39.8 mm before, 0.698 mm after; noise 0.693 mm, discretisation 0.361 mm."
    assert "p = 0.01" in words.sure and "the nearest rival, quadratic air drag, leaves 6.0 times the error" in words.sure
    assert words.not_excluded.startswith("Not excluded: a different gravity (acceleration up to 2.52 m/s²; g)")
    assert words.paragraphs == (words.finding, words.error, words.sure, words.not_excluded)


def test_every_parameter_of_the_library_has_words():
    words = {f"{entry.name}.{p.name}": parameter_words(entry.name, p.name) for entry in LIBRARY for p in entry.parameters}
    assert not [key for key, said in words.items() if said == key.partition(".")[2].replace("_", " ") and len(said) < 4]
    assert words["time_force.y4"] == "acceleration along y at the fifth knot" and words["magnus.x"] == "rate about x"
    assert parameter_words("own", "spring_rate") == "spring rate"


def test_two_effects_and_a_class():
    first = content()["effects"][0]
    second = first | {"name": "yield", "class": ["yield", "friction"], "step": 2}
    finding = words_of(content(effects=[first, second], answer="class")).finding
    assert finding.startswith("The model lacks two effects: linear air drag, k = 3.00 per second")
    assert "; and yielding or a different friction, k =" in finding and "cannot" not in finding.split(".")[0]
    alone = words_of(content(answer="class", effects=[first | {"class": ["drag_linear", "drag_quadratic"]}])).finding
    assert alone.startswith(
        "The model lacks linear air drag or quadratic air drag; these data cannot tell them apart. As linear air drag: k"
    )


def test_none_says_what_could_have_been_seen_and_where_the_residual_stands():
    c = content(answer="none", effects=[], models=[])
    assert words_of(c).finding == "Nothing is missing that these data could show."
    assert words_of(c).error.startswith("Held-out error 0.698 mm; noise")
    c["error"]["left_over_noise"] = 4.0
    assert "4.0 times the noise" in words_of(c).finding


def test_none_says_whether_it_excludes_what_such_a_body_has():
    row = {"name": "drag_quadratic", "parameter": "k", "unit": "1/m", "largest": 0.05, "ordinary": 0.008}
    asked = [(0.02, "cannot tell from none"), (None, "set no limit to it"), (0.001, "check the length scale, the clock and gravity")]
    for up_to, said in asked:
        c = content(answer="none", effects=[], models=[], power=[row | {"up_to": up_to}])
        assert said in words_of(c).finding and "quadratic air drag of about 0.00800 per metre" in words_of(c).finding


def test_unfinished_names_a_lead_and_what_was_not_tried():
    c = content(
        answer="unfinished",
        effects=[],
        leads=[QUADRATIC],
        untried=["magnus"],
        left_out=["the intervals", "a second effect beside drag_quadratic"],
    )
    words = words_of(c)
    assert words.finding.startswith(
        "The search was cut off before every effect was tried: nothing is named yet. In the lead so far, and no answer: "
    )
    assert (
        "quadratic air drag (k = 0.500 per metre), which divides the error by 3.2" in words.finding
        and "Not tried: a Magnus force." in words.finding
    )
    assert "more minutes" in words.notes and "beside quadratic air drag" in words.notes


def test_insufficient_says_why_first_and_what_would_help():
    c = content(answer="insufficient", effects=[], why=["young would be 100 Pa"], would_help=["a finer grid", "more views"])
    words = words_of(c)
    assert words.finding == "Young would be 100 Pa. These data do not say whether something is missing."
    assert words.next == "What would help: a finer grid or more views."


def test_next_experiment_is_told_with_its_odds():
    proposal = {
        "change": "launch it at twice the speed",
        "tells_apart": ["drag_linear", "drag_quadratic"],
        "expected_log_odds": 3.0,
        "others": [],
    }
    assert words_of(content(next_experiment=None)).next == ""
    said = words_of(content(next_experiment=proposal)).next
    assert (
        said
        == "Measure next: launch it at twice the speed. It tells linear air drag from quadratic air drag, with expected odds of 20 to 1."
    )


def test_an_effect_that_leaves_more_says_so():
    c = content()
    c["error"]["left_over_floor"] = 12.0
    first, *_ = words_of(c).finding.split(". ")
    assert first.endswith(", and something more that no effect here explains") and "12 times" in words_of(c).finding
    c["error"] |= {"left_over_floor": 2.0, "worst_over_floor": 6.0}
    assert "no effect here explains" in words_of(c).finding and "6 times" in words_of(c).finding
    c["effects"][0]["at_limit"] = "drag_linear.k ends at 5 1/s, the edge of its physical range"
    assert "a limit and no size" in words_of(c).finding.lower()


def test_stresses_stand_in_one_unit():
    words = words_of(stress_curve()[0])
    assert words.error == "Error of the fit 300 kPa before, 20.0 kPa after; noise 10.0 kPa (estimated)."
    assert "strain stiffening: k = 0.0129 (90 %: 0.0126–0.0132)" in words.finding


def test_every_effect_of_the_library_has_words():
    assert set(titles()) == {entry.name for entry in LIBRARY}
    assert title("of_my_own") == "of my own"
    assert worded("leaves 2 times the error of drag_linear, my_own") == "leaves 2 times the error of linear air drag, my_own"
    assert worded("drag_linear.k ends at 5 1/s, the edge") == "drag_linear.k ends at 5 1/s, the edge"
    assert listed([]) == "" and listed(["a"]) == "a" and listed(["a", "b", "c"], "or") == "a, b or c"


@pytest.mark.parametrize(
    ("value", "interval", "unit", "shown"),
    [
        (3.0012, (2.979, 3.023), "1/s", ("3.00", "2.98–3.02")),
        (60241.0, (59463.0, 61029.0), "Pa", ("60.2", "59.5–61.0")),
        (0.2, (-20.0, 20.0), "1", ("0", "−20 to 20")),
        (2e-4, (1.6e-4, 2.5e-4), "1/Pa", ("0.20", "0.16–0.25")),
        (1.0, (1.0, 1.0), "1", ("1.00", "")),
        (1.0, (None, 2.0), "1", ("1.00", "infinite to 2.00")),
        (1.0, (None, None), "1", ("1.00", "infinite to infinite")),
    ],
)
def test_figures_have_as_many_digits_as_their_intervals_bear(value, interval, unit, shown):
    assert Units(pressures=[800.0, 6e4]).figures(value, interval, unit) == shown


def test_units_of_a_page():
    assert Units(lengths=[4e-2, 7e-4, 0.7]).length[1] == "mm"
    assert Units(lengths=[0.3, 500.0]).length[1] == "m"
    assert Units(lengths=[2e-6, 5e-6]).length[1] == "µm"
    assert Units(pressures=[3e5, 2e4, 1e6]).pressure[1] == "kPa"
    assert Units(pressures=[2e11, 3e8, 5e6]).pressure[1] == "MPa"
    assert Units().label("1") == "–" and Units().label("m/s^2") == "m/s²"
    assert rounded(0.0) == "0" and rounded(39.78) == "39.8" and rounded(-0.05) == "−0.0500" and fixed(1234.0, -2) == "1200"
    assert fixed(3.3e7, -6) == "3.3e7"
