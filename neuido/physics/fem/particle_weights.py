"""Interpolation between the particles of a body and its mesh: elements that contain points, and weights of particles around places."""

import torch
from torch import Tensor

from neuido.physics.fem.meshing import Mesh


def locate(mesh: Mesh, points: Tensor, *, near: int = 24, chunk: int = 1024) -> tuple[Tensor, Tensor]:
    """Find the element that contains each point, and the barycentric weights of the point.

    Args:
        mesh: The mesh.
        points: Positions at t = 0 [m], (n, 3).
        near: Number of elements that are tried for each point, those with the nearest centroids.
        chunk: Number of points that are processed at a time.

    Returns:
        Elements, (n,), and weights, (n, 4). For a point outside the mesh, the weights extrapolate from a near element.
    """
    corners = mesh.nodes[mesh.elements]
    centroid, gradients = corners.mean(dim=1), mesh.gradients
    found, weights = [], []
    for part in points.to(mesh.nodes).split(chunk):
        index = torch.cdist(part, centroid).topk(min(near, len(centroid)), largest=False).indices
        last = torch.einsum("nkac,nkc->nka", gradients[index][:, :, 1:], part[:, None] - corners[index][:, :, 0])
        each = torch.cat([1.0 - last.sum(dim=-1, keepdim=True), last], dim=-1)
        best = each.amin(dim=-1).argmax(dim=1, keepdim=True)
        found.append(index.gather(1, best)[:, 0])
        weights.append(each.gather(1, best[..., None].expand(-1, 1, 4))[:, 0])
    return torch.cat(found), torch.cat(weights)


def interpolation_weights(
    x: Tensor, places: Tensor, *, near: int = 16, degree: int = 1, falloff: float = 3.0, chunk: int = 1024
) -> tuple[Tensor, Tensor]:
    """Compute weights that interpolate a field from particles to places.

    Args:
        x: Positions of the particles [m], (P, 3).
        places: Positions to interpolate to [m], (n, 3).
        near: Largest number k of particles for each place.
        degree: 1: exact for affine fields (moving least squares). 0: a mean with positive weights.
        falloff: The weight at distance d is exp(-falloff (d / s)^2), with s the distance of the k-th particle.
        chunk: Number of places that are processed at a time.

    Returns:
        Particles and weights, (n, k) each.
    """
    k = min(near, len(x))
    out = []
    for part in places.split(chunk):
        distance, index = torch.cdist(part, x).topk(k, largest=False)
        scale = distance[:, -1:].clamp(min=1e-12)
        kernel = torch.exp(-falloff * (distance / scale) ** 2)
        if degree == 0:
            out.append((index, kernel / kernel.sum(dim=1, keepdim=True)))
            continue
        arm = (x[index] - part[:, None]) / scale[..., None]
        basis = torch.cat([torch.ones_like(arm[..., :1]), arm], dim=-1)
        normal = torch.einsum("nk,nka,nkb->nab", kernel, basis, basis) + 1e-9 * torch.eye(4, dtype=x.dtype, device=x.device)
        first = torch.zeros(len(part), 4, 1, dtype=x.dtype, device=x.device)
        first[:, 0] = 1.0
        out.append((index, kernel * (basis @ torch.linalg.solve(normal, first))[..., 0]))
    return torch.cat([index for index, _ in out]), torch.cat([weight for _, weight in out])
