"""Options that were renamed; the old name still works and warns."""

import warnings
from typing import TypeVar

T = TypeVar("T")


def renamed_option(name: str, value: T, old_name: str, old_value: T | None) -> T:
    """Return the value of an option that may be given by its old name, and warn if it is.

    Args:
        name: The option.
        value: Its value.
        old_name: Its deprecated name.
        old_value: The value given by that name; None: not given.
    """
    if old_value is None:
        return value
    warnings.warn(f"{old_name} is deprecated; give {name}", DeprecationWarning, stacklevel=3)
    return old_value
