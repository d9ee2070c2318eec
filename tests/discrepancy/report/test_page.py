"""The page of a diagnosis: whole, self-contained, escaped, and useful without matplotlib."""

import base64
import json
import re
import subprocess
import sys
from html.parser import HTMLParser
from shutil import which

import numpy as np
import pytest

from neuido.discrepancy.inference.attribution import diagnose
from neuido.discrepancy.report import answer, figures
from neuido.discrepancy.report import page as report
from neuido.discrepancy.report.residual import Series
from tests.discrepancy.report.test_answer import Curve

RNG = np.random.default_rng(0)


def motion(frames: int = 9, points: int = 600) -> dict:
    x = RNG.uniform(0, 1, (frames, points, 3))
    seen = x.copy()
    seen[4, 0] = np.nan
    return {
        "take <1>": {"positions": np.array(1), "t": np.linspace(0, 0.08, frames), "measured": seen, "before": x + 0.1, "after": x + 0.01}
    }


class Checker(HTMLParser):
    """Collects what a page would load from elsewhere, and whether its elements close."""

    def __init__(self) -> None:
        super().__init__()
        self.outside, self.open = [], []

    def handle_starttag(self, tag, attributes):
        for key, value in attributes:
            if key in ("src", "href", "data") and value and not value.startswith(("#", "data:")):
                self.outside.append((tag, value))
        if tag not in ("meta", "input", "br", "use", "path"):
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.handle_starttag(tag, attributes)
        if tag not in ("meta", "input", "br", "use", "path"):
            self.open.pop()

    def handle_endtag(self, tag):
        if tag in ("path", "use"):
            return
        assert self.open
        assert self.open.pop() == tag


@pytest.fixture(scope="module")
def found():
    return diagnose(Curve({"young": 1.5, "drag_linear.k": 0.8}), draws=39)


def test_page_is_whole_and_needs_nothing_else(found):
    details = answer.describe(found, device="cpu")
    page = report.page([details], [found], kind="experiment")
    checker = Checker()
    checker.feed(page)
    assert checker.outside == []
    assert checker.open == []
    for word in ("drag_linear", "gravity", "90 % interval", "linear model", "Next experiment", "<svg", "Floors"):
        assert word in page


def test_names_are_escaped(found):
    details = answer.describe(found, device="cpu")
    details.content["effects"][0]["where"] = "<script>alert(1)</script>"
    assert "<script>alert" not in report.page([details], [found], kind="experiment")


@pytest.mark.slow
def test_page_without_matplotlib_has_its_tables(tmp_path):
    code = f"""
import sys
sys.modules["matplotlib"] = None
from neuido.discrepancy.report import answer
from neuido.discrepancy.report import page as report
from neuido.discrepancy.inference.attribution import diagnose
from tests.discrepancy.report.test_answer import Curve
d = diagnose(Curve({{"young": 1.5, "drag_linear.k": 0.8}}), draws=19)
page = report.page([answer.describe(d, device="cpu")], [d], kind="experiment")
assert "<svg" not in page and "<table" in page and "drag_linear" in page
open({str(tmp_path / "page.html")!r}, "w").write(page)
"""
    answer_ = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert answer_.returncode == 0, answer_.stderr
    assert (tmp_path / "page.html").stat().st_size > 1000


def test_player_holds_the_motion():
    page = figures.player(motion())
    assert page.count("</script>") == 1  # a name with markup closes nothing
    data = json.loads(re.search(r"const data = (\{.*?\}), colours", page).group(1))
    own = data["take <1>"]
    assert (own["n"], own["k"]) == (figures.MOST_POINTS, 9)
    values = [np.frombuffer(base64.b64decode(s), "<i2").reshape(9, own["n"], 3).astype(float) for s in own["sets"]]
    x = motion()["take <1>"]
    assert (values[0] == -32768).any()
    shift = values[1] - values[2]  # both are the same motion, 0.09 apart
    low, high = 0.0, float(np.nanmax(x["before"]))
    assert np.median(shift) * (high - low) / 2 / 32000 == pytest.approx(0.09, rel=0.05)


def test_player_begins_where_the_motions_lie_furthest_apart():
    moved = motion()
    moved["take <1>"]["before"][6, :40] += 2.0
    moved["take <1>"]["before"][4, 0] += 9.0  # not seen there
    assert '"first": 6' in figures.player(moved)


def test_player_runs(tmp_path):
    node = which("node")
    if node is None:
        pytest.skip("node is not installed")
    script = re.search(r"<script>(.*)</script>", figures.player(motion()), re.S).group(1)
    stub = """
let drawn = 0; const pen = {clearRect() {}, fillRect() { drawn++; }};
const element = {getContext: () => pen, width: 10, height: 10, add(o) { this.value = o; }, value: 0, max: 0};
const box = {querySelector: () => element, querySelectorAll: () => [{checked: true}, {checked: true}, {checked: true}]};
globalThis.document = {currentScript: {previousElementSibling: box}}; globalThis.Option = function (n) { return n; };
const pick = {add(o) { this.value = o; }, value: ""}; const slider = {value: 0};
box.querySelector = q => q === "select" ? pick : q === "canvas" ? element : q.includes("range") ? slider : {};
"""
    # `new Option(name)` yields an object of the constructor's return only for objects: names are kept as they are
    stub = stub.replace("function (n) { return n; }", "class extends String {}").replace("this.value = o;", "this.value = String(o);")
    (tmp_path / "p.js").write_text(stub + script + "\nif (drawn < 1100) throw new Error('drew ' + drawn);")
    answer_ = subprocess.run([node, str(tmp_path / "p.js")], capture_output=True, text=True)
    assert answer_.returncode == 0, answer_.stderr


def test_figures_are_drawn():
    m = motion()
    series = [Series(n, "m", np.arange(3.0), np.ones(3), np.ones(3), 0.1 * np.ones(3), 3) for n in ("flight", "power")]
    for page in (
        figures.error_curves(m, 1e-3, 1e-3),
        figures.residual_maps(m),
        figures.stage_curves({"take <1>": series}),
        figures.ranking([("a", 1.0, True), ("b", 0.1, False)], 0.3),
    ):
        assert page.startswith("<svg")
        assert "</svg>" in page
    assert figures.stage_curves({}) == ""
    assert figures.ranking([], 0.0) == ""


@pytest.mark.parametrize(
    ("low", "high", "ticks"),
    [
        (0.4, 4.5, [0.5, 1, 2]),
        (0.9, 1.24, [0.9, 0.95, 1, 1.05, 1.1, 1.15, 1.2]),
        (0.09, 210, [0.1, 0.5, 2, 10, 50, 200]),
        (1.1, 2.45, [1.2, 1.4, 1.6, 1.8, 2.0, 2.2, 2.4]),
    ],
)
def test_ticks_are_round_and_few(low, high, ticks):
    np.testing.assert_allclose(figures.log_ticks(low, high), ticks)
    for width in np.geomspace(1.01, 1e9, 200):
        own = figures.log_ticks(1e-3, 1e-3 * width)
        assert 2 <= len(own) <= figures.MOST_TICKS and np.all(np.diff(own) > 0)


def test_a_recording_that_cannot_be_predicted_has_no_figure():
    """Infinite errors are null in diagnosis.json; the report says so and is written all the same."""
    errors = {"fit": 0.002, "held_out": None, "by_recording": {"first": 0.002, "second": None}}
    alone = {"fit": 0.003, "held_out": None}
    content = {
        "error": {"unit": "m", "noise_floor": 1e-3, "discretisation_floor": 2e-3, "before": errors, "after": errors,
                  "amounts": {"before": {}, "after": {}}, "one_setting": {"before": alone, "after": alone}},
        "effects": [{"name": "yield", "p_value": 0.01, "where": "",
                     "parameters": {"inverse": {"value": 1.0, "unit": "1/Pa", "interval90": [0.5, None]}}}],
        "declared": {"young": {"value": 1e5, "unit": "Pa", "interval90": [None, None]}},
        "after": {"young": {"value": 1e5, "unit": "Pa", "interval90": [9e4, 1.1e5]}},
    }  # fmt: skip
    text = report._errors(content) + report._effects(content) + report._figures(content)
    assert "<td>second</td><td></td><td></td><td></td>" in text
    assert "0.5 to infinite" in text and "infinite to infinite" in text and "9e+04 to 1.1e+05" in text


def test_other_settings_are_named():
    e = {
        "unit": "m",
        "amounts": {"before": {"half <1>": 0.1}, "after": {"half <1>": -0.75}},
        "one_setting": {"before": {"fit": 0.3, "held_out": 0.4}, "after": {"fit": 0.03, "held_out": 0.0625}},
    }
    text = report._settings(e)
    assert "half &lt;1&gt;" in text and "-0.75" in text
    assert "leaves 0.4 m before and 0.0625 m after" in text
    assert report._settings({"unit": "m"}) == ""
