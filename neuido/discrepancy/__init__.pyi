from .applied_model import DiagnosedEffects
from .own_effects import OwnEffect
from .report.diagnosis import Diagnosis, Effect, ErrorChange, Quantity
from .workflow import diagnose

__all__ = [
    "DiagnosedEffects",
    "Diagnosis",
    "Effect",
    "ErrorChange",
    "OwnEffect",
    "Quantity",
    "diagnose",
]
