"""NCLaw's networks reproduce the figures that are known of them (their weights are not in the repository)."""

import numpy as np
import pytest
import torch

from neuido.errors import UserError
from neuido.models.baselines import nclaw
from neuido.physics.laws import FixedCorotated, Sigma


def deformations(count=2000):
    return torch.eye(3) + 0.01 * torch.randn(count, 3, 3, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize(
    ("name", "law", "error"),
    [("jelly", FixedCorotated(1e5, 0.2), 0.11), ("plasticine", Sigma(3e5, 0.25), 0.25), ("sand", Sigma(1e6, 0.2), 0.79)],
)
def test_distance_to_the_law_it_was_trained_on(data_root, name, law, error):
    elastic, plastic = nclaw(data_root / "peers" / f"nclaw-{name}.npz")
    F = deformations()
    want, got = law(F), elastic(F)
    assert ((got - want).norm() / want.norm()).item() == pytest.approx(error, abs=0.02)
    if name == "jelly":
        assert torch.cosine_similarity(got.flatten(), want.flatten(), dim=0).item() == pytest.approx(0.995, abs=0.003)
        assert (got.norm() / want.norm()).item() == pytest.approx(1.03, abs=0.02)
        assert elastic.modulus().item() == pytest.approx(law.modulus().item(), rel=0.2)


def test_frame_indifference_and_rest(data_root):
    elastic, plastic = nclaw(data_root / "peers" / "nclaw-jelly.npz")
    F = deformations(50).double()
    Q = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)))[0]
    Q = Q * Q.det()
    torch.testing.assert_close(elastic(Q @ F), Q @ elastic(F) @ Q.T, rtol=1e-6, atol=1e-4)
    torch.testing.assert_close(plastic(Q @ F), Q @ plastic(F), rtol=1e-9, atol=1e-10)
    rest = torch.eye(3, dtype=torch.float64)[None]
    assert elastic(rest).abs().max() == 0 and torch.equal(plastic(rest), rest)


@pytest.mark.parametrize("part", [0, 1])
def test_gradient_with_respect_to_F(data_root, part):
    law = nclaw(data_root / "peers" / "nclaw-plasticine.npz")[part]
    F = deformations(3).double().requires_grad_(True)
    assert torch.autograd.gradcheck(law, (F,), eps=1e-6, rtol=1e-4, atol=1e-4)


def test_missing_or_wrong_file(tmp_path):
    with pytest.raises(UserError, match="are missing"):
        nclaw(tmp_path / "nclaw-jelly.npz")
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(UserError, match="no array elasticity"):
        nclaw(tmp_path / "other.npz")
