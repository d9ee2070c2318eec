"""Candidates of one's own: an effect that is told by what of the library it amounts to, such as a tilted table by a steady acceleration."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from neuido.discrepancy.problems.problem import Ask, Candidate, Parameter, Point, Problem, Rows
from neuido.errors import UserError


@dataclass(frozen=True)
class OwnEffect:
    """An effect that is not of the library, for `neuido.diagnose(..., candidates=[...])`.

    At `low <= value <= high` it acts as effects of the library do, by `acts_as`; at zero it must be absent.
    """

    name: str
    """A word of letters, digits and underscores, which no effect of the library has; the report says it with spaces."""
    parameter: str
    """Name of its size."""
    unit: str
    start: float
    """A plausible size, where its fits begin; its scale too."""
    low: float
    high: float
    acts_as: Callable[[float], Mapping[str, float]]
    """From the size to figures of the library by flat names, such as {"uniform_acceleration.x": 9.81 * sin(size)}."""
    where: str = "flight"
    """The stage of the motion that gives it away."""

    def candidate(self) -> Candidate:
        """Return what a search tries: starts of either sign where the range has both.

        Raises:
            UserError: A name that is taken or is no word, a start outside its range or at zero, a range without zero.
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
    """Return the problem with further candidates.

    Raises:
        UserError: A candidate that is none, or two of one name.
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
    object.__setattr__(problem, "__class__", own)  # `dataclasses.replace` then keeps the own effects
    object.__setattr__(problem, "candidates", (*problem.candidates, *made))
    return problem


FIRST, SEVERAL = ("margin", "motion", "_scored"), ("predict", "forces", "_specimen")
"""Methods of the kinds of problems whose first argument is a point, and several points."""


def _methods(kind: type, effects: Sequence[OwnEffect]) -> dict[str, Any]:
    """Return the methods of a problem that take points, with own effects translated into those of the library."""

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

    made = {name: of_one(getattr(kind, name)) for name in FIRST if hasattr(kind, name)}
    made |= {name: of_several(getattr(kind, name)) for name in SEVERAL if hasattr(kind, name)}
    return made | {"predict_several": predict_several, "model_after": model_after}
