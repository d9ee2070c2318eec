"""Several laws in one scene: bodies of different materials in contact.

Each law runs on a copy of the F of its own particles, one law after the other. Such a rollout is not captured in a CUDA graph.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from neuido.errors import UserError
from neuido.physics.laws.base import ElasticLaw, Law, PlasticLaw
from neuido.types import Particles


class _Composite(Law):
    """Base class of laws that differ between the particles of one scene.

    Args:
        laws: B laws, each for one scene.
        body: Index of each particle's law, (P,) int64, in the order of the kernels (`Simulator.order`), as `by_body` sorts it.

    Raises:
        UserError: An index without a law.
    """

    def __init__(self, laws: Sequence[Law], body: Tensor):
        if not laws or int(body.min()) < 0 or int(body.max()) >= len(laws):
            raise UserError(f"body has indices {int(body.min())} to {int(body.max())} for {len(laws)} laws; give one law for each body")
        self.laws = tuple(laws)
        self.rows = [(body == b).nonzero()[:, 0] for b in range(len(laws))]
        self.counts = [len(law.tensors()) for law in laws]

    def tensors(self) -> tuple[Tensor, ...]:
        return tuple(t for law in self.laws for t in law.tensors())

    def _parts(self, tensors: Sequence):
        start = 0
        for law, rows, count in zip(self.laws, self.rows, self.counts):
            own = Particles(torch.zeros(len(rows), dtype=torch.int32, device=rows.device), (0, len(rows)))
            yield law, rows, own, tensors[start : start + count]
            start += count

    def forward(self, tensors: Sequence[Tensor], F: Tensor, out: Tensor, particles: Particles) -> None:
        for law, rows, own, part in self._parts(tensors):
            result = torch.empty_like(F[rows])
            if law.identity:
                result = F[rows]
            else:
                law.forward(part, F[rows].contiguous(), result, own)
            out[rows] = result

    def adjoint(
        self,
        tensors: Sequence[Tensor],
        F: Tensor,
        grad_out: Tensor,
        grad_F: Tensor,
        grad_tensors: Sequence[Tensor | None],
        particles: Particles,
    ) -> None:
        for (law, rows, own, part), (*_, grads) in zip(self._parts(tensors), self._parts(grad_tensors)):
            if law.identity:
                grad_F[rows] += grad_out[rows]
                continue
            own_grad = torch.zeros_like(F[rows])
            law.adjoint(part, F[rows].contiguous(), grad_out[rows].contiguous(), own_grad, grads, own)
            grad_F[rows] += own_grad

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(map(repr, self.laws))})"


class CompositeElastic(_Composite, ElasticLaw):
    """Elastic laws that differ between the particles of one scene; made by `by_body`."""

    def modulus(self) -> Tensor:
        """Return the largest P-wave modulus of the laws [Pa], (1,)."""
        return torch.stack([law.modulus().max().double() for law in self.laws]).max()[None]  # type: ignore[attr-defined]

    def __call__(self, F: Tensor, particles: Particles | None = None) -> Tensor:
        out = torch.zeros_like(F)
        for law, rows in zip(self.laws, self.rows):
            out = out.index_copy(0, rows, law(F[rows]))
        return out


class CompositePlastic(CompositeElastic, PlasticLaw):
    """Plastic laws that differ between the particles of one scene; made by `by_body`."""

    identity = False


def by_body(
    elasticity: Sequence[ElasticLaw], plasticity: Sequence[PlasticLaw], counts: Sequence[int], order: Tensor
) -> tuple[CompositeElastic, CompositePlastic]:
    """Combine the laws of several bodies whose particles were concatenated to one body.

    Args:
        elasticity: One elastic law for each body, of one scene.
        plasticity: One plastic law for each body, of one scene.
        counts: Number of particles of each body, in the order of concatenation.
        order: `Simulator.order` of the simulator that will run the laws.

    Raises:
        UserError: Numbers of laws, bodies and particles that do not agree.
    """
    if not len(elasticity) == len(plasticity) == len(counts) or sum(counts) != len(order):
        raise UserError(
            f"{len(elasticity)} elastic and {len(plasticity)} plastic laws for bodies of {list(counts)} particles, and the simulator has "
            f"{len(order)}; give one law of each kind and one count for each body"
        )
    body = torch.arange(len(counts), device=order.device).repeat_interleave(torch.tensor(list(counts), device=order.device))[order]
    return CompositeElastic(elasticity, body), CompositePlastic(plasticity, body)
