import pytest
import torch

from neuido.metrics import ChamferDistance, MatchedRMSE, MedianRelativeError, chamfer_distance, nearest_squared, resampling_floor


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


@pytest.mark.gpu
def test_nearest_on_a_gpu_equals_the_tree():
    a, b = points(5000, 6), points(3000, 7)
    torch.testing.assert_close(nearest_squared(a.cuda(), b.cuda(), chunk=1024).cpu(), nearest_squared(a, b), rtol=1e-4, atol=1e-9)


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
