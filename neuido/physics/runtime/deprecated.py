"""Deprecated names of options."""

import warnings
from typing import TypeVar

T = TypeVar("T")


def renamed_option(name: str, value: T, old_name: str, old_value: T | None) -> T:
    """Return the value of an option, and warn if it was given by its deprecated name.

    Args:
        name: Name of the option.
        value: Value that was given by this name.
        old_name: Deprecated name of the option.
        old_value: Value that was given by the deprecated name; None: it was not used.
    """
    if old_value is None:
        return value
    warnings.warn(f"{old_name} is deprecated; give {name}", DeprecationWarning, stacklevel=3)
    return old_value
