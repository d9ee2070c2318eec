"""Diagnosis: from measured data to the physical effect that a model lacks."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from neuido.discrepancy.applied_model import DiagnosedEffects as DiagnosedEffects
    from neuido.discrepancy.own_effects import OwnEffect as OwnEffect
    from neuido.discrepancy.report.diagnosis import Diagnosis as Diagnosis
    from neuido.discrepancy.report.diagnosis import Effect as Effect
    from neuido.discrepancy.report.diagnosis import ErrorChange as ErrorChange
    from neuido.discrepancy.report.diagnosis import Quantity as Quantity
    from neuido.discrepancy.workflow import diagnose as diagnose

_PUBLIC = {
    "DiagnosedEffects": ("applied_model", "DiagnosedEffects"),
    "Diagnosis": ("report.diagnosis", "Diagnosis"),
    "Effect": ("report.diagnosis", "Effect"),
    "ErrorChange": ("report.diagnosis", "ErrorChange"),
    "OwnEffect": ("own_effects", "OwnEffect"),
    "Quantity": ("report.diagnosis", "Quantity"),
    "diagnose": ("workflow", "diagnose"),
}
__all__ = ["DiagnosedEffects", "Diagnosis", "Effect", "ErrorChange", "OwnEffect", "Quantity", "diagnose"]


def __getattr__(name: str) -> Any:
    """Import a public name at its first use."""
    if name not in _PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, own = _PUBLIC[name]
    value = globals()[name] = getattr(import_module(f"{__name__}.{module}"), own)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
