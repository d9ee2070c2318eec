"""Diagnosis from Python: the command's answer, on a folder and on data that are read already, and what can be asked of it."""

import json
import re
import shutil
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
import yaml
from matplotlib.backends.backend_agg import FigureCanvasAgg

from neuido.data.measured.material_test import read_material_tests
from neuido.data.measured.track import read_tracks
from neuido.discrepancy.report.diagnosis import Diagnosis
from neuido.discrepancy.report.wording import title
from neuido.discrepancy.workflow import diagnose
from neuido.errors import UserError
from tests import command
from tests.discrepancy import made

DRAGS = "drag_linear,drag_quadratic,gravity"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("data") / "track"
    made.track(path)
    return path


@pytest.fixture(scope="module")
def found(folder, tmp_path_factory) -> Diagnosis:
    return diagnose(folder, out=tmp_path_factory.mktemp("out") / "own", effects=DRAGS.split(","), draws=39, device="cpu")


def without_time(path) -> dict:
    content = json.loads((path / "diagnosis.json").read_text())
    content.pop("seconds")
    return content


@pytest.mark.slow
def test_answer_is_that_of_the_command(folder, found, tmp_path, capsys):
    options = ["--effects", DRAGS, "--draws", "39", "--device", "cpu", "--progress", "false"]
    status, out, _ = command.run(capsys, "diagnose", folder, "--out", tmp_path / "by-command", *options)
    assert status == 0
    *words, place, _ = [*out.splitlines(), ""]
    assert "\n".join(words) == found.summary() and words[0].startswith("The model lacks quadratic air drag")
    assert str(tmp_path / "by-command") in place
    assert without_time(found.folder) == without_time(tmp_path / "by-command")


def test_effects_and_error_are_those_of_the_file(found):
    content = found.to_dict()
    assert found.answer == content["answer"] in ("effect", "class")
    (effect,), (own,) = found.effects, content["effects"]
    assert (effect.name, *effect.alternatives) == tuple(own["class"])
    assert "drag_quadratic" in own["class"]
    low, high = effect.interval
    assert low <= effect.value <= high
    assert effect.unit == own["parameters"][effect.parameter]["unit"]
    assert found.error.held_out
    assert (found.error.before, found.error.after) == (content["error"]["before"]["held_out"], content["error"]["after"]["held_out"])
    assert found.error.after < 0.2 * found.error.before
    assert found.model_after == found.folder / "model_after.yaml"
    assert yaml.safe_load(found.model_after.read_text())["effects"]


def test_words_name_effect_figure_and_errors(found):
    (effect,) = found.effects
    for part in (effect.name, f"{effect.value:.3g}", f"{found.error.before:.3g}", f"{found.error.after:.3g}", found.error.unit):
        assert part in repr(found)
    words = found.summary()
    assert words == "\n".join(found.words.paragraphs) == "\n".join(found.to_dict()["words"])
    assert title(effect.name) in words
    (size,) = re.findall(rf"{effect.parameter} = ([\d.]+) per metre", words)
    assert float(size) == pytest.approx(effect.value, rel=0.02) and effect.unit == "1/m"
    (errors,) = re.findall(r"Held-out error ([\d.]+) mm before, ([\d.]+) mm after", words)
    assert [float(e) for e in errors] == pytest.approx([1e3 * found.error.before, 1e3 * found.error.after], rel=5e-3)


def test_plot_has_a_panel_for_each_recording(found):
    figure = found.plot()
    assert isinstance(figure, mpl.figure.Figure)
    assert len(figure.axes) == len(found.to_dict()["error"]["after"]["by_recording"])
    assert all(ax.lines for ax in figure.axes)


def test_report_is_copied(found, tmp_path):
    assert found.report() == found.folder / "report.html"
    path = found.report(tmp_path / "new" / "page.html")
    assert path.read_text() == found.report().read_text()
    assert found.report(tmp_path) == tmp_path / "report.html"


OLDER = Path(__file__).parent / "diagnosis-1"


def test_an_older_file_is_read_and_drawn(tmp_path, capsys):
    found = Diagnosis.read(OLDER)
    assert (found.kind, found.answer, found.effects[0].value) == ("experiment", "effect", pytest.approx(3.0013, abs=1e-3))
    assert found.summary().startswith("The model lacks linear air drag: k = 3.00 per second (90 %: 2.98–3.02).")
    assert set(found.motion()) == {"throw", "toss"} and len(found.plot().axes) == 2
    status, out, _ = command.run(capsys, "report", str(OLDER), "--out", tmp_path / "page.html")
    assert status == 0 and str(tmp_path / "page.html") in out
    assert (tmp_path / "page.html").read_text() == found.page()
    status, _, _ = command.run(capsys, "report", f"a={OLDER}", f"<b>={OLDER}", "--out", tmp_path / "both.html")
    both = (tmp_path / "both.html").read_text()
    assert status == 0 and both.index("All bodies") < both.index("<h2>a: an effect is missing") < both.index("<h2>&lt;b&gt;: an effect")


@pytest.mark.parametrize(
    ("changed", "word"),
    [
        ({"answer": "perhaps"}, "perhaps"),
        ({"effects": [{"name": "drag_linear", "parameters": {}}]}, "class"),
        ({"format": "neuido-diagnosis/2"}, "kind"),
        ({"error": {}}, "before"),
        ({"experiment": "../x", "error": {"before": 1}}, "not as"),
    ],
)
def test_a_file_that_is_not_as_its_format_says_is_refused_in_one_line(tmp_path, changed, word):
    content = json.loads((OLDER / "diagnosis.json").read_text()) | changed
    (tmp_path / "diagnosis.json").write_text(json.dumps(content))
    with pytest.raises(UserError, match=word) as refused:
        Diagnosis.read(tmp_path)
    assert "\n" not in str(refused.value) and "diagnosis.json" in str(refused.value)


def test_names_of_a_file_are_no_paths(tmp_path):
    content = json.loads((OLDER / "diagnosis.json").read_text())
    for when in ("before", "after"):
        content["error"][when]["by_recording"] = {"../throw": 1.0}
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "diagnosis.json").write_text(json.dumps(content))
    (tmp_path / "sub" / "predicted").mkdir()
    shutil.copy(OLDER / "predicted" / "throw.npz", tmp_path / "sub" / "throw.npz")
    assert Diagnosis.read(tmp_path / "sub").motion() == {}


def test_nodes_that_were_not_seen_are_left_blank(tmp_path):
    """A square of two triangles; a node of the second was not seen."""
    shutil.copytree(OLDER, tmp_path / "own")
    nodes, triangles = np.array([[0, 0], [1, 0], [0, 1], [1, 1]], dtype=float), np.array([[0, 1, 2], [1, 3, 2]])
    moved = np.zeros((1, 4, 2))
    measured = moved.copy()
    measured[0, :3, 0], measured[0, 3] = (0.1, 0.2, 0.3), np.nan
    fields = {"nodes": nodes, "triangles": triangles, "moved_before": moved, "moved_after": moved, "moved_measured": measured}
    np.savez(tmp_path / "own" / "predicted" / "throw.npz", before=np.zeros(1), **fields)
    figure = Diagnosis.read(tmp_path / "own").plot()
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    pixels = np.asarray(canvas.buffer_rgba())[::-1]  # from below
    (ax,) = (one for one in figure.axes if one.get_xlabel().startswith("x "))
    factor = ax.collections[0].get_datalim(ax.transData).x1  # a metre in the unit of the axis
    seen, blank = (ax.transData.transform(factor * nodes[t].mean(0)).astype(int) for t in triangles)
    assert pixels[blank[1], blank[0], :3].tolist() == [255, 255, 255]
    assert pixels[seen[1], seen[0], :3].tolist() != [255, 255, 255]


def test_read_again(found):
    again = Diagnosis.read(found.folder)
    assert (again.line, again.effects, again.error) == (found.line, found.effects, found.error)


def test_data_that_are_read_already(folder, found):
    again = diagnose(read_tracks(folder), effects=DRAGS, draws=39, device="cpu")
    assert without_time(again.folder) == without_time(found.folder)
    assert not (again.folder / ".work").exists()


def test_temporary_folder_goes_with_the_diagnosis(tmp_path):
    made.material_test(tmp_path / "test")
    tests = read_material_tests(tmp_path / "test")
    found = diagnose(tests, effects="strain_stiffening", draws=39)
    place = found.folder
    assert "strain stiffening (strain_stiffening)" in found.line
    assert len(found.plot().axes) == 3
    del found
    assert not place.exists()


def test_model_after_closes_the_loop(folder, found):
    """As a file and as its content."""
    again = diagnose(folder, model=found.model_after, effects=DRAGS, draws=39)
    assert (again.answer, again.effects) == ("none", ())
    content = yaml.safe_load(found.model_after.read_text())
    assert diagnose(folder, model=content, effects=DRAGS, draws=39).line == again.line
    assert again.summary().startswith("Nothing is missing")


@pytest.mark.slow
def test_bodies_are_told_apart(tmp_path):
    made.track(tmp_path / "balls", bodies=2)
    found = diagnose(tmp_path / "balls", effects="drag_linear,drag_quadratic", draws=39)
    assert list(found.bodies) == ["ball-0", "ball-1"]
    assert found.answer == "several"
    assert {effect.body for effect in found.effects} == {"ball-0"}
    assert len(found.line.splitlines()) == 2
    assert found.bodies["ball-1"].error.before == pytest.approx(found.bodies["ball-1"].error.after, rel=0.2)
    assert found.error.after < found.error.before


@pytest.mark.parametrize(
    ("options", "word"),
    [({"model": "model.yaml"}, "folder"), ({"law": "law.safetensors"}, "law"), ({"data": "video"}, "data"), ({"data": "sound"}, "sound")],
)
def test_options_that_data_do_not_take(folder, options, word):
    with pytest.raises(UserError, match=word):
        diagnose(read_tracks(folder), **options)


def test_other_objects_and_folders_are_refused(tmp_path):
    with pytest.raises(UserError, match="list"):
        diagnose([1, 2])
    with pytest.raises(UserError, match=r"diagnosis\.json"):
        Diagnosis.read(tmp_path)
    (tmp_path / "diagnosis.json").write_text("{")
    with pytest.raises(UserError, match="JSON"):
        Diagnosis.read(tmp_path)
    (tmp_path / "diagnosis.json").write_text('{"format": "other/1"}')
    with pytest.raises(UserError, match="format"):
        Diagnosis.read(tmp_path)
