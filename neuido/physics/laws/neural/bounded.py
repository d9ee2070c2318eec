"""The bounded elastic law, whose stress cannot have the wrong sign, and the full return map, which may correct every principal strain.

`bounded_kernels` and `return_kernels` have the formulas, and the kernels where those of `fused` do not run; `bounded_stress` and
`full_return_map` are the same in plain torch.
"""

from typing import Self

import torch
from torch import Tensor

from neuido.physics.laws.neural import bounded_kernels, fused, return_kernels
from neuido.physics.laws.neural.bounded_kernels import EXPONENT, RANGE, SHORTEST, SPREAD, T1, VOLUME_FLOOR
from neuido.physics.laws.neural.networks import (
    STRAIN_SCALE,
    STRESS_SCALE,
    ObjectiveElastic,
    ObjectivePlastic,
    hencky_strain,
    strain_features,
    taken_back,
)
from neuido.physics.laws.neural.return_kernels import CRUSH, ROOT, SKEW
from neuido.physics.runtime.device import real_of


def kernels(like: Tensor):
    """Return the kernels of `bounded_kernels` for the scalar type of a tensor."""
    return bounded_kernels.build(real_of(like.dtype))


def bounded_features(F: Tensor) -> Tensor:
    """Compute the features of `strain_features`, of a strain that is shortened to the norm `RANGE`.

    Args:
        F: Deformation gradient [-], (..., 3, 3).

    Returns:
        Features, (..., 9).
    """
    l, A, q = hencky_strain(F)
    s = (RANGE / (l * l + q * q).sqrt()).clamp(max=1.0)
    return strain_features(s * l, s[..., None, None] * A, s * q)


def bounded_stress(F: Tensor, c: Tensor, scale: float = STRESS_SCALE) -> Tensor:
    """Compute the Kirchhoff stress [Pa], (..., 3, 3), of a bounded network from its outputs.

    Args:
        F: Deformation gradient [-], (..., 3, 3).
        c: Outputs of the network, (..., 4); the formula is in `bounded_kernels`.
        scale: Unit of the moduli [Pa].
    """
    l, A, q = hencky_strain(F)
    eye = torch.eye(3, dtype=F.dtype, device=F.device)
    lam, d = scale * c[..., :2].clamp(-EXPONENT, EXPONENT).exp().movedim(-1, 0)
    root = (1 + c[..., 2:].square()).sqrt().sum(-1)
    p, r = (SPREAD * c[..., 2:] / root[..., None]).movedim(-1, 0)

    H = A + l[..., None, None] / 3 * eye
    A2 = A @ A
    T2 = 3 * (A2 - A2.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None] * eye) / q.square()[..., None, None]
    M = eye + p[..., None, None] * T1 * A / q[..., None, None] + r[..., None, None] * T2
    K = torch.stack([torch.linalg.cross(F[..., i, :], F[..., j, :]) for i, j in ((1, 2), (2, 0), (0, 1))], -2)
    J = (K[..., 0, :] * F[..., 0, :]).sum(-1)
    log = torch.where(J > 0.5, volume_change(F).clamp(min=-0.5).log1p(), J.clamp(min=VOLUME_FLOOR).log())
    upright = d[..., None, None] * (M @ H) + (lam * log)[..., None, None] * eye

    C = K @ K.mT / K.square().sum((-2, -1)).clamp(min=SHORTEST)[..., None, None]
    turned = d[..., None, None] * C + (lam * (-J).clamp(min=0.0).log1p())[..., None, None] * eye
    inverted = J < 0
    return torch.where(inverted[..., None, None], turned, upright)


def volume_change(F: Tensor) -> Tensor:
    """Return det F - 1 [-], (...), without loss of digits near F = I.

    Args:
        F: Deformation gradient [-], (..., 3, 3).
    """
    G = F - torch.eye(3, dtype=F.dtype, device=F.device)
    trace = G.diagonal(dim1=-2, dim2=-1).sum(-1)
    minors = 0.5 * (trace.square() - (G @ G).diagonal(dim1=-2, dim2=-1).sum(-1))
    a, b, c = G.unbind(-2)
    return trace + minors + (torch.linalg.cross(a, b) * c).sum(-1)


class BoundedElastic(ObjectiveElastic):
    """An isotropic elastic law that resists every deformation, from a network of the strain's invariants.

    Frame-indifferent, free of stress at F = I, compressive under compression and tensile under tension at any strain, and it turns inverted
    matter back, for any weights.
    """

    strain_limit = RANGE
    readout = fused.BOUNDED
    kernels = staticmethod(kernels)
    features_of = staticmethod(bounded_features)
    stress_of = staticmethod(bounded_stress)

    def scaled(self, factor: Tensor) -> Self:
        """Return this law with its stress times a factor per scene (S,); exact, because both moduli are exponentials of outputs."""
        *hidden, W3, b3 = self.weights
        shift = torch.zeros(len(factor), self.outputs, dtype=b3.dtype, device=b3.device)
        shift[:, :2] = factor.to(b3).log()[:, None]
        return self._with(*hidden, W3.expand(len(factor), -1, -1), b3 + shift)


def return_kernels_of(like: Tensor):
    """Return the kernels of `return_kernels` for the scalar type of a tensor."""
    return return_kernels.build(real_of(like.dtype))


def full_return_map(F: Tensor, c: Tensor, scale: float = STRAIN_SCALE) -> Tensor:
    """Compute the corrected deformation gradient, (..., 3, 3), of a full return map from the outputs of its network.

    Args:
        F: Trial deformation gradient [-], (..., 3, 3).
        c: Outputs of the network, (..., 4); the formula is in `return_kernels`.
        scale: Unit of the radii [-].
    """
    l, A, q = hencky_strain(F)
    f = (1 - (scale * c[..., 0] + c[..., 1] * (-l).clamp(min=0)) / q).clamp(0, 1)
    tension = torch.minimum((l - scale * c[..., 2]).clamp(min=0), l)
    compression = torch.where(c[..., 2] > 0, (l + CRUSH * scale * c[..., 2]).clamp(max=0), l)
    k = ROOT * SKEW * c[..., 3] / (1 + c[..., 3].square()).sqrt()
    D = (A @ A - A.square().sum((-2, -1))[..., None, None] / 3 * torch.eye(3, dtype=F.dtype, device=F.device)) / q[..., None, None]
    return taken_back(F, f[..., None, None] * (A + k[..., None, None] * D), torch.where(l > 0, tension, compression))


class FullPlastic(ObjectivePlastic):
    """A return map of any isotropic form, from a network of the strain's invariants (`return_kernels` has the formula).

    Besides what `ObjectivePlastic` does, it limits compression and may change each principal strain by itself, as snow needs.
    """

    outputs = return_kernels.COEFFICIENTS
    readout = fused.RETURN
    kernels = staticmethod(return_kernels_of)
    corrected_of = staticmethod(full_return_map)
