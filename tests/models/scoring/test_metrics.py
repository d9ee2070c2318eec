import pytest
import torch

from neuido.models.scoring.metrics import (
    ChamferDistance,
    MatchedRMSE,
    MedianRelativeError,
    chamfer_distance,
    nearest_squared,
    resampling_floor,
)
from neuido.physics.linalg.nearest import nearest_by_pairs


def points(count, seed):
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(seed))


def brute_force(a, b):
    d = (a[:, None] - b[None]).double().square().sum(-1)
    return d.amin(1).mean() + d.amin(0).mean()


def test_chamfer_equals_brute_force():
    a, b = points(300, 0), points(211, 1)
    assert chamfer_distance(a, b).item() == pytest.approx(brute_force(a, b).item(), rel=1e-5)
    shifted = a + torch.tensor([1e-3, 0.0, 0.0])
    assert chamfer_distance(a, shifted).item() == pytest.approx(2e-6, rel=1e-3)


def test_chamfer_metric_is_the_mean_over_frames_in_the_unit_of_the_paper():
    a, b = torch.stack([points(50, 2), points(50, 3)]), torch.stack([points(60, 4), points(60, 5)])
    metric = ChamferDistance()
    metric.update(a[:1], b[:1])
    metric.update(a[1], b[1])
    expected = 1e4 * (brute_force(a[0], b[0]) + brute_force(a[1], b[1])) / 2
    assert metric.compute().item() == pytest.approx(expected.item(), rel=1e-5)


def frames(count, many, seed):
    return torch.stack([points(many, seed + k) for k in range(count)])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.slow
def test_all_pairs_equal_the_tree(dtype):
    """The GPU's kernel, here on the CPU; a distance of 1e-6 between points near 1 must survive, which |a|^2 + |b|^2 - 2 a.b loses."""
    a, b = frames(3, 400, 20).to(dtype), frames(3, 330, 30).to(dtype)
    b[:, :5] = a[:, :5] + 1e-6
    found, expected = nearest_by_pairs(a, b), nearest_squared(a, b)
    assert found.dtype == dtype and found.shape == (3, 400)
    torch.testing.assert_close(found, expected, rtol=1e-5 if dtype == torch.float32 else 1e-12, atol=0)
    assert found[:, :5].max() < 4e-12


def test_frames_at_once_equal_frames_alone():
    a, b = frames(4, 200, 40).view(2, 2, 200, 3), frames(4, 150, 50).view(2, 2, 150, 3)
    for batched, alone in (
        (chamfer_distance(a, b), [[chamfer_distance(x, y) for x, y in zip(*rows)] for rows in zip(a, b)]),
        (resampling_floor(a), [[resampling_floor(x) for x in row] for row in a]),
    ):
        torch.testing.assert_close(batched, torch.tensor(alone))
    with pytest.raises(ValueError, match="expected"):
        chamfer_distance(a, b[:1])


@pytest.mark.gpu
def test_nearest_on_a_gpu_equals_the_tree():
    a, b = frames(4, 5000, 6), frames(4, 3000, 60)
    torch.testing.assert_close(nearest_squared(a.cuda(), b.cuda()).cpu(), nearest_squared(a, b), rtol=1e-5, atol=1e-12)


def test_resampling_floor_is_the_distance_of_two_samplings():
    """Of a uniform cube: two independent samplings of as many points are as far apart as the floor says."""
    floor = resampling_floor(points(8000, 8))
    assert floor.item() == pytest.approx(chamfer_distance(points(8000, 9), points(8000, 10)).item(), rel=0.1)


def test_matched_rmse():
    a = points(100, 11).expand(3, 100, 3)
    metric = MatchedRMSE()
    metric.update(a, a + torch.tensor([0.0, 0.3, 0.4]))
    metric.update(a[0], a[0])
    assert metric.compute().item() == pytest.approx(0.5 * (3 / 4) ** 0.5, rel=1e-5)


def test_median_equals_the_sorted_middle():
    errors = torch.randn(100_001, generator=torch.Generator().manual_seed(12)).mul(2).exp()
    metric = MedianRelativeError()
    for part in errors.split(7000):
        metric.update(part)
    assert metric.compute().item() == pytest.approx(errors.median().item(), rel=0.02)


def test_median_of_zeros_infinities_and_nothing():
    metric = MedianRelativeError()
    assert metric.compute().isnan()
    metric.update(torch.tensor([0.0, 0.0, 1.0]))
    assert metric.compute() == 0
    metric.update(torch.full((4,), float("nan")))
    assert metric.compute() > 1e3
