import pytest
import torch

from neuido.data import bind_skin, shapes
from neuido.errors import UserError

BODY = shapes.ball(centre=(0.5, 0.5, 0.5), radius=0.2, spacing=0.05, jitter=0.5)
DIRECTIONS = torch.nn.functional.normalize(torch.randn(200, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64), dim=1)
SURFACE = 0.5 + 0.2 * DIRECTIONS
FACES = torch.tensor([[0, 1, 2]])


def moved(points, matrix, shift):
    return (points - 0.5) @ matrix.T + shift


@pytest.mark.parametrize("kind", ["rigid", "affine"])
def test_rigid_and_affine_motion_is_followed_exactly(kind):
    x = BODY.x.double()
    skin = bind_skin(SURFACE, FACES, x)
    matrix = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)))[0]
    if kind == "affine":
        matrix = matrix @ torch.tensor([[1.4, 0.3, 0.0], [0.0, 0.6, 0.2], [0.1, 0.0, 1.1]], dtype=torch.float64)
    shift = torch.tensor([3.0, -1.0, 0.5], dtype=torch.float64)
    at = skin.vertices_at(torch.stack([x, moved(x, matrix, shift)]))
    assert (at[0] - SURFACE).abs().max() < 1e-12
    assert (at[1] - moved(SURFACE, matrix, shift)).abs().max() < 1e-11


def test_weights_sum_to_one_and_magnify_little():
    skin = bind_skin(SURFACE, FACES, BODY.x)
    assert (skin.weights.sum(1) - 1).abs().max() < 1e-12
    assert skin.weights.square().sum(1).sqrt().max() < 1.5  # by how much a noise of the particles is magnified


def test_gradient_reaches_the_particles():
    x = BODY.x.double()[None].clone().requires_grad_()
    bind_skin(SURFACE, FACES, BODY.x).vertices_at(x).sum().backward()
    assert x.grad.sum() == pytest.approx(3 * len(SURFACE))  # each vertex moves with the whole


@pytest.mark.parametrize("particles", [torch.zeros(1, 3), torch.rand(40, 3) * torch.tensor([1.0, 0.0, 1.0]), torch.zeros(30, 3)])
def test_flat_bodies_carry_a_skin_too(particles):
    skin = bind_skin(SURFACE, FACES, particles)
    at = skin.vertices_at(torch.stack([particles.double(), particles.double() + 2.0]))
    assert torch.isfinite(at).all()
    assert (at[1] - at[0] - 2.0).abs().max() < 1e-9


def test_wrong_shapes_are_refused():
    with pytest.raises(UserError, match="vertices"):
        bind_skin(SURFACE[:, :2], FACES, BODY.x)
