"""The page of several runs: figures of the files, best ones bold, curves, videos, and nothing from elsewhere."""

import re
from html.parser import HTMLParser
from pathlib import Path

import pytest
import torch

from neuido.commands.main import main
from neuido.commands.report import report
from neuido.data.files.html_page import Best, table, webm
from neuido.data.files.results import open_runs
from neuido.data.files.score_tables import read_rows, write_rows
from neuido.errors import UserError
from neuido.models.inference.outputs import write_video


class Cells(HTMLParser):
    """The tables of a page: for each heading rows of (text, whether bold)."""

    def __init__(self, text: str):
        super().__init__()
        self.tables: dict[str, list[list[tuple[str, bool]]]] = {}
        self._heading, self._inside, self._bold = "", "", False
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self._inside, self._bold = tag, "best" in (dict(attrs).get("class") or "")
        if tag == "tr":
            self.tables.setdefault(self._heading, []).append([])
        elif tag in ("td", "th"):
            self.tables[self._heading][-1].append(("", self._bold))

    def handle_data(self, data):
        if self._inside in ("h2", "h1"):
            self._heading = data
        elif self._inside in ("td", "th"):
            self.tables[self._heading][-1][-1] = (data, self._bold)

    def handle_endtag(self, tag):
        self._inside = ""

    def table(self, word: str) -> dict[str, list[tuple[str, bool]]]:
        (found,) = (rows for heading, rows in self.tables.items() if word in heading)
        return {row[0][0]: row[1:] for row in found}


def scored(folder: Path, cd: dict[str, float], **more) -> Path:
    rows = [{"scene": s, "cd": v, "floor": 1.0, "psnr": 30 + v, "seconds": 2.0, **more} for s, v in cd.items()]
    write_rows(folder / "scores.csv", rows)
    for scene, value in cd.items():
        write_rows(folder / scene / "particles.csv", [{"frame": k, "cd": value * k, "floor": 1.0, "rmse": 0.1} for k in (1, 2, 3)])
    return folder


@pytest.fixture
def runs(tmp_path) -> list[str]:
    """Two runs of two scenes: the second is better on Cat, in Chamfer distance, and worse on Ball."""
    first, second = scored(tmp_path / "a" / "results", {"Ball": 2.0, "Cat": 3.0}), scored(tmp_path / "b", {"Ball": 2.5, "Cat": 1.5})
    log = [{"step": k, "epoch": 0, "train/loss": 1 / (k + 1), "train/Ball/x": 2.0} for k in range(4)]
    write_rows(first.parent / "log" / "version_0" / "metrics.csv", log)
    frames = torch.linspace(0, 1, 4)[:, None, None, None].expand(4, 32, 64, 3)
    write_video(second / "Cat" / "prediction.mp4", frames)
    return [str(tmp_path / "a"), f"theirs={second}"]


def test_tables_show_the_files_and_mark_the_best(runs, tmp_path):
    report(runs, out=str(tmp_path / "page.html"))
    cells = Cells((tmp_path / "page.html").read_text())
    chamfer = cells.table("Chamfer distance [1e-4")
    assert [text for text, _ in chamfer[""]] == ["Ball", "Cat", "mean", "mean over floor"]
    assert chamfer["a"] == [("2", True), ("3", False), ("2.5", False), ("2.5", False)]
    assert chamfer["theirs"] == [("2.5", False), ("1.5", True), ("2", True), ("2", False)]
    assert [text for text, _ in chamfer["resampling floor"]] == ["1", "1", "1", "1"]
    assert cells.table("PSNR on")["theirs"] == [("32.5", True), ("31.5", False), ("32", False)]
    assert cells.table("Cost")["a"] == [("2", False)]
    assert "LPIPS is absent" in (tmp_path / "page.html").read_text()


def test_page_needs_nothing_else_and_shows_curves_and_videos(runs, tmp_path):
    report(runs, out=str(tmp_path / "page.html"))
    text = (tmp_path / "page.html").read_text()
    assert not re.findall(r'(?:src|href)="(?!data:|#)', text)
    assert text.count("<svg") == 2  # over time, and logged
    assert "train/loss" in text
    assert "train/Ball/x" not in text
    assert text.count("<video") == 1
    assert "theirs, prediction" in text


def test_limit_of_the_videos(runs, tmp_path):
    report(runs, out=str(tmp_path / "page.html"), limit=0.0001)
    text = (tmp_path / "page.html").read_text()
    assert "<video" not in text
    assert "prediction.mp4" in text


def test_video_plays_the_frames(tmp_path):
    import cv2

    write_video(tmp_path / "a.mp4", torch.linspace(0, 1, 6)[:, None, None, None].expand(6, 48, 80, 3))
    data = webm(tmp_path / "a.mp4", 40)
    assert data[:4] == b"\x1aE\xdf\xa3"  # EBML, of which WebM is made
    (tmp_path / "a.webm").write_bytes(data)
    video = cv2.VideoCapture(str(tmp_path / "a.webm"))
    frames = [frame for ok, frame in iter(video.read, (False, None)) if ok]
    assert len(frames) == 6
    assert frames[0].shape == (24, 40, 3)
    assert frames[0].mean() < 30 < 220 < frames[5].mean()
    (tmp_path / "no.mp4").write_text("junk")
    assert webm(tmp_path / "no.mp4", 40) is None


def test_before_and_after_a_fit_are_rows_of_their_own(tmp_path):
    rows = [{"scene": "Ball", "stage": stage, "cd": cd, "steps": 9} for stage, cd in (("before", 4.0), ("after", 2.0))]
    write_rows(tmp_path / "fit" / "scores.csv", rows)
    write_rows(tmp_path / "fit" / "test.csv", [{"scene": "Ball", "stage": "test", "cd": 2.5}])
    write_rows(tmp_path / "none" / "scores.csv", [{"scene": "Ball", "stage": "before", "cd": 7.0}])  # a method that learns nothing
    write_rows(tmp_path / "fit" / "Ball" / "before" / "particles.csv", [{"frame": 1, "cd": 4.0, "floor": 1.0}])
    entries = open_runs([str(tmp_path / "fit"), str(tmp_path / "none")])
    assert [(e.label, e.row_of("Ball")["cd"]) for e in entries] == [("fit, before", 4), ("fit, after", 2), ("fit, test", 2.5), ("none", 7)]
    assert [len(e.by_frame("Ball")) for e in entries] == [1, 0, 0, 0]
    assert [e.last for e in entries] == [False, False, True, True]


def test_rivals_of_a_run_have_rows(tmp_path):
    scored(tmp_path / "a", {"Ball": 2.0}, unseen=1, cd_random=200.0)
    report([str(tmp_path / "a")], out=str(tmp_path / "page.html"))
    chamfer = Cells((tmp_path / "page.html").read_text()).table("Chamfer distance [")
    assert chamfer[""][0] == ("Ball (unseen)", False)
    assert chamfer["a, random"][0] == ("200", False)
    assert chamfer["a"][0] == ("2", True)


def test_the_papers_rows_are_never_best(tmp_path):
    scored(tmp_path / "a", {"Ball": 2.0})
    scored(tmp_path / "b", {"Ball": 3.0})
    write_rows(tmp_path / "paper.csv", [{"run": "NeuMA", "scene": "Ball", "cd": 0.5}])
    report([str(tmp_path / "a"), str(tmp_path / "b")], out=str(tmp_path / "page.html"), paper=str(tmp_path / "paper.csv"))
    chamfer = Cells((tmp_path / "page.html").read_text()).table("Chamfer distance [")
    assert chamfer["paper: NeuMA"][0] == ("0.5", False)
    assert chamfer["a"][0] == ("2", True)


def test_spread_over_seeds(tmp_path):
    from neuido.commands.sweep import FORMAT

    for seed, cd in enumerate((1.0, 1.1, 1.2)):
        run = tmp_path / "sweep" / f"seed-{seed}"
        scored(run / "adapt", {"Ball": cd})
        note = f'{{"format": "{FORMAT}", "status": "done", "parameters": {{"model.method.seed": {seed}}}}}'
        (run / "run.json").write_text(note)
    report([str(tmp_path / "sweep")], out=str(tmp_path / "page.html"))
    cells = Cells((tmp_path / "page.html").read_text())
    assert [text for text, _ in cells.table("over seeds")["Ball"]] == ["3", "1", "1.2", "1.1", "0.1", "0.09091", "0.1818"]
    assert {"seed-0", "seed-1", "seed-2"} < set(cells.table("Chamfer distance [1e-4"))


def test_hostile_names_are_text(tmp_path):
    scored(tmp_path / "a", {"<script>alert(1)</script>": 2.0})
    report([f"<b>=x</b>={tmp_path / 'a'}"], out=str(tmp_path / "page.html"))
    text = (tmp_path / "page.html").read_text()
    assert "<script" not in text
    assert "<b>" not in text


@pytest.mark.parametrize("given", [[], ["nowhere"], ["."]])
def test_mistakes_are_one_line(tmp_path, monkeypatch, capsys, given):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        main(["report", *(given or ["--runs", "[]"]), "--out", "page.html"])
    err = capsys.readouterr().err.strip()
    assert stop.value.code == 2
    assert len(err.splitlines()) == 1
    assert "runs" in err
    assert not Path("page.html").exists()


def test_several_folders_may_stand_alone(runs, tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        main(["report", *runs, "--out", str(tmp_path / "page.html"), "--videos", "false"])
    assert stop.value.code == 0, capsys.readouterr().err
    assert "<video" not in (tmp_path / "page.html").read_text()


def test_broken_table(tmp_path):
    (tmp_path / "scores.csv").write_bytes(b"scene,cd\n\xff\xfe\x00,1\n")
    with pytest.raises(UserError, match=r"scores\.csv"):
        open_runs([str(tmp_path)])


def test_rows_come_back(tmp_path):
    rows = [{"a": 1.5, "b": "x, y"}, {"a": float("inf"), "c": 3}]
    write_rows(tmp_path / "t.csv", rows)
    assert read_rows(tmp_path / "t.csv") == [{"a": 1.5, "b": "x, y"}, {"a": float("inf"), "c": 3.0}]
    assert [path.name for path in tmp_path.iterdir()] == ["t.csv"]


def test_table_cells():
    made = table(("x",), [[1.23456], [Best(2)], [float("nan")], ["<i>"], [Best("y")]], digits=3)
    assert '<td class="n">1.23</td>' in made
    assert '<td class="n best">2</td>' in made
    assert "<td></td>" in made
    assert "&lt;i&gt;" in made
    assert '<td class="t best">y</td>' in made
    assert table(("x",), []) == "<p>None.</p>"
