"""Slow reference of the splatting kernels in plain torch: all pixels times all Gaussians, any float type, differentiable by autograd."""

import torch
from torch import Tensor

from neuido.models.render.compose_kernels import OPAQUE, STOP
from neuido.models.render.splat_kernels import CUT


def project(means: Tensor, covariances: Tensor, viewmat: Tensor, K: Tensor, width: int, height: int, eps2d: float):
    """Project Gaussians into the image of one camera.

    Returns:
        Centre [pixels] (N, 2), covariance [pixels^2] (N, 2, 2) including `eps2d`, depth [m] (N,). The Jacobian uses x/z and y/z
        clamped to 1.3 times the image (gsplat).
    """
    R, t = viewmat[:3, :3], viewmat[:3, 3]
    p = means @ R.T + t
    x, y, z = p.unbind(-1)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    u = torch.clamp(x / z, min=-(cx + 0.15 * width) / fx, max=(1.15 * width - cx) / fx)
    v = torch.clamp(y / z, min=-(cy + 0.15 * height) / fy, max=(1.15 * height - cy) / fy)
    none = torch.zeros_like(z)
    J = torch.stack([fx / z, none, -fx * u / z, none, fy / z, -fy * v / z], -1).unflatten(-1, (2, 3)) @ R
    S = (covariances + covariances.mT) / 2
    spread = J @ S @ J.mT + eps2d * torch.eye(2, dtype=means.dtype, device=means.device)
    return torch.stack([fx * x / z + cx, fy * y / z + cy], -1), spread, z


def compose(centre: Tensor, spread: Tensor, depth: Tensor, opacities: Tensor, colours: Tensor, width: int, height: int):
    """Blend Gaussians front to back; return colours (H, W, 3) and alphas (H, W)."""
    order = depth.argsort(stable=True)
    centre, conic, opacities, colours = centre[order], torch.linalg.inv(spread[order]), opacities[order], colours[order]
    like = {"dtype": centre.dtype, "device": centre.device}
    lines = []
    for line in range(height):  # row by row, to bound the memory
        pixels = torch.stack(torch.broadcast_tensors(torch.arange(width, **like) + 0.5, torch.tensor(line + 0.5, **like)), -1)
        d = centre - pixels[:, None]
        density = torch.exp(-0.5 * torch.einsum("wni,nij,wnj->wn", d, conic, d))
        alpha = opacities * density
        alpha = torch.where(alpha >= CUT, alpha.clamp(max=OPAQUE), torch.zeros_like(alpha))
        reached = torch.cumprod(1 - alpha, -1).detach() > STOP
        clear = torch.cumprod(torch.where(reached, 1 - alpha, torch.ones_like(alpha)), -1)
        before = torch.cat([torch.ones_like(clear[:, :1]), clear[:, :-1]], -1)
        lines.append(torch.cat([(alpha * before * reached) @ colours, 1 - clear[:, -1:]], -1))
    image = torch.stack(lines)
    return image[..., :3], image[..., 3]


def rasterize(means, covariances, opacities, colours, viewmats, Ks, width, height, near, far, eps2d) -> tuple[Tensor, Tensor]:
    """Return images (F, V, H, W, 3) and alphas (F, V, H, W); the arguments have the shapes of `splatting._Splat`."""
    images, alphas = [], []
    for f in range(len(means)):
        for v in range(len(viewmats)):
            depth = (means[f].detach() @ viewmats[v, :3, :3].T + viewmats[v, :3, 3])[:, 2]
            drawn = (depth >= near) & (depth <= far) & (opacities[f % len(opacities)] >= CUT)
            if not drawn.any():
                images.append(means.new_zeros(height, width, 3))
                alphas.append(means.new_zeros(height, width))
                continue
            centre, spread, depth = project(means[f, drawn], covariances[f, drawn], viewmats[v], Ks[v], width, height, eps2d)
            tint = colours[f % len(colours), v % colours.shape[1], drawn]
            image, alpha = compose(centre, spread, depth, opacities[f % len(opacities), drawn], tint, width, height)
            images.append(image)
            alphas.append(alpha)
    shape = (len(means), len(viewmats))
    return torch.stack(images).unflatten(0, shape), torch.stack(alphas).unflatten(0, shape)
