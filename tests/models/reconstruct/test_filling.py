import math

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from neuido.data.cameras import orbit
from neuido.errors import UserError
from neuido.models.reconstruct.filling import Volume, fill, opacity_volume, visual_hull
from neuido.types import Gaussians

RADIUS, CENTRE = 0.2, torch.tensor([0.5, 0.4, 0.55])
BALL = 4 / 3 * math.pi * RADIUS**3


def silhouettes(count: int, side: int = 128):
    """Exact masks of a ball from cameras around it."""
    cameras = orbit(count, target=(0.5, 0.4, 0.5), radius=2.0, elevations=(0.0, 30.0, 60.0), angle=30, width=side, height=side)
    rows, columns = torch.meshgrid(torch.arange(side) + 0.5, torch.arange(side) + 0.5, indexing="ij")
    masks = []
    for viewmat, K in zip(cameras.viewmats, cameras.Ks):
        c = viewmat[:3, :3] @ CENTRE + viewmat[:3, 3]
        ray = torch.stack([(columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1], torch.ones_like(rows)], -1)
        along = torch.nn.functional.normalize(ray, dim=-1) @ c
        masks.append((c @ c - along**2 < RADIUS**2).float())
    return torch.stack(masks), cameras


def shell(count: int = 5000, hole: float = 0.0) -> Gaussians:
    """Thin Gaussians on a sphere, without those of a cap of this angle at its top [rad]."""
    d = torch.nn.functional.normalize(torch.randn(count, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    d = d[d[:, 1] < math.cos(hole)]
    n = len(d)
    return Gaussians(CENTRE + (RADIUS - 0.005) * d, 0.005**2 * torch.eye(3).expand(n, 3, 3), torch.full((n,), 0.9), torch.zeros(n, 1, 3))


def test_hull_of_a_ball():
    sizes = []
    for count in (3, 16):
        hull = visual_hull(*silhouettes(count), (0, 0, 0), (1, 1, 1), resolution=64)
        x = hull.centres()[hull.values > 0.5]
        distance = (x - CENTRE).norm(dim=1)
        assert bool((hull.at(CENTRE[None] + torch.tensor([[0, 0, 0], [0.15, 0, 0], [0, -0.15, 0]])) > 0.99).all())
        sizes.append(hull.measure_volume() / BALL)
    assert sizes[0] > sizes[1] > 0.97 and sizes[1] < 1.06
    assert float(distance.max()) < RADIUS + 0.03


def test_hull_needs_masks_that_meet():
    masks, cameras = silhouettes(4)
    with pytest.raises(UserError, match="shape"):
        visual_hull(masks[:2], cameras, (0, 0, 0), (1, 1, 1))
    with pytest.raises(UserError, match="no point of the scene's domain"):
        visual_hull(masks, cameras, (0, 2, 0), (1, 3, 1))
    with pytest.raises(UserError, match=r"no point|do not meet"):
        visual_hull(masks * torch.tensor([1.0, 0.0, 1.0, 1.0])[:, None, None], cameras, (0, 0, 0), (1, 1, 1))


@pytest.mark.parametrize("hole", [0.0, 0.12])
def test_shell_is_filled(hole):
    volume = opacity_volume(shell(hole=hole), spacing=0.008)
    assert volume.measure_volume() / BALL == pytest.approx(1.0, abs=0.08)
    assert float(volume.at(CENTRE[None])) == 1.0


def test_open_bowl_is_not_filled():
    bowl = shell(hole=math.pi / 2)
    volume = opacity_volume(bowl, spacing=0.008)
    assert volume.measure_volume() < 0.35 * BALL
    assert float(volume.at(CENTRE[None])) < 0.5


def test_hull_trims_what_no_mask_shows():
    g = shell()
    stray = Gaussians(torch.tensor([[0.9, 0.9, 0.9]]), 0.02**2 * torch.eye(3)[None], torch.tensor([0.9]), torch.zeros(1, 1, 3))
    both = Gaussians(*(torch.cat([a, b]) for a, b in zip(g[:4], stray[:4])))
    hull = visual_hull(*silhouettes(8), (0, 0, 0), (1, 1, 1), resolution=48)
    assert float(opacity_volume(both, spacing=0.01).at(stray.means)) > 0.5
    assert float(opacity_volume(both, spacing=0.01, hull=hull).at(stray.means)) < 0.01


@pytest.mark.parametrize("method", ["voxel", pytest.param("poisson", marks=pytest.mark.slow)])
def test_particles_fill_the_body(method):
    hull = visual_hull(*silhouettes(16), (0, 0, 0), (1, 1, 1), resolution=48)
    x, volume = fill(hull, count=4000, method=method)
    assert len(x) == pytest.approx(4000, rel=0.05)
    assert float(volume.sum()) == pytest.approx(hull.measure_volume(), rel=1e-4)
    edge = float(volume[0]) ** (1 / 3)
    assert bool((hull.at(x) > 0.5).all())
    nearest = cKDTree(x.numpy()).query(x.numpy(), k=2)[0][:, 1] / edge
    assert nearest.min() > (0.8 if method == "poisson" else 0.45) and nearest.max() < 1.3
    # nowhere a hole: every place inside has a particle near
    inside = hull.centres()[hull.values > 0.9].numpy()
    assert cKDTree(x.numpy()).query(inside)[0].max() < 1.3 * edge
    np.testing.assert_allclose(x.mean(0), CENTRE, atol=0.005)
    again, _ = fill(hull, count=4000, method=method)
    other, _ = fill(hull, count=4000, method=method, seed=1)
    assert torch.equal(x, again) and not torch.equal(x[:100], other[:100])
    spaced, _ = fill(hull, spacing=edge, method=method)
    assert len(spaced) == pytest.approx(len(x), rel=0.05)


def test_fill_errors():
    volume = Volume(torch.ones(4, 4, 4), torch.zeros(3), 0.1)
    with pytest.raises(UserError, match="either the number"):
        fill(volume)
    with pytest.raises(UserError, match="method = 'grid'"):
        fill(volume, count=10, method="grid")
    with pytest.raises(UserError, match="must be positive"):
        fill(volume, spacing=-1.0)
    with pytest.raises(UserError, match="empty"):
        fill(volume._replace(values=torch.zeros(4, 4, 4)), count=10)
