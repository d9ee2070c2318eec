"""The bodies of scenes, validated and joined to one body for each scene."""

from collections.abc import Sequence
from itertools import combinations
from typing import Any, NamedTuple

import torch
from torch import Tensor

from neuido.errors import UserError
from neuido.types import Body, Scene, three_numbers

CONTACTS = ("sticky", "separate")
"""Kinds of contact between bodies."""


class SceneBodies(NamedTuple):
    """The bodies of one scene."""

    bodies: tuple[Body, ...]
    density: tuple[float | Tensor, ...]
    """Mass density of each body [kg/m^3], a number or one for each particle."""
    own: bool
    """Whether the scene brings them."""
    separate: bool
    """Whether each body has a velocity field of its own."""

    @property
    def counts(self) -> tuple[int, ...]:
        """Number of particles of each body."""
        return tuple(len(body.x) for body in self.bodies)


def bodies_of(scenes: Sequence[Scene], given: Body | Sequence[Body] | None, density: float | Sequence[float]) -> tuple[SceneBodies, ...]:
    """Return the bodies of each scene: those that it brings, or the one that is given beside it.

    Args:
        scenes: S scenes.
        given: One body for each scene; None: the scenes bring them.
        density: Density of the bodies without one [kg/m^3], one number or one for each scene.

    Raises:
        UserError: No body or two sources of bodies, a density that is not positive, or an unknown kind of contact.
    """
    count = len(scenes)
    densities = [float(density)] * count if isinstance(density, (int, float)) else [float(d) for d in density]
    if len(densities) != count or not all(d > 0 for d in densities):
        raise UserError(f"density is {density}; give one positive number, or one for each of {count} scenes")
    for s, scene in enumerate(scenes):
        _check_scene(scene, s)
    own = given is None
    if own:
        for s, scene in enumerate(scenes):
            if not scene.bodies:
                raise UserError(f"scene {s} has no body; give `Scene(bodies=[...])`, or one body beside each scene")
        each = [tuple(scene.bodies) for scene in scenes]
    else:
        bodies = (given,) if isinstance(given, Body) else tuple(given)
        if len(bodies) != count or not bodies:
            raise UserError(f"{len(bodies)} bodies for {count} scenes; give one body per scene")
        if any(scene.bodies for scene in scenes):
            raise UserError("a scene brings bodies, and further ones are given beside it; leave one of the two out")
        each = [(body,) for body in bodies]
    out = []
    for s, (scene, bodies, rho) in enumerate(zip(scenes, each, densities)):
        if scene.contact not in CONTACTS:
            raise UserError(f"contact is {scene.contact!r} in scene {s}; choose one of {', '.join(CONTACTS)}")
        names = [body.name for body in bodies if body.name]
        if len(set(names)) < len(names):
            raise UserError(f"the bodies of scene {s} are named {', '.join(names)}; give each a name of its own")
        own_density = tuple(_density(body, rho, _where(body, s, b, own)) for b, body in enumerate(bodies))
        out.append(SceneBodies(bodies, own_density, own, scene.contact == "separate" and len(bodies) > 1))
    return tuple(out)


def _check_scene(scene: Scene, number: int) -> None:
    """Refuse fields of a wrong kind, which would fail without a name further on."""
    for name in ("lower", "upper", "gravity"):
        try:
            three_numbers(getattr(scene, name), f"{name} of scene {number}")
        except TypeError as error:
            raise UserError(str(error)) from error
    for name, kind in (("bodies", "neuido.Body"), ("colliders", "neuido.colliders or Plane"), ("attachments", "neuido.Attachment")):
        given = getattr(scene, name)
        if not isinstance(given, (list, tuple)) or isinstance(given, Body):
            raise UserError(f"{name} of scene {number} is a {type(given).__name__}; give a list, each from {kind}")
    for b, body in enumerate(scene.bodies):
        if not isinstance(body, Body):
            raise UserError(f"bodies[{b}] of scene {number} is a {type(body).__name__}; give a neuido.Body")


def _where(body: Body, scene: int, number: int, own: bool) -> str:
    """Return how errors call a body."""
    if body.name:
        return f"body {body.name!r} of scene {scene}"
    return f"body {number} of scene {scene}" if own else f"body of scene {scene}"


def _density(body: Body, default: float, where: str) -> float | Tensor:
    """Return the density of a body [kg/m^3], a number or (P,).

    Raises:
        UserError: A shape that does not fit, or a value that is not positive.
    """
    if body.density is None:
        return default
    value = torch.as_tensor(body.density).detach().double()
    if value.ndim > 1 or (value.ndim == 1 and len(value) != len(body.x)) or not bool((value > 0).all() & torch.isfinite(value).all()):
        raise UserError(f"density of {where} is {body.density}; give one positive number, or one for each of {len(body.x)} particles")
    return value if value.ndim else float(value)


def checked_body(body: Body, scene: int, number: int, own: bool, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Return position, velocity and volume of a body in float64.

    Raises:
        UserError: Shapes that do not fit, numbers that are not finite, or a volume that is not positive.
    """
    x, v, volume = (torch.as_tensor(t).to(device, torch.float64) for t in (body.x, body.v, body.volume))
    where = _where(body, scene, number, own)
    if x.ndim != 2 or x.shape[1] != 3 or v.shape != x.shape or volume.shape != x.shape[:1] or not len(x):
        raise UserError(f"{where} has shapes x {tuple(x.shape)}, v {tuple(v.shape)}, volume {tuple(volume.shape)}; "
                        "they must be (P, 3), (P, 3), (P,)")  # fmt: skip
    if not bool(torch.isfinite(x).all() & torch.isfinite(v).all() & (volume > 0).all()):
        raise UserError(f"{where} holds a NaN, an infinity or a volume that is not positive")
    return x, v, volume


def friction_table(scenes: Sequence[Scene], each: Sequence[SceneBodies]) -> Tensor:
    """Return Coulomb's coefficient of each pair of bodies of each scene, (S, B B) float64, symmetric; B: the most bodies of a scene.

    Raises:
        UserError: A negative coefficient, or a pair that does not exist.
    """
    most = max(len(own.bodies) for own in each)
    table = torch.zeros(len(scenes), most, most, dtype=torch.float64)
    for s, (scene, own) in enumerate(zip(scenes, each)):
        if isinstance(scene.body_friction, (int, float)):
            pairs = [(a, b, float(scene.body_friction)) for a, b in combinations(range(len(own.bodies)), 2)]
        else:
            names = [body.name for body in own.bodies]
            pairs = [(_number(names, a, s), _number(names, b, s), float(value)) for a, b, value in scene.body_friction]
        for a, b, value in pairs:
            if not value >= 0.0:
                raise UserError(f"body_friction of scene {s} is {value}; give zero or more")
            table[s, a, b] = table[s, b, a] = value
    return table.reshape(len(scenes), -1)


def _number(names: Sequence[str], name: str, scene: int) -> int:
    if name not in names:
        raise UserError(f"body_friction of scene {scene} names the body {name!r}; there are {', '.join(filter(None, names)) or 'no names'}")
    return names.index(name)


def labels(each: Sequence[SceneBodies], body: Tensor) -> dict[str, Any]:
    """Return what `Frames` says of the bodies: nothing of a single body that is given beside its scene.

    Args:
        each: The bodies of each scene.
        body: Index of each particle's body, (P,).
    """
    skins, first = [], 0
    for own in (own for scene in each for own in scene.bodies):
        if own.skin is not None:
            skins.append(own.skin._replace(indices=own.skin.indices + first))
        first += len(own.x)
    if not any(own.own for own in each):
        return {"skins": tuple(skins)}
    names = [own.name or f"body {b}" for scene in each for b, own in enumerate(scene.bodies)]
    return {"body": body, "body_names": names, "skins": tuple(skins)}
