"""User-defined candidates: effects expressed by effects of the library, such as a tilted table by a steady acceleration."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from neuido.discrepancy.problems.problem import Ask, Candidate, Parameter, Point, Problem, Rows
from neuido.errors import UserError


@dataclass(frozen=True)
class OwnEffect:
    """A user-defined effect for `neuido.diagnose(..., candidates=[...])`.

    It has one size between `low` and `high` and acts like the effects of the library that `acts_as` returns. At size zero it is absent.
    """

    name: str
    """Name of letters, digits and underscores that no effect of the library has. The report shows spaces for underscores."""
    parameter: str
    """Name of the size."""
    unit: str
    """Unit of the size."""
    start: float
    """Plausible size, at which fits start; its absolute value is the typical step."""
    low: float
    high: float
    acts_as: Callable[[float], Mapping[str, float]]
    """Function from the size to parameters of library effects, such as {"uniform_acceleration.x": 9.81 * sin(size)}."""
    where: str = "flight"
    """Stage of the motion in which the effect shows."""

    def candidate(self) -> Candidate:
        """Return the candidate for a search, with starts of both signs if the range has both.

        Raises:
            UserError: The name is taken or has other characters, the start is zero or outside the range, or the range lacks zero.
        """
        from neuido.physics.effects.library import LIBRARY

        where = f"candidates: {self.name}"
        if not self.name.isidentifier() or not self.parameter.isidentifier():
            raise UserError(f"{where}.{self.parameter}: both must be words of letters, digits and underscores")
        if self.name in {entry.name for entry in LIBRARY}:
            raise UserError(f"{where}: the library has an effect of that name; give another name")
        if not self.low <= 0.0 <= self.high or not self.low <= self.start <= self.high or self.start == 0:
            raise UserError(
                f"{where}: low = {self.low}, start = {self.start}, high = {self.high}: a range holds zero, and a start beside it"
            )
        known = {f"{entry.name}.{p.name}" for entry in LIBRARY for p in entry.parameters}
        for key in self.acts_as(self.start):
            if key not in known:
                raise UserError(f"{where}: acts_as gives {key!r}, which is no figure of the library, such as uniform_acceleration.x")
        key = f"{self.name}.{self.parameter}"
        p = Parameter(key, self.unit, 0.0, abs(self.start), self.low, self.high)
        starts = [self.start, *([-self.start] if self.low <= -self.start <= self.high else [])]
        return Candidate(self.name, (p,), tuple({key: float(v)} for v in starts), self.where)


def with_own_effects(problem: Problem, effects: Sequence[OwnEffect]) -> Problem:
    """Return the problem with user-defined effects as further candidates.

    Raises:
        UserError: An object is no `OwnEffect`, or two have the same name.
    """
    if not effects:
        return problem
    for effect in effects:
        if not isinstance(effect, OwnEffect):
            raise UserError(f"candidates takes OwnEffect alone, not {type(effect).__name__}")
    made = tuple(effect.candidate() for effect in effects)
    if len({c.name for c in made}) < len(made):
        raise UserError(f"candidates: {', '.join(c.name for c in made)}: each needs a name of its own")
    kind = type(problem)
    own = type(f"{kind.__name__}WithOwnEffects", (kind,), _methods(kind, effects))
    object.__setattr__(problem, "__class__", own)  # so that `dataclasses.replace` keeps the own effects
    object.__setattr__(problem, "candidates", (*problem.candidates, *made))
    return problem


TAKE_ONE, TAKE_SEVERAL = ("margin", "motion", "_scored"), ("predict", "forces", "_specimen")
"""Methods of problems whose first argument is one parameter set, and those where it is several."""


def _methods(kind: type, effects: Sequence[OwnEffect]) -> dict[str, Any]:
    """Return the methods of a problem that take parameter sets, with own effects translated into effects of the library."""

    def translated(point: Point) -> dict[str, float]:
        out = dict(point)
        for effect in effects:
            size = out.pop(f"{effect.name}.{effect.parameter}", 0.0)
            if size:
                for key, value in effect.acts_as(size).items():
                    out[key] = out.get(key, 0.0) + float(value)
        return out

    def of_one(method: Callable[..., Any]) -> Callable[..., Any]:
        return lambda self, point, *more, **named: method(self, translated(point), *more, **named)

    def of_several(method: Callable[..., Any]) -> Callable[..., Any]:
        return lambda self, points, *more, **named: method(self, [translated(p) for p in points], *more, **named)

    def predict_several(self: Problem, asks: Sequence[Ask]) -> Rows:
        return kind.predict_several(self, [([translated(p) for p in points], n, setting) for points, n, setting in asks])

    def model_after(self: Problem, values: Point, names: Sequence[str]) -> dict[str, Any]:
        kept = [name for name in names if name not in {e.name for e in effects}]
        for effect in effects:
            if effect.name in names:
                kept += [key.partition(".")[0] for key in effect.acts_as(values.get(f"{effect.name}.{effect.parameter}", 0.0))]
        return kind.model_after(self, translated(values), list(dict.fromkeys(kept)))

    made = {name: of_one(getattr(kind, name)) for name in TAKE_ONE if hasattr(kind, name)}
    made |= {name: of_several(getattr(kind, name)) for name in TAKE_SEVERAL if hasattr(kind, name)}
    return made | {"predict_several": predict_several, "model_after": model_after}
