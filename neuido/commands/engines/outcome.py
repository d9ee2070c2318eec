"""What a task is given and what comes of it, for every engine."""

from collections.abc import Callable
from typing import Any, NamedTuple

from neuido.errors import one_line, shortened

RETRIES = 3
"""How often a task starts anew whose worker ended: killed, out of memory, a machine that is gone. One that raises is not tried again."""


class Outcome(NamedTuple):
    """The result of one task."""

    number: int
    """Place of its arguments among those that were given."""
    value: Any
    """What the function returned; None where it failed."""
    error: str
    """Why it failed, in one line; empty where it did not."""


class Share(NamedTuple):
    """What one task takes of a machine."""

    cpus: float = 1.0
    """Cores."""
    gpus: float = 0.0
    """GPUs: a whole number, or a fraction of one."""


def attempt(function: Callable[..., Any], arguments: tuple[Any, ...]) -> tuple[Any, str]:
    """Return what a function returns and an empty line, or None and the line of its error."""
    try:
        return function(*arguments), ""
    except Exception as error:
        return None, one_line(error) or shortened(f"{type(error).__name__}: {error}")
