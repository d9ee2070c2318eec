"""The page of a diagnosis: whole, self-contained, escaped, small, and useful without JavaScript."""

import base64
import json
import re
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest

from neuido.discrepancy.report import motion_player, page, plots, silhouette_pictures
from neuido.discrepancy.report.reader_units import Units
from neuido.discrepancy.report.wording import words_of
from tests.discrepancy.report.report_content import HOSTILE, content, motion, stress_curve

VOID = ("meta", "input", "br", "img", "link", "hr")


class Reader(HTMLParser):
    """Collects what a page would load from elsewhere, whether its elements close, and its text outside scripts."""

    def __init__(self) -> None:
        super().__init__()
        self.outside, self.open, self.text, self.scripts = [], [], "", 0

    def handle_starttag(self, tag, attributes):
        for key, value in attributes:
            assert not key.startswith("on"), (tag, key)
            if key in ("src", "href", "data") and value and not value.startswith(("#", "data:")):
                self.outside.append((tag, value))
        self.scripts += tag == "script"
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if "script" not in self.open and "style" not in self.open:
            self.text += " " + data


def read(text: str) -> Reader:
    reader = Reader()
    reader.feed(text)
    assert reader.open == [] and reader.outside == []
    return reader


def figures(text: str) -> list:
    return json.loads(re.search(r'<script type="application/json" id="figures">(.*?)</script>', text, re.S).group(1))


@pytest.mark.parametrize(
    ("kind", "name", "title"),
    [("experiment", "thrown block", "the experiment thrown block"), ("experiment", "experiment", "the experiment"), ("", "balls", "balls")],
)
def test_the_title_says_kind_and_name_once(kind, name, title):
    assert f"<h1>Diagnosis of {title}</h1>" in page.page([content()], [motion()], kind=kind, name=name)


def test_the_page_opens_with_the_answer_and_needs_nothing_else():
    text = page.page([content()], [motion()], kind="experiment", name="thrown block")
    reader = read(text)
    assert reader.scripts == 3 and len(text.encode()) < page.LIMIT
    said = re.sub(r"\s+", " ", reader.text)
    first = said.index("The model lacks linear air drag: k = 3.00 per second (90 %: 2.98–3.02).")
    assert first < said.index("How sure") < said.index("What could not be excluded") < said.index("Motion before and after")
    for word in (
        "drag_linear",
        "quadratic air drag",
        "leaves 6 times the error of linear air drag",
        "validation",
        "throw (fit)",
        "Young's modulus",
    ):
        assert word in said, word
    assert [f["form"] for f in figures(text)] == ["player", "plot", "plot", "map", "plot", "plot"]


def test_every_plot_has_labels_a_title_and_a_legend():
    c, arrays = stress_curve()
    made = [f for f in figures(page.page([content()], [motion()])) if f["form"] == "plot"]
    made += figures(page.page([c], [arrays]))
    assert len(made) == 6
    for one in made:
        layout = one["layout"]
        assert layout["title"]["text"] and layout["xaxis"]["title"]["text"] and layout["yaxis"]["title"]["text"] and layout["showlegend"]
        assert all(trace["name"] for trace in one["data"])


def test_a_material_test_is_drawn_over_its_stretch_in_one_unit():
    c, arrays = stress_curve()
    text = page.page([c], [arrays], kind="material test")
    stress, left = figures(text)
    assert (stress["layout"]["xaxis"]["title"]["text"], stress["layout"]["yaxis"]["title"]["text"]) == ("stretch", "nominal stress [kPa]")
    assert stress["data"][0]["x"] == pytest.approx(np.linspace(1, 6, 12), rel=1e-4)
    assert stress["data"][0]["y"][0] == pytest.approx(400.0)
    assert left["layout"]["yaxis"]["title"]["text"] == "measured − predicted [kPa]"
    said = read(text).text
    assert "[kPa]" in said and "MPa" not in said and " Pa" not in said


def test_points_without_a_path_are_no_line():
    c, arrays = stress_curve()
    own = arrays["uniaxial"]
    order = np.random.default_rng(0).permutation(12)
    shuffled = {key: value[order] for key, value in own.items()}
    made = plots.data_plots("uniaxial", shuffled, c, Units.of([c]))
    assert {trace["mode"] for trace in made[0]["data"]} == {"markers"}
    assert {trace["mode"] for trace in plots.data_plots("uniaxial", own, c, Units.of([c]))[0]["data"]} == {"markers", "lines"}


def test_several_bodies_have_a_table_first():
    none = content(answer="none", effects=[], body="stone", models=[])
    text = page.page([content(body="feather"), none], [motion(), motion()], kind="track", name="two bodies")
    said = re.sub(r"\s+", " ", read(text).text)
    assert said.index("All bodies") < said.index("feather") < said.index("an effect is missing") < said.index("The model lacks")
    assert "linear air drag: k = 3.00 1/s (2.98–3.02)" in said and "39.8 mm" in said
    assert text.count("<details") == 2 and text.count("<details open>") == 1


def test_silhouettes_are_outlined_over_their_masks():
    y, x = np.mgrid[:24, :32]
    disc = (255 * ((x - 16) ** 2 + (y - 12) ** 2 < 50)).astype(np.uint8)
    masks = np.broadcast_to(disc, (3, 2, 24, 32)).copy()
    scores = {"held_out": {"iou": 0.9, "outline_px": 0.4, "outline_mm": 1.2, "psnr": 20.0}}
    shown = {"drop": {"role": "held_out", "inset": 0.0, "frame_times": [0.0, 0.1, 0.2]}}
    c = content(recordings=shown, silhouettes={"drop": {"before": scores, "after": scores}}, stages={}, models=[])
    arrays = {"masks": masks, "drawn_before": np.roll(masks, 3, axis=3), "drawn_after": masks}
    text = page.page([c], [{"drop": arrays}])
    said = read(text).text
    assert text.count("data:image/png;base64,") == 1 and "drop at 0, 0.1, 0.2 s" in said and "overlap (IoU)" in said
    ((_, url),) = silhouette_pictures.pictures({"drop": arrays}, c)
    picture = cv2.imdecode(np.frombuffer(base64.b64decode(url.partition(",")[2]), np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape == (2 * 2 * 24, 3 * 2 * 32, 3)
    assert (picture == silhouette_pictures.BEFORE[::-1]).all(axis=2).any() and (picture == silhouette_pictures.AFTER[::-1]).all(
        axis=2
    ).any()


def test_names_do_nothing():
    c, arrays = stress_curve(HOSTILE)
    effect = {
        "name": HOSTILE,
        "class": [HOSTILE],
        "where": HOSTILE,
        "parameters": {HOSTILE: {"value": 1.0, "unit": "1", "interval90": [0.9, 1.1]}},
    }
    c["effects"] = [c["effects"][0] | effect]
    c["error"]["noise_from"] = {}
    c |= {"body": HOSTILE, "why": [HOSTILE], "device": HOSTILE, "left_out": [HOSTILE], "settings_not_run": {HOSTILE: [HOSTILE]}}
    c["models"] = [{"step": 1, "name": HOSTILE, "error_ratio": 2.0, "verdict": "named", "reason": HOSTILE, "parameters": {}}]
    c["recordings"][HOSTILE]["axis"] = {"label": HOSTILE, "unit": "1"}
    text = page.page([c], [arrays], kind=HOSTILE, name=HOSTILE)
    reader = read(text)
    assert reader.scripts == 3  # the figures, Plotly, the page's own
    outside = text.replace(str(page.plotly_script()), "")
    assert "<img" not in outside and "window.hit = 1</" not in outside
    for one in figures(text):
        for trace in one["data"]:
            assert "<" not in trace["name"]
        for label in (one["layout"]["title"], one["layout"]["xaxis"]["title"], one["layout"]["yaxis"]["title"]):
            assert "<" not in label["text"]


def test_a_recording_that_cannot_be_predicted_has_no_figure():
    c = content()
    for when in ("before", "after"):
        c["error"][when]["by_recording"]["throw"] = None
    c["effects"][0]["parameters"]["k"]["interval90"] = [2.5, None]
    text = page.page([c], [{}])
    said = read(text).text
    assert "2.50 to infinite" in said and "nan" not in said.lower().replace("dynamic", "")
    assert re.search(r"<td[^>]*>throw \(fit\)</td>\s*(<td[^>]*></td>\s*){3}</tr>", text), "errors that there are not are empty cells"


def test_other_settings_are_named():
    c = content()
    c["error"] |= {
        "amounts": {"before": {"half <1>": 0.1}, "after": {"half <1>": -0.75}},
        "one_setting": {
            when: c["error"][when] | {"fit": fit, "held_out": held_out}
            for when, fit, held_out in (("before", 0.3, 0.4), ("after", 0.03, 0.0625))
        },
    }
    text = page.page([c], [{}])
    assert "half &lt;1&gt;: 0.10 before, −0.75 after" in text
    assert "One simulation without them leaves 400 mm before and 62.5 mm after." in text
    del c["error"]["amounts"], c["error"]["one_setting"]
    assert "One simulation without them" not in page.page([c], [{}])


def test_what_was_rejected_has_a_table_of_its_own():
    c = content(models=[], rejected=[{"name": "gravity", "reason": "leaves 9 times the error of drag_linear"}])
    text = page.page([c], [{}])
    assert ">Rejected</h3>" in text and "leaves 9 times the error of linear air drag" in text
    assert ">Rejected</h3>" not in page.page([c | {"rejected": []}], [{}])


def test_a_page_without_plots_holds_no_plotting_library():
    text = page.page([content(models=[], stages={})], [{}])
    assert len(text) < 60_000 and read(text).scripts == 1


def test_many_recordings_still_fit_the_page():
    rng = np.random.default_rng(0)
    own = {"positions": np.array(1), "t": np.linspace(0, 1, 300)}
    arrays = own | {key: rng.uniform(0, 1, (300, 500, 3)) for key in ("measured", "before", "after")}
    many = {f"take {i}": arrays for i in range(12)}
    c = content(recordings={})
    for when in ("before", "after"):
        c["error"][when]["by_recording"] = dict.fromkeys(many, 0.1)
    assert len(page.page([c], [many]).encode()) <= page.LIMIT


def test_player_holds_the_motion():
    c, m = content(), motion()
    made = motion_player.player(m, c, Units(lengths=[7e-4, 0.7]))
    assert made["unit"] == "mm"
    own = made["recordings"][0]
    sets = [np.frombuffer(base64.b64decode(s), "<i2").reshape(own["frames"], own["points"], 3) for s in own["sets"]]
    for key, packed in zip(motion_player.SETS, sets, strict=True):
        np.testing.assert_allclose(np.array(own["middle"]) + own["scale"] * packed, 1e3 * m["throw"][key], atol=0.1)
    assert own["down"] == [0.0, -1.0, 0.0] and own["name"] == "throw (fit)"


def test_player_holds_so_many_points_and_frames_and_no_more():
    x = np.random.default_rng(0).uniform(0, 1, (90, 600, 3))
    arrays = {"positions": np.array(1), "t": np.linspace(0, 0.89, 90), "measured": x, "before": x + 0.1, "after": x + 0.01}
    (own,) = motion_player.player({"throw": arrays}, content(), Units())["recordings"]
    assert (own["points"], own["frames"]) == (motion_player.MOST_POINTS, motion_player.MOST_FRAMES) == (400, 60)


def test_player_draws_a_floor_that_is_near_and_hides_what_was_not_seen():
    c, m = content(), motion()
    m["throw"]["measured"][1, 0] = np.nan
    own = motion_player.player(m, c, Units())["recordings"][0]
    packed = np.frombuffer(base64.b64decode(own["sets"][0]), "<i2").reshape(own["frames"], own["points"], 3)
    assert (packed[1, 0] == motion_player.HIDDEN).all() and (packed[0] != motion_player.HIDDEN).all()
    c["recordings"]["throw"]["colliders"][0]["point"] = [0.0, float(m["throw"]["measured"][0, :, 1].min()) - 0.05, 0.0]
    (plane,) = motion_player.player(m, c, Units())["recordings"][0]["planes"]
    assert len(plane["corners"]) == 4 and len({corner[1] for corner in plane["corners"]}) == 1
    c["recordings"]["throw"]["colliders"][0]["point"] = [0.0, -50.0, 0.0]
    assert motion_player.player(m, c, Units())["recordings"][0]["planes"] == []


def test_player_begins_where_the_motions_lie_furthest_apart():
    x = np.zeros((9, 40, 3))
    moved = x.copy()
    moved[6] += 2.0
    assert motion_player.most_telling(x, moved) == 6
    x[6] = np.nan
    moved[4] += 1.0
    assert motion_player.most_telling(x, moved) == 4


def test_a_far_flight_stands_in_metres_everywhere():
    c = content(error=content()["error"], reach=47.6)
    assert words_of(c).error.startswith("Held-out error 0.0398 m before")
    arrays = {"times": np.linspace(0, 3, 9), "groups": np.zeros(9, int), **{key: np.linspace(47.6, 12, 9) for key in motion_player.SETS}}
    c.pop("reach")
    text = page.page([c], [{"throw": arrays}])
    assert "Held-out error 0.0398 m before" in text and "mm" not in read(text).text
    assert figures(text)[0]["layout"]["yaxis"]["title"]["text"] == "measured [m]" and figures(text)[0]["data"][0]["y"][0] == 47.6


def test_without_an_effect_there_is_one_prediction():
    c = content(answer="none", effects=[], models=[])
    made = figures(page.page([c], [motion()]))
    assert made[0]["called"] == ["measured", "predicted"] and len(made[0]["recordings"][0]["sets"]) == 2 and made[3]["shown"] == ["before"]
    assert [trace["name"] for trace in made[1]["data"]] == ["predicted", "noise", "noise and discretisation"]


def test_a_ranking_shows_the_named_effect_apart_from_its_rivals():
    made = plots.ranking(content()["models"], 1.1)
    assert [trace["name"] for trace in made["data"]] == ["named, or not told from it", "other effects", "95 % of what chance brings"]
    assert made["data"][0]["x"] == [27.0] and made["layout"]["xaxis"]["type"] == "log"
    assert plots.ranking([], None) is None
