"""Content of diagnosis.json for tests of its page and its words: made from the small committed diagnosis of an older version."""

import copy
from pathlib import Path

import numpy as np

from neuido.discrepancy.report import diagnosis_format

OLDER = Path(__file__).parent / "diagnosis-1"
HOSTILE = "</script><script>window.hit = 1</script><img src=x onerror='window.hit = 2'><b>&\"'"


def older() -> dict:
    return diagnosis_format.read(OLDER / "diagnosis.json")


def motion() -> dict:
    return {name: dict(np.load(OLDER / "predicted" / f"{name}.npz")) for name in ("throw", "toss")}


def content(**changes) -> dict:
    """A whole `neuido-diagnosis/2` of a body, with some keys changed."""
    c = older()
    figures = {"k": {"value": 3.0, "unit": "1/s"}}
    plane = {"point": [0.0, 0.0, 0.0], "normal": [0.0, 1.0, 0.0], "contact": "separate", "friction": 0.3}
    own = {"gravity": [0.0, -9.81, 0.0], "colliders": [plane]}
    series = {"stage": "flight", "unit": "m/s^2", "times": [0.0, 0.1], "before": [1.0, 2.0], "after": [0.1, 0.2], "noise": [0.1, 0.1]}
    model = {"step": 1, "reason": "", "parameters": figures, "cosine": 0.9}
    c |= {
        "recordings": {"throw": {"role": "fit"} | own, "toss": {"role": "held_out"} | own},
        "stages": {"throw": [series]},
        "models": [
            model | {"name": "drag_linear", "error_ratio": 27.0, "verdict": "named"},
            model
            | {"name": "drag_quadratic", "error_ratio": 4.5, "verdict": "rejected", "reason": "leaves 6 times the error of drag_linear"},
        ],
        "chance": [{"step": 1, "p_value": 0.01, "error_ratio95": 1.1, "of": "the largest gain"}],
        "work": {"simulations": 12, "reused": 3, "effort": 1e6, "effort_unit": "particle-substeps"},
    }
    c |= copy.deepcopy(changes)
    diagnosis_format.check(c, "the test's content")
    return c


def stress_curve(name: str = "uniaxial") -> tuple[dict, dict]:
    """Content and arrays of a material test."""
    e = {"noise_floor": 1e4, "discretisation_floor": 0.0, "unit": "Pa", "measure": "rmse", "noise_from": {name: "estimated"}}
    score = {"held_out": None, "validation": None, "test": None}
    e |= {when: {"fit": v, "by_recording": {name: v}} | score for when, v in (("before", 3e5), ("after", 2e4))}
    gent = {"k": {"value": 0.0129, "unit": "1", "interval90": [0.0126, 0.0132]}}
    effect = {"name": "strain_stiffening", "class": ["strain_stiffening"], "parameters": gent, "p_value": 0.005, "where": "large strain"}
    young = {"young": {"value": 1.2e6, "unit": "Pa", "interval90": [1.1e6, 1.3e6]}}
    shown = {"role": "fit", "quantity": "nominal stress", "axis": {"label": "stretch", "unit": "1"}, "timed": False}
    c = content(
        kind="material test", error=e, effects=[effect | {"step": 1}], declared=young, after=young, models=[], chance=[], power=[],
        stages={}, places={}, recordings={name: shown},
    )  # fmt: skip
    x = np.linspace(1.0, 6.0, 12)
    arrays = {"times": np.arange(12.0), "axis": x, "groups": np.zeros(12, int)}
    arrays |= {"measured": 4e5 * x, "before": 3e5 * x, "after": 4.01e5 * x}
    return c, {name: arrays}
