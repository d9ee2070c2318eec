"""What the library says of one effect and of each of its parameters."""

from typing import NamedTuple


class Parameter(NamedTuple):
    """One parameter of an effect, "<effect>.<name>"."""

    name: str
    field: str
    """The field of `Effects` that it sets, or sets a component of."""
    unit: str
    low: float
    """Lower end of the physical range, inclusive."""
    high: float
    """Upper end of the physical range, inclusive."""
    signed: bool = False
    """Whether both signs are possible."""


class Entry(NamedTuple):
    """One effect: its equation, its parameters with ranges, where it shows, and which effects it is confused with."""

    name: str
    title: str
    """The effect in words, as they stand after "the model lacks"."""
    equation: str
    parameters: tuple[Parameter, ...]
    stage: str
    """The part of a motion in which it shows: flight, rotation, internal modes, contact, rest or power."""
    confusions: tuple[str, ...]
    """Effects that explain similar data."""
    source: str
    """Reference of the equation."""
    limits: tuple[str, ...] = ()
    """Effects with fewer parameters that this one becomes at an end of its range."""
    needs: str = ""
    """What must be measured for it to show, beside what `stage` says."""
    only: str = ""
    """The one kind of data that can show it, whose model has it: `material test`, `plane specimen` or `track`. Empty: bodies too."""
