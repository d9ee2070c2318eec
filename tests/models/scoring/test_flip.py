"""ꟻLIP gives the figures of its authors' program, is zero for equal images and grows with their difference."""

import pytest
import torch

from neuido.models.scoring.flip import flip


def ball(x0, height=37, width=53):
    """A red disk on a ramp of colours, (3, H, W)."""
    y, x = torch.meshgrid(
        torch.linspace(0, 1, height, dtype=torch.float64), torch.linspace(0, 1, width, dtype=torch.float64), indexing="ij"
    )
    inside = (x - x0) ** 2 + (y - 0.5) ** 2 < 0.06
    red = torch.tensor([0.9, 0.2, 0.1], dtype=torch.float64).view(3, 1, 1)
    return torch.where(inside, red, torch.stack([x, y, 0.5 * (x + y)]))


def stripes(phase, height=29, width=41):
    """Fine waves of different colours, (3, H, W)."""
    x = torch.arange(width, dtype=torch.float64).expand(height, -1)
    return torch.stack([0.5 + 0.4 * torch.sin(frequency * x + phase) for frequency in (0.3, 0.9, 1.7)])


@pytest.mark.parametrize(
    ("pair", "pixels_per_degree", "expected"),
    [
        ((ball(0.4), ball(0.46)), 67.0206, 0.0987291),
        ((ball(0.4), ball(0.46)), 30.0, 0.0778553),
        ((stripes(0.0), stripes(0.7)), 67.0206, 0.5315621),
        ((stripes(0.0), stripes(0.7)), 30.0, 0.6659247),
    ],
)
def test_equals_the_authors_program(pair, pixels_per_degree, expected):
    """Figures of flip-evaluator 1.7, LDR."""
    found = flip(*(t[None] for t in pair), pixels_per_degree)
    assert float(found) == pytest.approx(expected, rel=1e-5)


def test_equal_images_differ_by_nothing_and_others_by_one_at_most():
    a, b = torch.rand(2, 4, 3, 20, 24, generator=torch.Generator().manual_seed(0))
    assert float(flip(a, a).max()) == 0
    assert 0.05 < float(flip(a, b).min()) <= float(flip(a, b).max()) <= 1
    black, white = torch.zeros(1, 3, 20, 24), torch.ones(1, 3, 20, 24)
    assert float(flip(black, white)) > 0.9


def test_images_of_a_batch_are_scored_alone():
    a, b = torch.rand(2, 3, 3, 16, 18, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(flip(a, b), torch.cat([flip(a[i : i + 1], b[i : i + 1]) for i in range(3)]))


def test_a_body_farther_away_differs_more():
    values = [float(flip(ball(0.4)[None], ball(0.4 + shift)[None])) for shift in (0.0, 0.02, 0.06, 0.2)]
    assert values == sorted(values) and values[0] == 0 and values[1] > 0.01
