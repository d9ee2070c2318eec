"""Generate test cases: measured data whose declared model lacks an effect, with a sealed key that names the effect."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from neuido.data.undeclared.case import Case
    from neuido.data.undeclared.making import make_undeclared

__all__ = ["Case", "make_undeclared"]


def __getattr__(name: str) -> Any:
    """Import a public name on first use."""
    from importlib import import_module

    modules = {"Case": "case", "make_undeclared": "making"}
    if name not in modules:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{modules[name]}"), name)
