import pytest
import torch

from neuido.models.scoring.losses import relative_errors, relative_lp


def test_relative_loss_by_hand():
    target = torch.zeros(2, 3, 3)
    target[0, 0, 0], target[0, 1, 1] = 3.0, 4.0
    prediction = target.clone()
    prediction[0, 2, 2], prediction[1, 0, 0] = 1.0, 0.1
    torch.testing.assert_close(relative_errors(prediction, target, 1.0), torch.tensor([1 / 6, 0.1]))
    assert relative_lp(prediction, target, torch.tensor([0.0, 0.2])).item() == pytest.approx((0.2 + 0.5) / 2)


def test_relative_loss_is_finite_at_a_perfect_answer():
    prediction = torch.zeros(4, 3, 3, requires_grad=True)
    relative_lp(prediction, torch.zeros(4, 3, 3), 1e-3).backward()
    assert torch.isfinite(prediction.grad).all()
