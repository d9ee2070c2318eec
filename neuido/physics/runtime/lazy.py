"""Names of a package that are imported when they are first used (PEP 562)."""

from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any


def lazy_names(package: str, modules: Mapping[str, Sequence[str]]) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return `__getattr__` and `__dir__` of a package.

    Args:
        package: Its name.
        modules: Names by the module that they come from; a module without names is itself one.
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
