"""The structural similarity of the loss is that of torchmetrics, with its gradient."""

import pytest
import torch
from torchmetrics.functional.image import structural_similarity_index_measure

from neuido.models.render.similarity import structural_similarity


@pytest.mark.parametrize("size", [(6, 9), (37, 24)])
def test_it_is_that_of_torchmetrics_with_its_gradient(size):
    g = torch.Generator().manual_seed(0)
    images = torch.rand(3, 3, *size, generator=g, dtype=torch.float64)
    others = (images + 0.2 * torch.randn(images.shape, generator=g, dtype=torch.float64)).clamp(0, 1)
    others[1] = 0.0  # black
    others[2] = images[2]
    images.requires_grad_()
    found = structural_similarity(images, others)
    true = structural_similarity_index_measure(images, others, data_range=1.0, reduction="none")
    torch.testing.assert_close(found, true, rtol=0, atol=1e-6)
    noisy, black, same = found.tolist()
    assert same == pytest.approx(1.0) and black < 0.2 < noisy < 0.99
    for a, b in zip(*(torch.autograd.grad(t.sum(), images)[0] for t in (found, true))):
        assert (a - b).norm() <= 1e-5 * b.norm() + 1e-9
