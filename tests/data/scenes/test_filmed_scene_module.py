"""Scenes take turns: each once an epoch, shared between processes, and on from where a run stopped."""

import pytest
import torch

from neuido.data.scenes.filmed_scene_module import ShuffledScenes, VisualDataModule, select_training_views
from neuido.errors import UserError
from neuido.types import Cameras, MultiViewBatch

NAMES = list("abcde")


def epoch(turns, number):
    turns.set_epoch(number)
    return list(turns)


def test_every_scene_once_an_epoch_in_another_order():
    turns = ShuffledScenes(NAMES)
    orders = [epoch(turns, k) for k in range(4)]
    assert all(sorted(order) == NAMES for order in orders)
    assert len({tuple(order) for order in orders}) > 1
    assert epoch(ShuffledScenes(NAMES), 2) == orders[2] != epoch(ShuffledScenes(NAMES, seed=1), 2)


def test_processes_share_the_scenes():
    both = [epoch(ShuffledScenes(NAMES, rank=rank, ranks=2), 3) for rank in (0, 1)]
    whole = epoch(ShuffledScenes(NAMES), 3)
    assert [len(own) for own in both] == [3, 3]
    assert [both[k % 2][k // 2] for k in range(5)] == whole
    assert both[1][2] == whole[0]  # an odd number: the first scene comes twice


def test_it_goes_on_where_it_stopped():
    turns = ShuffledScenes(NAMES)
    turns.set_epoch(1)
    iterator = iter(turns)
    seen = [next(iterator), next(iterator)]
    again = ShuffledScenes(NAMES)
    again.load_state_dict(turns.state_dict())
    assert seen + epoch(again, 1) == epoch(ShuffledScenes(NAMES), 1)
    assert epoch(again, 2) == epoch(ShuffledScenes(NAMES), 2)
    with pytest.raises(UserError, match="scenes"):
        ShuffledScenes(NAMES[:3]).load_state_dict(turns.state_dict())


def test_what_is_missing_is_named(tmp_path):
    with pytest.raises(UserError, match="empty"):
        VisualDataModule([])
    (tmp_path / "one").mkdir()
    with pytest.raises(UserError, match=r"data.scenes\[0\].*neuido reconstruct"):
        VisualDataModule(["one"], root=str(tmp_path)).setup("fit")
    with pytest.raises(UserError, match="colour"):
        VisualDataModule([{"path": "one", "colour": "red"}], root=str(tmp_path)).setup("fit")


def filmed(views: int, held_out: tuple[int, ...]) -> MultiViewBatch:
    """A batch whose images and cameras are the numbers of their views."""
    numbers = torch.arange(views, dtype=torch.float32)
    cameras = Cameras(numbers[:, None, None] * torch.ones(4, 4), numbers[:, None, None] * torch.ones(3, 3), 2, 2)
    images = numbers[:, None, None, None, None] * torch.ones(3, 2, 2, 3)
    held = torch.tensor([v in held_out for v in range(views)])
    return MultiViewBatch(0, "one", images, images[..., 0], cameras, torch.arange(3.0).double(), held, torch.ones(3))


@pytest.mark.parametrize(
    ("given", "kept"),
    [(1, [0, 3, 9]), (4, [0, 2, 3, 6, 9, 10]), (10, list(range(12))), ([1, 9], [1, 3, 9, 11]), ([9, 1, 9], [1, 3, 9, 11])],
)
def test_training_on_some_of_the_views(given, kept):
    """Held-out views 3 and 9 stay whatever is chosen; the numbers are those of the others."""
    batch = select_training_views(filmed(12, (3, 9)), given)
    assert batch.images[:, 0, 0, 0, 0].tolist() == kept
    for part in (batch.masks[:, 0, 0, 0], batch.cameras.viewmats[:, 0, 0], batch.cameras.Ks[:, 0, 0]):
        assert part.tolist() == kept
    assert batch.held_out.nonzero()[:, 0].tolist() == [kept.index(3), kept.index(9)]


@pytest.mark.parametrize("given", [0, 3, -1, [], [2], [-1]])
def test_views_that_there_are_not(given):
    with pytest.raises(UserError, match="training_views"):
        select_training_views(filmed(3, (1,)), given)
