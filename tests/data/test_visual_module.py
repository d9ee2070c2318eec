"""Scenes take turns: each once an epoch, shared between processes, and on from where a run stopped."""

import pytest

from neuido.data.visual_module import Turns, VisualDataModule
from neuido.errors import UserError

NAMES = list("abcde")


def epoch(turns, number):
    turns.set_epoch(number)
    return list(turns)


def test_every_scene_once_an_epoch_in_another_order():
    turns = Turns(NAMES)
    orders = [epoch(turns, k) for k in range(4)]
    assert all(sorted(order) == NAMES for order in orders)
    assert len({tuple(order) for order in orders}) > 1
    assert epoch(Turns(NAMES), 2) == orders[2] != epoch(Turns(NAMES, seed=1), 2)


def test_processes_share_the_scenes():
    both = [epoch(Turns(NAMES, rank=rank, ranks=2), 3) for rank in (0, 1)]
    whole = epoch(Turns(NAMES), 3)
    assert [len(own) for own in both] == [3, 3]
    assert [both[k % 2][k // 2] for k in range(5)] == whole
    assert both[1][2] == whole[0]  # an odd number: the first scene comes twice


def test_it_goes_on_where_it_stopped():
    turns = Turns(NAMES)
    turns.set_epoch(1)
    iterator = iter(turns)
    seen = [next(iterator), next(iterator)]
    again = Turns(NAMES)
    again.load_state_dict(turns.state_dict())
    assert seen + epoch(again, 1) == epoch(Turns(NAMES), 1)
    assert epoch(again, 2) == epoch(Turns(NAMES), 2)
    with pytest.raises(UserError, match="scenes"):
        Turns(NAMES[:3]).load_state_dict(turns.state_dict())


def test_what_is_missing_is_named(tmp_path):
    with pytest.raises(UserError, match="empty"):
        VisualDataModule([])
    (tmp_path / "one").mkdir()
    with pytest.raises(UserError, match=r"data.scenes\[0\].*neuido reconstruct"):
        VisualDataModule(["one"], root=str(tmp_path)).setup("fit")
    with pytest.raises(UserError, match="colour"):
        VisualDataModule([{"path": "one", "colour": "red"}], root=str(tmp_path)).setup("fit")
