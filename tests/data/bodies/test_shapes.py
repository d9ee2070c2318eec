import math

import pytest
import torch

from neuido.data.bodies import shapes
from neuido.errors import UserError


def test_cube_is_nclaws():
    body = shapes.cube(velocity=(1.0, -1.5, -2.0), angular_velocity=(4.0, 4.0, 4.0))
    assert body.x.shape == (1000, 3)
    assert body.volume.unique().tolist() == pytest.approx([0.125 / 1000])
    assert body.x.amin(0).tolist() == pytest.approx([0.25] * 3)
    assert body.x.amax(0).tolist() == pytest.approx([0.75] * 3)
    assert body.v.mean(0).tolist() == pytest.approx([1.0, -1.5, -2.0], abs=1e-5)
    corner = (body.x - 0.75).abs().sum(-1).argmin()  # omega x r with r = (1, 1, 1) / 4 along omega
    assert body.v[corner].tolist() == pytest.approx([1.0, -1.5, -2.0], abs=1e-6)


BODIES = {
    "box": (shapes.box, {"lower": (0.1, 0.2, 0.3), "upper": (0.3, 0.5, 0.4)}, 0.2 * 0.3 * 0.1),
    "ball": (shapes.ball, {"centre": (0.5, 0.4, 0.3), "radius": 0.2}, 4 / 3 * math.pi * 0.008),
    "cylinder": (shapes.cylinder, {"centre": (0.5, 0.4, 0.3), "radius": 0.1, "height": 0.5, "axis": "z"}, math.pi * 0.01 * 0.5),
}


@pytest.mark.parametrize("jitter", [0.0, 1.0])
@pytest.mark.parametrize("name", BODIES)
def test_fillings(name, jitter):
    make, size, volume = BODIES[name]
    body = make(**size, spacing=0.02, jitter=jitter, seed=3)
    again = make(**size, spacing=0.02, jitter=jitter, seed=3)
    assert torch.equal(body.x, again.x)
    assert float(body.volume.double().sum()) == pytest.approx(volume, rel=1e-5)
    assert len(body.x) == pytest.approx(volume / 0.02**3, rel=0.05)
    assert body.v.abs().max() == 0
    if name == "ball":
        assert (body.x - torch.tensor(size["centre"])).norm(dim=1).max() <= 0.2 + 1e-6
        assert body.x.mean(0).tolist() == pytest.approx([0.5, 0.4, 0.3], abs=0.005)
    if name == "cylinder":
        assert (body.x - torch.tensor(size["centre"]))[:, :2].norm(dim=1).max() <= 0.1 + 1e-6
        assert (body.x[:, 2] - 0.3).abs().max() <= 0.25
    if jitter:
        other = make(**size, spacing=0.02, jitter=jitter, seed=4)
        assert other.x.shape != body.x.shape or not torch.equal(other.x, body.x)


def test_rigid_velocity_strains_nothing():
    x = torch.rand(50, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    v = shapes.rigid_velocity(x, centre=(0.1, 0.2, 0.3), velocity=(1, 2, 3), angular_velocity=(-1.0, 0.5, 2.0))
    dx, dv = x[:, None] - x, v[:, None] - v
    assert (dx * dv).sum(-1).abs().max() < 1e-13


@pytest.mark.parametrize(
    ("make", "options", "word"),
    [
        (shapes.cube, {"length": -1.0}, "length"),
        (shapes.cube, {"particles_per_side": 1}, "particles_per_side"),
        (shapes.cube, {"particles_per_side": 1000}, "particles_per_side"),
        (shapes.cube, {"centre": (0.0, 0.0)}, "centre"),
        (shapes.cube, {"velocity": (0.0, float("nan"), 0.0)}, "velocity"),
        (shapes.box, {"lower": (0, 0, 1), "upper": (1, 1, 0), "spacing": 0.1}, "lower"),
        (shapes.box, {"lower": (0, 0, 0), "upper": (1, 1, 1), "spacing": 0.0}, "spacing"),
        (shapes.box, {"lower": (0, 0, 0), "upper": (1, 1, 1), "spacing": 1e-4}, "spacing"),
        (shapes.ball, {"centre": (0, 0, 0), "radius": 0.1, "spacing": 0.05, "jitter": 2.0}, "jitter"),
        (shapes.ball, {"centre": (0, 0, 0), "radius": 0.0, "spacing": 0.05}, "radius"),
        (shapes.cylinder, {"centre": (0, 0, 0), "radius": 0.1, "height": 1.0, "spacing": 0.05, "axis": "w"}, "axis"),
    ],
)
def test_errors_are_one_line_and_name_the_option(make, options, word):
    with pytest.raises(UserError, match=word) as error:
        make(**options)
    assert "\n" not in str(error.value)
