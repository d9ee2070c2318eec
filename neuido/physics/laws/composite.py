"""Several laws in one scene: bodies of different materials, each with its own law.

The kernels see the particles scene by scene, body by body. A law therefore runs on a range of them without a copy. Classical laws of
neighbouring bodies share one launch, in which an index names the row of parameters of each particle.
"""

from collections.abc import Hashable, Iterator, Sequence
from itertools import accumulate
from typing import Any, NamedTuple

import torch
from torch import Tensor

from neuido.errors import UserError
from neuido.physics.laws.base import AutogradLaw, ElasticLaw, Engine, EngineLaw, Law, PlasticLaw, strain_limit
from neuido.physics.laws.classical import Identity, StackedElastic, StackedPlastic
from neuido.physics.laws.parametric import ParametricLaw
from neuido.types import Body, Particles


class Part(NamedTuple):
    """The particles of one law, in the order of the kernels."""

    law: Any
    rows: slice | Tensor
    """Their range, or their indices, (n,) int64."""
    index: Tensor | None = None
    """Row of the law's tensors for each particle, (n,) int32; None: the first for all."""


class CompositeLaw(EngineLaw):
    """Base class of laws that differ between particles.

    Args:
        parts: The laws and their particles.
        order: `Simulator.order`: the particle that is at each place in the order of the kernels, (P,).
    """

    def __init__(self, parts: Sequence[Part], order: Tensor):
        self.parts, self.order = tuple(parts), order
        self.counts = [len(part.law.tensors()) for part in parts]
        self.strain_limit = strain_limit(*(part.law for part in parts))
        self.identity = all(part.law.identity for part in parts)

    def tensors(self) -> tuple[Tensor, ...]:
        return tuple(t for part in self.parts for t in part.law.tensors())

    def split(self, tensors: Sequence) -> Iterator[tuple[Part, Sequence]]:
        """Yield each part with its own tensors."""
        ends = list(accumulate(self.counts))
        for part, count, end in zip(self.parts, self.counts, ends):
            yield part, tensors[end - count : end]

    def engine(self, tensors: Sequence[Tensor], particles: Particles) -> Engine:
        return CompositeEngine(self, tensors)

    def key(self, tensors: Sequence[Tensor]) -> Hashable | None:
        keys = [part.law.key(own) for part, own in self.split(tensors)]
        if any(key is None for key in keys) or any(isinstance(part.rows, Tensor) for part in self.parts):
            return None
        return id(self), *(key for key, part in zip(keys, self.parts) if not isinstance(part.law, ParametricLaw))

    def __call__(self, F: Tensor, particles: Particles | None = None) -> Tensor:
        out = torch.zeros_like(F)
        for part in self.parts:
            rows = self.order[part.rows]
            out = out.index_copy(0, rows, part.law(F[rows], _particles(part, rows)))
        return out

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(repr(part.law) for part in self.parts)})"


def _particles(part: Part, rows: Tensor) -> Particles:
    """Return the particles of a part, with the row of the law's tensors in place of a scene."""
    index = torch.zeros(len(rows), dtype=torch.int32, device=rows.device) if part.index is None else part.index
    return Particles(index, (0, len(rows)))


class CompositeEngine(Engine):
    """The laws of a composite, bound to their tensors for one rollout.

    Args:
        law: The composite.
        tensors: Its tensors, in the dtype and on the device of the rollout.
    """

    def __init__(self, law: CompositeLaw, tensors: Sequence[Tensor]):
        self.law, self.tensors = law, list(tensors)
        self.engines = [(part, part.law.engine(own, _particles(part, law.order[part.rows]))) for part, own in law.split(tensors)]

    def forward(self, F: Tensor, out: Tensor) -> None:
        for part, engine in self.engines:
            if isinstance(part.rows, slice):
                engine.forward(F[part.rows], out[part.rows])
            else:
                result = torch.empty_like(F[part.rows])
                engine.forward(F[part.rows].contiguous(), result)
                out[part.rows] = result

    def start_adjoint(self, wanted: Sequence[bool]) -> None:
        for (_, engine), (_, own) in zip(self.engines, self.law.split(wanted)):  # type: ignore[attr-defined]
            engine.start_adjoint(own)

    def adjoint(self, F: Tensor, grad_out: Tensor, grad_F: Tensor) -> None:
        for part, engine in self.engines:
            if isinstance(part.rows, slice):
                engine.adjoint(F[part.rows], grad_out[part.rows], grad_F[part.rows])
            else:
                own = torch.zeros_like(F[part.rows])
                engine.adjoint(F[part.rows].contiguous(), grad_out[part.rows].contiguous(), own)
                grad_F[part.rows] += own

    def gradients(self) -> list[Tensor | None]:
        return [gradient for _, engine in self.engines for gradient in engine.gradients()]


class CompositeElastic(CompositeLaw, ElasticLaw):
    """Elastic laws that differ between particles; made by `laws_of_bodies` and `by_body`."""

    def modulus(self) -> Tensor:
        """Return the largest P-wave modulus of the laws [Pa], (1,)."""
        return torch.stack([part.law.modulus().detach().max().double() for part in self.parts]).max()[None]

    def particle_modulus(self) -> Tensor:
        out = torch.zeros(len(self.order), dtype=torch.float64, device=self.order.device)
        for part in self.parts:
            rows = self.order[part.rows]
            own = part.law.modulus().detach().to(out)
            out[rows] = own[_particles(part, rows).scene.long().clamp(max=len(own) - 1)]
        return out

    def particle_viscosity(self) -> Tensor | None:
        if all(part.law.viscosity is None for part in self.parts):
            return None
        out = torch.zeros(len(self.order), dtype=torch.float64, device=self.order.device)
        for part in self.parts:
            if part.law.viscosity is not None:
                rows = self.order[part.rows]
                out = out.index_put(
                    (rows,), part.law.viscosity.to(out)[_particles(part, rows).scene.long().clamp(max=len(part.law.viscosity) - 1)]
                )
        return out


class CompositePlastic(CompositeLaw, PlasticLaw):
    """Plastic laws that differ between particles; made by `laws_of_bodies` and `by_body`."""


def by_body(
    elasticity: Sequence[ElasticLaw], plasticity: Sequence[PlasticLaw], counts: Sequence[int], order: Tensor
) -> tuple[CompositeElastic, CompositePlastic]:
    """Combine the laws of several bodies whose particles were concatenated to one body; `Scene(bodies=...)` needs no such step.

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
    rows = [(body == b).nonzero()[:, 0] for b in range(len(counts))]
    elastic, plastic = ([Part(law, own) for law, own in zip(laws, rows)] for laws in (elasticity, plasticity))
    return CompositeElastic(elastic, order), CompositePlastic(plastic, order)


def laws_of_bodies(bodies: Sequence[Body], order: Tensor) -> tuple[CompositeElastic, CompositePlastic | None]:
    """Combine the laws that bodies bring.

    Args:
        bodies: All bodies of a simulator.
        order: `Simulator.order`, which keeps the particles of a body together.

    Returns:
        The elastic and the plastic law; None in place of a plastic law that changes nothing.

    Raises:
        UserError: A body without a law, a field that a law needs, or a number of rows that does not fit.
    """
    elastic: list[Part] = []
    plastic: list[Part] = []
    start = 0
    for number, body in enumerate(bodies):
        end = start + len(body.x)
        where = f"body {body.name!r}" if body.name else f"body {number}"
        if body.law is None:
            raise UserError(f"{where} has no law; give `law` to each body, or a law to `rollout`")
        own = order[start:end] - start
        elastic += _parts(body, body.law, ElasticLaw, own, start, where)
        plastic += _parts(body, Identity() if body.plasticity is None else body.plasticity, PlasticLaw, own, start, where)
        start = end
    yielding = CompositePlastic(_merged(plastic, order.device), order)
    return CompositeElastic(_merged(elastic, order.device), order), None if yielding.identity else yielding


def _parts(body: Body, given: Any, kind: type, own: Tensor, start: int, where: str) -> list[Part]:
    """Return the parts of one body.

    Args:
        body: The body.
        given: Its law, or the laws between which its field `law` chooses.
        kind: `ElasticLaw` or `PlasticLaw`.
        own: The particle of the body that is at each place of its range.
        start: First place of its range.
        where: Name of the body for errors.

    Raises:
        UserError: As `laws_of_bodies`.
    """
    laws = list(given) if isinstance(given, list | tuple) else [given]
    for law in laws:
        if not isinstance(law, kind):
            raise UserError(f"{where}: {type(law).__name__} is no {'elastic' if kind is ElasticLaw else 'plastic'} law")
    whole = slice(start, start + len(own))
    if not isinstance(given, list | tuple):
        law = _bound(given, body, own, where)
        rows = _rows_of(law)
        if rows == 1:
            return [Part(law, whole)]
        if isinstance(law, ParametricLaw) and rows == len(own):
            return [Part(law, whole, own.int())]
        raise UserError(f"{where}: {type(law).__name__} has {rows} rows of parameters; give one, or one for each of {len(own)} particles")
    choice = _field(body, "law", own, where)[own].long()
    if choice.ndim != 1 or int(choice.min()) < 0 or int(choice.max()) >= len(laws):
        raise UserError(f"{where}: the field law has indices {int(choice.min())} to {int(choice.max())} for {len(laws)} laws")
    if any(_rows_of(_bound(law, body, own, where)) != 1 for law in laws):
        raise UserError(f"{where}: of several laws each has one row of parameters; give a body with a parameter field one law")
    if all(isinstance(law, ParametricLaw) for law in laws):
        return [Part(_stacked(laws), whole, choice.int())]
    each = [(law, (choice == i).nonzero()[:, 0]) for i, law in enumerate(laws)]
    return [Part(_bound(law, body, own[rows], where), rows + start) for law, rows in each if len(rows)]


def _rows_of(law: Law) -> int:
    """Return the number of rows of the tensors of a law; 1 for a law without tensors."""
    return max((t.shape[0] for t in law.tensors()), default=1)


def _bound(law: Law, body: Body, own: Tensor, where: str) -> Law:
    """Return a law of one's own with the fields that it takes as further tensors; any other law as it is."""
    if not isinstance(law, AutogradLaw) or not law.fields:
        return law
    return law.with_fields([_field(body, name, own, where) for name in law.fields], own)


def _field(body: Body, name: str, own: Tensor, where: str) -> Tensor:
    """Return a field of a body, on the device of `own`.

    Raises:
        UserError: A field that is missing or has another number of particles.
    """
    if not body.fields or name not in body.fields:
        known = ", ".join(body.fields or ()) or "none"
        raise UserError(f"{where} has no field {name!r}, which its law takes; its fields: {known}")
    value = torch.as_tensor(body.fields[name]).to(own.device)
    if value.ndim == 0 or len(value) != len(body.x):
        raise UserError(f"{where}: the field {name} has shape {tuple(value.shape)}; its first axis must have {len(body.x)} particles")
    return value


def _stacked(laws: Sequence[Any]) -> Any:
    return (StackedElastic if isinstance(laws[0], ElasticLaw) else StackedPlastic)(laws)


def _merged(parts: list[Part], device: torch.device) -> list[Part]:
    """Join classical laws of neighbouring ranges to one part, so that they share a launch."""
    out: list[list[Part]] = []
    for part in parts:
        alike = out and all(_can_be_joined(law) for law in (part.law, out[-1][0].law))
        if alike and part.law.tensors()[0].device == out[-1][0].law.tensors()[0].device:
            out[-1].append(part)
        else:
            out.append([part])
    return [group[0] if len(group) == 1 else _joined(group, device) for group in out]


def _can_be_joined(law: Law) -> bool:
    """Return whether a law may share a launch: a classical one that brings no viscosity of its own."""
    return isinstance(law, ParametricLaw) and getattr(law, "viscosity", None) is None


def _joined(parts: Sequence[Part], device: torch.device) -> Part:
    """Return one part for classical laws of neighbouring ranges; its index lies on the device of the rollout."""
    indices, first = [], 0
    for part in parts:
        assert isinstance(part.rows, slice)  # a classical law of a body has its whole range
        count = part.rows.stop - part.rows.start
        own = torch.zeros(count, dtype=torch.int32, device=device) if part.index is None else part.index
        indices.append(own + first)
        first += _rows_of(part.law)
    return Part(_stacked([part.law for part in parts]), slice(parts[0].rows.start, parts[-1].rows.stop), torch.cat(indices))  # type: ignore[union-attr]
