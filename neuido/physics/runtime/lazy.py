"""Import of the libraries of optional extras at their first use."""

from importlib import import_module
from typing import Any

from neuido.errors import UserError


def import_extra(module: str, what: str, *, extra: str = "import") -> Any:
    """Import a library of an optional extra.

    Args:
        module: Name of the library.
        what: What needs it, for the error message.
        extra: The extra that has it.

    Raises:
        UserError: The library is not installed.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise UserError(f"{what} needs {module}: pip install 'neuido[{extra}]'") from error
