"""The second attempt at a reader: other films of a clip say what they are of, and its three steps run on tiny clips."""

import sys
from pathlib import Path

import pytest
import torch

FOLDER = Path(__file__).parents[1] / "benchmarks"
if not FOLDER.is_dir():
    pytest.skip("the benchmarks do not come with the installed package", allow_module_level=True)
sys.path.insert(0, str(FOLDER))

import bodies  # noqa: E402
import motion_reader  # noqa: E402


def falling(speed: float, frames: int = 40) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return cells of a square that falls (y down) at a speed [m/s], the cell's side and the frame interval."""
    cells = torch.zeros(1, 1, frames, 3, motion_reader.SIDE, motion_reader.SIDE)
    cells[..., 10:22, 10:22] = torch.tensor([0.0, speed, 1.0])[:, None, None]
    return cells, torch.full((1, 1), 0.01), torch.tensor([0.01])


def test_another_film_keeps_physics():
    torch.manual_seed(0)
    before, cell, interval = falling(2.0)
    area = float(before[0, 0, 0, 2].sum() * cell.square())
    for _ in range(40):
        cells, other, between, grow = motion_reader.vary(before, cell, interval, 2.0)
        shown = cells[0, 0, :, 2].flatten(1).sum(1) > 0
        assert 8 <= int(shown.sum()) <= 40
        inside = cells[0, 0, 0, 2] > 0.99
        speed = float(cells[0, 0, 0, :2, inside].norm(dim=0).median())
        assert speed == pytest.approx(2.0 * float(grow) ** 0.5, rel=0.2)
        assert float(cells[0, 0, 0, 1, inside].median()) > 0  # still down
        assert float(cells[0, 0, 0, 2].sum() * other.square()) == pytest.approx(area * float(grow) ** 2, rel=0.1)
        assert float(between / 0.01 / grow.sqrt()) in (pytest.approx(1), pytest.approx(2))


def test_a_film_backwards_has_the_opposite_velocity():
    cells, cell, interval = falling(1.0)
    cells[0, 0, :5] = 0
    seen = motion_reader.Motion(cells[0], cell[0], 0.01)
    back = motion_reader.backwards(seen).cells
    assert float(back[0, 0, 1].min()) == -1 and float(back[0, -1].abs().max()) == 0 and float(back[0, 0, 2].max()) == 1


def test_films_trains_and_scores(tmp_path, monkeypatch, capsys):
    common = ["--count", "16", "--frames", "9", "--particles", "250", "--width", "64", "--device", "cpu"]

    def run(*options: str) -> None:
        monkeypatch.setattr(sys, "argv", ["motion_reader.py", *options, *common])
        motion_reader.main()

    for shard in ("0", "1"):
        run("film", "--out", str(tmp_path / "m"), "--shard", shard, "--shards", "2", "--held-out", "0.25", "--batch", "2")
    reader = str(tmp_path / "reader.pt")
    run("train", "--root", str(tmp_path / "m"), "--out", reader, "--steps", "2", "--every", "2", "--rows", "4", "--reader-width", "240")
    assert "12 clips, 4 held out" in capsys.readouterr().out
    common[1] = "2"
    run("score", "--reader", reader, "--out", str(tmp_path / "unseen"), "--seed", "4040")
    text = (tmp_path / "unseen.md").read_text()
    assert "| all | 2 |" in text and "true properties" in text


def test_a_body_that_shrinks_where_the_true_law_does_not_collapsed():
    row = {"finite_learned": 1, "finite_classical": 1, "crushed_learned": 0.0, "crushed_classical": 0.0, "spread_learned": 0.4}
    assert bodies.verdict(row | {"spread_classical": 0.9}) == "collapsed" and bodies.verdict(row | {"spread_classical": 0.5}) == "well"
    assert bodies.verdict(row | {"finite_learned": 0}) == "nan"
