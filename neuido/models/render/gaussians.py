"""Gaussians of a body: spherical harmonics, 3DGS PLY files, and deformation with the particles."""

from os import PathLike
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np
import torch
from torch import Tensor

from neuido.data.files.writing import atomic_write
from neuido.data.formats.gaussian_ply import column_names, read_gaussian_vertices
from neuido.data.formats.ply import ply_bytes
from neuido.errors import UserError
from neuido.models.render.deformation import Average, Congruence
from neuido.physics.linalg.decompositions import polar
from neuido.physics.runtime.device import as_device
from neuido.types import Gaussians

C0 = 0.28209479177387814
"""Constant spherical harmonic, 1 / sqrt(4 pi)."""

REACH = 7.815
"""Squared Mahalanobis distance within which a Gaussian holds 95 % of its mass (chi squared, three degrees of freedom; NeuMA)."""


def degree_of(harmonics: Tensor) -> int:
    """Return the degree of spherical harmonics (N, K, 3)."""
    degree = {1: 0, 4: 1, 9: 2, 16: 3}.get(harmonics.shape[-2])
    if degree is None:
        raise UserError(f"harmonics have {harmonics.shape[-2]} coefficients; needed 1, 4, 9 or 16")
    return degree


def harmonic_basis(directions: Tensor, degree: int) -> Tensor:
    """Evaluate real spherical harmonics with the signs of 3DGS: unit vectors (..., 3) -> (..., (degree + 1)^2)."""
    if degree not in (0, 1, 2, 3):
        raise UserError(f"sh_degree is {degree}; needed 0 to 3")
    x, y, z = directions.unbind(-1)
    basis = [torch.full_like(x, C0)]
    if degree > 0:
        c = 0.4886025119029199
        basis += [-c * y, c * z, -c * x]
    xx, yy, zz = x * x, y * y, z * z
    if degree > 1:
        c = 1.0925484305920792
        basis += [c * x * y, -c * y * z, 0.31539156525252005 * (2 * zz - xx - yy), -c * x * z, c / 2 * (xx - yy)]
    if degree > 2:
        a, b = 0.5900435899266435, 0.4570457994644658
        basis += [-a * y * (3 * xx - yy), 2.890611442640554 * x * y * z, -b * y * (4 * zz - xx - yy)]
        basis += [0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy), -b * x * (4 * zz - xx - yy)]
        basis += [1.445305721320277 * z * (xx - yy), -a * x * (xx - 3 * yy)]
    return torch.stack(basis, -1)


def colours_of(harmonics: Tensor, directions: Tensor | None, *, degree: int) -> Tensor:
    """Evaluate the RGB of Gaussians seen from a direction, max(0, 1/2 + harmonics).

    Args:
        harmonics: Coefficients (N, K, 3), of which the first (degree + 1)^2 are used.
        directions: Vectors from the camera to the Gaussian, of any length, (..., N, 3); not needed for degree 0.
        degree: Degree, 0 to 3.

    Returns:
        RGB (..., N, 3), or (N, 3) for degree 0.
    """
    used = (degree + 1) ** 2
    if harmonics.shape[-2] < used:
        raise UserError(f"sh_degree {degree} needs {used} coefficients; the harmonics have {harmonics.shape[-2]}")
    if degree == 0:
        return (0.5 + C0 * harmonics[..., 0, :]).clamp(min=0)
    basis = harmonic_basis(torch.nn.functional.normalize(directions, dim=-1), degree)
    return (0.5 + torch.einsum("...nk,nkc->...nc", basis, harmonics[..., :used, :])).clamp(min=0)


def harmonics_of(colours: Tensor) -> Tensor:
    """Return spherical harmonics of degree 0, (N, 1, 3), that give the RGB (N, 3)."""
    return ((colours - 0.5) / C0).unsqueeze(-2)


def attach_gaussians(x: Tensor, volume: Tensor, colours: Tensor | None = None, *, spread: float = 0.3, opacity: float = 0.95) -> Gaussians:
    """Attach one Gaussian to each particle of a body.

    Args:
        x: Particle positions [m], (P, 3).
        volume: Particle volumes [m^3], (P,).
        colours: RGB, (P, 3); black where absent.
        spread: Standard deviation relative to the cube root of the mean volume. With 0.3 a body that is several particles thick shows no
            holes, and its silhouette lies 0.15 of that length outside its surface.
        opacity: Opacity of each Gaussian.
    """
    side = float(volume.mean()) ** (1 / 3)
    covariances = ((spread * side) ** 2 * torch.eye(3).to(x)).expand(len(x), 3, 3).contiguous()
    colours = torch.zeros_like(x) if colours is None else colours
    return Gaussians(x, covariances, torch.full_like(x[:, 0], opacity), harmonics_of(colours))


class Binding(NamedTuple):
    """Particles that carry each Gaussian, and their weights."""

    index: Tensor
    """Indices of the particles, (N, k) int64."""
    weight: Tensor
    """Weights of the particles, which sum to one, (N, k); zero for unused entries."""
    rest: Tensor
    """Weighted mean of the particle positions at t = 0 [m], (N, 3)."""

    def average(self, values: Tensor) -> Tensor:
        """Return the weighted mean over the particles of each Gaussian, (..., P, m) -> (..., N, m)."""
        return cast(Tensor, Average.apply(values, self.index.to(values.device), self.weight.to(values)))


def bind(gaussians: Gaussians, x: Tensor, *, nearest: int = 10, reach: float = REACH) -> Binding:
    """Bind each Gaussian to particles, with uniform weights (NeuMA).

    A Gaussian is bound to at most `nearest` particles within its 95 % ellipsoid, or to the nearest particle if there is none.

    Args:
        gaussians: Gaussians at t = 0.
        x: Particle positions at t = 0 [m], (P, 3).
        nearest: Maximum number of particles of a Gaussian.
        reach: Maximum squared Mahalanobis distance [-].
    """
    from scipy.spatial import KDTree

    means, covariances = gaussians.means.detach().double().cpu(), gaussians.covariances.detach().double().cpu()
    points = x.detach().double().cpu()
    many = min(4 * nearest, len(points))
    _, index = KDTree(points.numpy()).query(means.numpy(), k=many, workers=-1)
    index = torch.as_tensor(np.asarray(index).reshape(len(means), many))
    d = points[index] - means[:, None]
    small = 1e-12 * covariances.diagonal(dim1=-2, dim2=-1).sum(-1).clamp(min=1e-30)
    conic = torch.linalg.inv(covariances + small[:, None, None] * torch.eye(3, dtype=torch.float64))
    distance = torch.einsum("nki,nij,nkj->nk", d, conic, d)
    distance, order = distance.sort(1)
    chosen, inside = index.gather(1, order)[:, :nearest].clone(), distance[:, :nearest] <= reach
    outside = ~inside.any(1)
    chosen[outside, 0], inside[outside, 0] = index[outside, 0], True
    weight = inside.double() / inside.sum(1, keepdim=True)
    rest = (points[chosen] * weight[..., None]).sum(1)
    like = gaussians.means
    return Binding(chosen.to(like.device), weight.to(like), rest.to(like))


def deform(gaussians: Gaussians, F: Tensor, x: Tensor, binding: Binding | None = None) -> Gaussians:
    """Deform Gaussians with particles: means follow x, covariances A become F A F^T, harmonics rotate with the polar part R of F.

    The result is differentiable in F and x through means, covariances and viewing directions. As in PhysGaussian, the viewing direction is
    rotated by R^T in place of the harmonics.

    Args:
        gaussians: Gaussians at t = 0.
        F: Deformation gradients of the particles [-], (..., P, 3, 3).
        x: Particle positions [m], (..., P, 3).
        binding: Result of `bind`; where absent, Gaussian i is particle i.
    """
    if binding is None:
        if F.shape[-3] != len(gaussians.means):
            raise UserError(f"{F.shape[-3]} particles carry {len(gaussians.means)} Gaussians; give a binding")
        means, G = x, F
    else:
        means = gaussians.means + binding.average(x) - binding.rest
        G = binding.average(F.flatten(-2)).unflatten(-1, (3, 3))
    rotations = None
    if degree_of(gaussians.harmonics) > 0:
        rotations = polar(G)[0]
        if gaussians.rotations is not None:
            rotations = rotations @ gaussians.rotations
    covariances = cast(Tensor, Congruence.apply(G, gaussians.covariances.to(G)))
    return gaussians._replace(means=means, covariances=covariances, rotations=rotations)


def covariances_of(scales: Tensor, quaternions: Tensor) -> Tensor:
    """Return covariances R diag(s^2) R^T [m^2] (..., 3, 3) for standard deviations [m] (..., 3) and quaternions wxyz (..., 4), any norm."""
    w, x, y, z = torch.nn.functional.normalize(quaternions, dim=-1).unbind(-1)
    entries = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]
    entries += [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]
    entries += [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    M = torch.stack(entries, -1).unflatten(-1, (3, 3)) * scales.unsqueeze(-2)
    return M @ M.mT


def scales_and_quaternions(covariances: Tensor) -> tuple[Tensor, Tensor]:
    """Invert `covariances_of`: return standard deviations (N, 3), smallest first, and unit quaternions (N, 4)."""
    from scipy.spatial.transform import Rotation

    values, vectors = torch.linalg.eigh(covariances.detach().double().cpu())
    vectors = vectors * torch.linalg.det(vectors).sign()[..., None, None]
    quaternions = torch.from_numpy(Rotation.from_matrix(vectors.numpy()).as_quat())[:, [3, 0, 1, 2]]
    return values.clamp(min=0).sqrt().to(covariances), quaternions.to(covariances)


def save_gaussians(path: str | PathLike, gaussians: Gaussians) -> None:
    """Write a 3DGS PLY file (`point_cloud.ply`): logit opacities, log scales, quaternions wxyz, and harmonics by channel.

    Raises:
        UserError: There are several frames, or rotations relative to the harmonics, neither of which the format can hold.
    """
    if gaussians.means.dim() != 2:
        raise UserError(f"means have shape {tuple(gaussians.means.shape)}; a PLY file holds one frame, (N, 3)")
    if gaussians.rotations is not None and degree_of(gaussians.harmonics) > 0:
        raise UserError("a PLY file cannot hold rotated harmonics; save degree 0, harmonics[:, :1]")
    scales, quaternions = scales_and_quaternions(gaussians.covariances)
    opacities = gaussians.opacities.detach().double().clamp(1e-7, 1 - 1e-7).logit()
    base, rest = gaussians.harmonics[:, 0], gaussians.harmonics[:, 1:].mT.flatten(1)
    shape = [opacities[:, None], scales.clamp(min=1e-12).log(), quaternions]
    columns = [gaussians.means, torch.zeros_like(gaussians.means), base, rest, *shape]
    table = torch.cat([c.detach().double().cpu() for c in columns], 1).numpy().astype(np.float32)
    vertices = np.rec.fromarrays(table.T, names=column_names(rest.shape[1]))
    with atomic_write(path) as hidden:
        hidden.write_bytes(ply_bytes(vertices))


def load_gaussians(path: str | PathLike, *, dtype: torch.dtype = torch.float32, device: str | torch.device = "auto") -> Gaussians:
    """Read a 3DGS PLY file; rows that are not finite are skipped with a warning.

    Args:
        path: The file.
        dtype: Type of the tensors.
        device: `auto` (CUDA where available), `cpu`, `cuda`, or a torch device.

    Raises:
        UserError: The file is missing, is not a PLY file, or its vertices lack properties of a Gaussian.
    """
    vertices = read_gaussian_vertices(Path(path))
    rest = sum(name.startswith("f_rest_") for name in vertices.dtype.names or ())

    def columns(*names: str) -> Tensor:
        return torch.from_numpy(np.stack([vertices[name].astype(np.float64) for name in names], 1))

    harmonics = columns("f_dc_0", "f_dc_1", "f_dc_2").unsqueeze(1)
    if rest:
        harmonics = torch.cat([harmonics, columns(*(f"f_rest_{i}" for i in range(rest))).unflatten(1, (3, rest // 3)).mT], 1)
    quaternions = columns("rot_0", "rot_1", "rot_2", "rot_3")
    covariances = covariances_of(columns("scale_0", "scale_1", "scale_2").exp(), quaternions)
    parts = (columns("x", "y", "z"), covariances, columns("opacity").squeeze(1).sigmoid(), harmonics)
    chosen = as_device(device)
    return Gaussians(*(part.to(chosen, dtype) for part in parts))
