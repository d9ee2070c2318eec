"""Lazy import of the public names of a package (PEP 562), and of the libraries of optional extras."""

from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any

from neuido.errors import UserError


def lazy_names(package: str, modules: Mapping[str, Sequence[str]]) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return functions `__getattr__` and `__dir__` for a package whose names are imported at first use.

    Args:
        package: Name of the package.
        modules: The public names of each module; a module without names is itself public.
    """
    source = {name: module for module, names in modules.items() for name in names}
    own = {module.rpartition(".")[2]: module for module, names in modules.items() if not names}

    def get(name: str) -> Any:
        if name in source:
            return getattr(import_module(source[name]), name)
        if name in own:
            return import_module(own[name])
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    def names() -> list[str]:
        return sorted({*source, *own})

    return get, names


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
