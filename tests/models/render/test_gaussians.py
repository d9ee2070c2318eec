"""Harmonics, PLY files, and Gaussians that move with particles."""

import math

import numpy as np
import pytest
import torch

from neuido.errors import UserError
from neuido.models.render.gaussians import (
    Binding,
    bind,
    colours_of,
    covariances_of,
    deform,
    degree_of,
    harmonic_basis,
    harmonics_of,
    load_gaussians,
    save_gaussians,
    scales_and_quaternions,
)
from neuido.types import Gaussians
from tests.data.formats.ply_samples import write_ply


def gaussians(count=7, degree=3, seed=0):
    g = torch.Generator().manual_seed(seed)
    A = 0.1 * torch.randn(count, 3, 3, generator=g, dtype=torch.float64)
    parts = [torch.randn(count, 3, generator=g, dtype=torch.float64), A @ A.mT, torch.rand(count, generator=g, dtype=torch.float64)]
    return Gaussians(*parts, 0.3 * torch.randn(count, (degree + 1) ** 2, 3, generator=g, dtype=torch.float64))


def rotation(axis, angle):
    x, y, z = torch.nn.functional.normalize(torch.tensor(axis, dtype=torch.float64), dim=0).tolist()
    K = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    return torch.matrix_exp(angle * K)


def test_harmonics_are_orthonormal_on_the_sphere():
    """Exact quadrature: Gauss-Legendre in the height, equal angles around."""
    height, weight = (torch.from_numpy(t) for t in np.polynomial.legendre.leggauss(8))
    angle = torch.arange(16, dtype=torch.float64) * (2 * math.pi / 16)
    ring = (1 - height**2).sqrt()[:, None]
    directions = torch.stack([ring * angle.cos(), ring * angle.sin(), height[:, None].expand(8, 16)], -1)
    basis = harmonic_basis(directions, 3).flatten(0, 1)
    gram = basis.mT @ (basis * (weight.repeat_interleave(16) * 2 * math.pi / 16)[:, None])
    assert torch.allclose(gram, torch.eye(16, dtype=torch.float64), atol=1e-12)


def test_harmonics_have_the_signs_of_3dgs():
    """Degree 1 is (-y, z, -x); of the higher ones the first non-zero values at chosen directions."""
    at = torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [3**-0.5] * 3])
    basis = harmonic_basis(at, 3)
    c = 0.4886025
    assert basis[:3, 1:4].tolist() == [pytest.approx(row, abs=1e-6) for row in ([0, 0, -c], [-c, 0, 0], [0, c, 0])]
    assert basis[3, 4:8].sign().tolist() == [1, -1, 0, -1]
    assert basis[3, [9, 10, 11, 13, 15]].sign().tolist() == [-1, 1, -1, -1, 1]
    assert basis[2, [6, 12]].tolist() == pytest.approx([0.6307831, 0.7463527], abs=1e-6)


def test_colours_are_shifted_and_not_negative():
    rgb = torch.tensor([[0.0, 0.25, 1.0], [0.5, 0.9, 0.1]])
    assert torch.allclose(colours_of(harmonics_of(rgb), None, degree=0), rgb, atol=1e-6)
    assert (colours_of(harmonics_of(rgb - 1), None, degree=0) == (rgb - 1).clamp(min=0)).all()
    padded = torch.cat([harmonics_of(rgb), torch.zeros(2, 15, 3)], 1)
    assert torch.allclose(colours_of(padded, torch.tensor([[0.3, 4.0, 1.0], [1.0, 0.0, 0.0]]), degree=3), rgb, atol=1e-6)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_ply_round_trip(degree, tmp_path):
    before = gaussians(degree=degree)
    save_gaussians(tmp_path / "a.ply", before)
    after = load_gaussians(tmp_path / "a.ply", dtype=torch.float64, device="cpu")
    assert degree_of(after.harmonics) == degree
    for name in ("means", "covariances", "opacities", "harmonics"):
        a, b = getattr(after, name), getattr(before, name)
        assert torch.allclose(a, b, rtol=1e-5, atol=1e-6), f"{name}: {(a - b).abs().max():.1e}"


def test_ply_is_read_as_3dgs_writes_it(tmp_path):
    """One vertex by hand: logit, log, quaternion w first and not normalised, harmonics channel by channel."""
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(9)), "opacity"]
    names += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    values = [1, 2, 3, 0, 0, 0, 0.1, 0.2, 0.3, 11, 12, 13, 21, 22, 23, 31, 32, 33, math.log(3.0), *np.log([0.1, 0.2, 0.4]), 2, 0, 0, 2]
    write_ply(tmp_path / "b.ply", np.array([tuple(values)], [(n, "f4") for n in names]))
    read = load_gaussians(tmp_path / "b.ply", device="cpu")
    assert read.means.tolist() == [[1, 2, 3]]
    assert read.opacities.item() == pytest.approx(0.75)
    assert torch.allclose(read.harmonics[0], torch.tensor([[0.1, 0.2, 0.3], [11, 21, 31], [12, 22, 32], [13, 23, 33]]))
    assert torch.allclose(read.covariances[0], torch.diag(torch.tensor([0.04, 0.01, 0.16])), atol=1e-7)  # a quarter turn about z


def test_ply_errors_name_the_file_and_what_it_lacks(tmp_path):
    with pytest.raises(UserError, match=r"the PLY file .*none\.ply is missing"):
        load_gaussians(tmp_path / "none.ply")
    (tmp_path / "text.ply").write_text("hello")
    with pytest.raises(UserError, match=r"text\.ply is not a PLY file"):
        load_gaussians(tmp_path / "text.ply")
    vertices = np.zeros(2, [("x", "f4"), ("y", "f4"), ("z", "f4")])
    write_ply(tmp_path / "points.ply", vertices)
    with pytest.raises(UserError, match="not a 3DGS file: its vertices lack the columns f_dc_0"):
        load_gaussians(tmp_path / "points.ply")
    with pytest.raises(UserError, match="holds one frame"):
        one = gaussians()
        save_gaussians(tmp_path / "c.ply", one._replace(means=one.means.expand(2, -1, -1)))
    with pytest.raises(UserError, match="cannot hold rotated harmonics"):
        save_gaussians(tmp_path / "c.ply", one._replace(rotations=torch.eye(3).expand(7, 3, 3)))


def test_scales_and_quaternions_rebuild_the_covariance():
    A = gaussians(50).covariances
    assert torch.allclose(covariances_of(*scales_and_quaternions(A)), A, atol=1e-14)
    flat = torch.diag(torch.tensor([0.0, 1.0, 1.0]))[None]
    assert torch.allclose(covariances_of(*scales_and_quaternions(flat)), flat, atol=1e-6)


def test_deform_of_a_rigid_motion_shows_the_same_colours_from_the_turned_direction():
    body, Q, shift = gaussians(), rotation([1.0, 2.0, -1.0], 1.1), torch.tensor([0.3, 0.1, -2.0], dtype=torch.float64)
    moved = deform(body, Q.expand(7, 3, 3), body.means @ Q.T + shift)
    assert torch.allclose(moved.covariances, Q @ body.covariances @ Q.T)
    eye = torch.tensor([0.5, 4.0, 1.0], dtype=torch.float64)
    before = colours_of(body.harmonics, body.means - eye, degree=3)
    directions = moved.means - (Q @ eye + shift)
    turned = (moved.rotations.mT @ directions[..., None])[..., 0]
    assert torch.allclose(colours_of(moved.harmonics, turned, degree=3), before, atol=1e-12)


def test_deform_takes_the_first_covariance_and_the_polar_part():
    body = gaussians(3)
    S = torch.diag(torch.tensor([1.5, 0.7, 1.0], dtype=torch.float64))
    Q = rotation([0.0, 0.0, 1.0], 0.5)
    F = torch.stack([torch.eye(3, dtype=torch.float64), S, Q @ S])[:, None].expand(3, 3, 3, 3)
    moved = deform(body, F, body.means.expand(3, 3, 3))
    assert torch.allclose(moved.covariances[2], Q @ S @ body.covariances @ S @ Q.T)
    assert torch.allclose(moved.rotations, torch.stack([torch.eye(3).double(), torch.eye(3).double(), Q])[:, None].expand(3, 3, 3, 3))
    assert deform(body._replace(harmonics=body.harmonics[:, :1]), F, body.means.expand(3, 3, 3)).rotations is None
    again = deform(body._replace(rotations=Q.expand(3, 3, 3)), F[2], body.means)
    assert torch.allclose(again.rotations, (Q @ Q).expand(3, 3, 3))


def test_gradients_reach_F_and_x_through_the_binding():
    body = gaussians(4)
    g = torch.Generator().manual_seed(5)
    x = torch.randn(6, 3, generator=g, dtype=torch.float64)
    binding = Binding(torch.tensor([[0, 1], [1, 2], [3, 3], [4, 5]]), torch.tensor([[0.5, 0.5], [0.25, 0.75], [1, 0], [0.5, 0.5]]), x[:4])
    F = (torch.eye(3, dtype=torch.float64) + 0.2 * torch.randn(2, 6, 3, 3, generator=g, dtype=torch.float64)).requires_grad_()
    y = (x + 0.1 * torch.randn(2, 6, 3, generator=g, dtype=torch.float64)).requires_grad_()

    def parts(F, y, means, covariances):
        moved = deform(body._replace(means=means, covariances=covariances), F, y, binding)
        return moved.means, moved.covariances, moved.rotations

    own = [t.detach().clone().requires_grad_() for t in (body.means, body.covariances)]
    assert torch.autograd.gradcheck(parts, (F, y, *own))
    moved = deform(body, F, y, binding)
    G = 0.25 * F[1, 1] + 0.75 * F[1, 2]
    assert torch.allclose(moved.covariances[1, 1], G @ body.covariances[1] @ G.T)
    assert torch.allclose(moved.means[1, 1], body.means[1] + 0.25 * y[1, 1] + 0.75 * y[1, 2] - x[1])


def test_bind_takes_particles_in_the_ellipsoid_or_the_nearest_one():
    body = Gaussians(
        torch.tensor([[0.0, 0, 0], [5.0, 0, 0]]),
        torch.stack([torch.diag(torch.tensor([1.0, 0.01, 0.01])), 1e-6 * torch.eye(3)]),
        torch.ones(2),
        torch.zeros(2, 1, 3),
    )
    x = torch.tensor([[2.0, 0, 0], [0, 0.5, 0], [0, 0.2, 0], [-1.0, 0.1, 0], [4.0, 0, 0], [5.2, 0, 0]])
    binding = bind(body, x)
    carried = [{int(i) for i, w in zip(index, weight) if w > 0} for index, weight in zip(*binding[:2])]
    assert carried == [{0, 2, 3}, {5}]
    assert torch.allclose(binding.weight.sum(1), torch.ones(2))
    assert torch.allclose(binding.rest[0], x[[0, 2, 3]].mean(0))
    few = bind(body, x, nearest=1)
    assert few.index[:, 0].tolist() == [3, 5] or few.index[:, 0].tolist() == [2, 5]
    still = deform(body, torch.eye(3).expand(6, 3, 3), x, binding)
    assert torch.allclose(still.means, body.means)
    assert torch.allclose(still.covariances, body.covariances)


def test_without_a_binding_the_counts_must_agree():
    with pytest.raises(UserError, match="6 particles carry 7 Gaussians"):
        deform(gaussians(), torch.eye(3).expand(6, 3, 3), torch.zeros(6, 3))
