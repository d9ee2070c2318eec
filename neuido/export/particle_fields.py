"""Quantities of the particles that are written beside their positions: volume ratio, strain, stress."""

from collections.abc import Sequence

import numpy as np
import torch

from neuido.errors import UserError
from neuido.export.exchange import Exchange, Field
from neuido.physics.laws.base import ElasticLaw
from neuido.physics.linalg import frame_kernels
from neuido.physics.runtime.device import launch, real_of
from neuido.types import Particles

CHUNK = 1 << 18
"""Deformation gradients in one call of a kernel; bounds the memory."""
SMALLEST = 1e-6
"""Lower bound of a principal stretch in its logarithm, and of det F as a divisor [-]."""


def add_fields(made: Exchange, laws: Sequence[ElasticLaw] = ()) -> None:
    """Add the fields that F allows: `volume_ratio`, `strain` and, with laws, `stress`.

    `volume_ratio` is det F [-]. `strain` is the equivalent Hencky strain sqrt(2/3 dev ln V : dev ln V) of the elastic F [-]. `stress` is
    von Mises' equivalent of the Cauchy stress, sqrt(3/2 dev sigma : dev sigma) [Pa].

    Args:
        made: The motion; without F, nothing is added.
        laws: Elastic law of all bodies, or of each in their order; none: no stress.

    Raises:
        UserError: There is a law and no F, a body without a law, or a law that does not take these F.
    """
    if made.F is None:
        if laws:
            raise UserError("the motion has no deformation gradient F, of which the law could give the stress: leave out the law")
        return
    body = made.fields["body"].values if len(laws) > 1 and "body" in made.fields else np.zeros(made.x.shape[1], np.int32)
    if len(laws) > 1 and int(body.max()) != len(laws) - 1:
        raise UserError(f"law has {len(laws)} laws for the {int(body.max()) + 1} bodies of the motion: give one of all, or one of each")
    shape = made.F.shape[:2]
    names = {"volume_ratio": "1", "strain": "1"} | ({"stress": "Pa"} if laws else {})
    values = {name: np.empty(shape, np.float32) for name in names}
    for number in range(max(1, len(laws))):
        own = np.flatnonzero(body == number)
        for frame in range(shape[0]):
            for begin in range(0, len(own), CHUNK):
                part = own[begin : begin + CHUNK]
                found = _fields(torch.from_numpy(made.F[frame, part]).double().contiguous(), laws[number] if laws else None)
                for name in names:
                    values[name][frame, part] = found[name].numpy()
    for name, unit in names.items():
        made.fields[name] = Field(values[name], unit)


def _fields(F: torch.Tensor, law: ElasticLaw | None) -> dict[str, torch.Tensor]:
    """Return the fields of F (n, 3, 3), (n,) each."""
    stretches = _stretches(F)
    J = stretches.prod(-1)
    strain = stretches.clamp(min=SMALLEST).log()
    out = {"volume_ratio": J, "strain": (2 / 3 * (strain - strain.mean(-1, keepdim=True)).square().sum(-1)).sqrt()}
    if law is not None:
        sigma = _kirchhoff(law, F) / J.abs().clamp(min=SMALLEST)[:, None, None]
        mean = sigma.diagonal(dim1=-2, dim2=-1).mean(-1)
        out["stress"] = (1.5 * (sigma.square().sum((-2, -1)) - 3 * mean.square()).clamp(min=0)).sqrt()
    return out


def _stretches(F: torch.Tensor) -> torch.Tensor:
    """Return the principal stretches of F (n, 3, 3), the last with the sign of det F, (n, 3)."""
    U, V, sigma = torch.empty_like(F), torch.empty_like(F), F.new_empty(len(F), 3)
    launch(frame_kernels.build(real_of(F.dtype)).decompose, len(F), [F, U, sigma, V], F.device)
    return sigma


def _kirchhoff(law: ElasticLaw, F: torch.Tensor) -> torch.Tensor:
    """Return the Kirchhoff stress of a law [Pa], (n, 3, 3)."""
    out = torch.empty_like(F)
    tensors = [tensor.detach().to(F) for tensor in law.tensors()]
    if any(len(tensor) > 1 for tensor in tensors):
        raise UserError(f"law = {type(law).__name__} is of {max(map(len, tensors))} scenes; the stress needs the law of one")
    law.forward(tensors, F, out, Particles(torch.zeros(len(F), dtype=torch.int32), (0, len(F))))
    return out
