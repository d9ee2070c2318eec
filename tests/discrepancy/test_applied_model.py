"""The effects of a diagnosis in a fit to images."""

import pytest
import torch
import yaml

from neuido.discrepancy.applied_model import DiagnosedEffects
from neuido.errors import UserError
from neuido.models.fewshot.low_rank import LowRankAdaptation
from neuido.models.stages.adapt import AdaptModule
from neuido.physics.effects.parameters import Effects
from tests.models.visual_samples import tiny_scene

MODEL = {
    "density": 1000.0,
    "elasticity": {"law": "fixed_corotated", "young": 1.0e5, "poisson": 0.3},
    "plasticity": {"law": "identity"},
    "effects": {"drag_linear.k": 2.5},
}


def test_the_effects_act_and_the_law_does_not(tmp_path):
    path = tmp_path / "model_after.yaml"
    path.write_text(yaml.safe_dump(MODEL))
    model = AdaptModule(LowRankAdaptation(start="jelly"), effects=DiagnosedEffects(str(path)), out=str(tmp_path / "out"))
    prepared, fit = model.load_fit(tiny_scene(tmp_path))
    with torch.no_grad():
        moved = fit.rollout(prepared, prepared.frames)
        expected = fit.method.rollout(prepared, prepared.frames, effects=Effects(drag_linear=2.5))
        free = fit.method.rollout(prepared, prepared.frames)
    assert torch.allclose(moved.x, expected.x, atol=1e-6) and not torch.allclose(moved.x, free.x, atol=1e-3)


def test_what_is_wrong_is_named(tmp_path):
    with pytest.raises(UserError, match="nowhere"):
        DiagnosedEffects(str(tmp_path / "nowhere.yaml"))
    path = tmp_path / "model_after.yaml"
    path.write_text(yaml.safe_dump(MODEL | {"effects": {"magic.k": 1.0}}))
    model = AdaptModule(LowRankAdaptation(start="jelly"), effects=DiagnosedEffects(str(path)), out=str(tmp_path / "out"))
    prepared, fit = model.load_fit(tiny_scene(tmp_path))
    with pytest.raises(UserError, match="magic"):
        fit.rollout(prepared, 2)
