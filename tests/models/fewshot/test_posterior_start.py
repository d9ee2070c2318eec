"""A fit may start from the law, among those that the encoder leaves possible, whose images are nearest."""

import math

import pytest
import torch

from neuido.models.fewshot.low_rank import LowRankAdaptation
from neuido.models.fewshot.posterior_start import TRUE_OVER_READ, Draws, explore, image_error
from neuido.models.inference.prepared_scene import prepare
from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
from neuido.models.operator.law_properties import p_wave_modulus
from neuido.models.video.encoder import DynamicsEncoder
from tests.models.visual_samples import tiny_scene


@pytest.fixture(scope="module")
def operator():
    return IntrinsicDynamicsOperator.load().requires_grad_(False)


@pytest.fixture(scope="module")
def prepared(tmp_path_factory):
    encoder = DynamicsEncoder.load("pretrained-small").requires_grad_(False)
    return prepare(tiny_scene(tmp_path_factory.mktemp("scene")), encoder)


def of_family(operator, family):
    return operator.latents[[i for i, each in enumerate(operator.latent_families) if each == family]]


def test_first_draws_are_materials_of_the_family_near_the_reading(operator):
    members = of_family(operator, "elastic")
    z = members[int(p_wave_modulus(operator, members).argmin())]
    drawn = Draws(operator, z, seed=1).first("elastic", 12)
    assert drawn.shape == (12, 128) and len(drawn.unique(dim=0)) == 12
    assert all(bool((each == members).all(1).any()) for each in drawn)
    ratio = p_wave_modulus(operator, drawn) / p_wave_modulus(operator, z[None])
    assert TRUE_OVER_READ[0] < float(ratio.min()) and float(ratio.max()) < TRUE_OVER_READ[1]
    ratio = p_wave_modulus(operator, members) / p_wave_modulus(operator, z[None])
    inside = (ratio > TRUE_OVER_READ[0]) & (ratio < TRUE_OVER_READ[1])
    assert 12 < int(inside.sum()) < 30 and len(Draws(operator, z, seed=1).first("elastic", 99)) == int(inside.sum())
    assert torch.equal(drawn, Draws(operator, z, seed=1).first("elastic", 12))
    assert not torch.equal(drawn, Draws(operator, z, seed=2).first("elastic", 12))


def test_later_draws_lie_about_the_best(operator):
    z = operator.latent("sand")
    draws = Draws(operator, z, seed=0)
    wide, narrow = (draws.about(z, "sand", 40, spread) - z for spread in (0.5, 0.1))
    assert wide.shape == narrow.shape == (40, 128)
    assert 2 < float(wide.norm(dim=1).mean() / narrow.norm(dim=1).mean()) < 12
    members = of_family(operator, "sand") - z
    toward = members / members.norm(dim=1, keepdim=True).clamp(min=1e-9)
    for step in narrow[narrow.norm(dim=1) > 1e-6][:5]:
        assert float((toward @ (step / step.norm())).abs().max()) == pytest.approx(1, abs=1e-4)


def test_what_is_found_is_better_than_the_estimate_and_each_family_is_tried(prepared, operator):
    """The scene's E is 50 kPa; the estimate is two and a half times as stiff."""
    elastic = of_family(operator, "elastic")
    z = elastic[int((p_wave_modulus(operator, elastic).log() - math.log(1.5e5)).abs().argmin())]
    found = explore(prepared, operator, z, 24, seed=0)
    assert set(found.families) == {"", "elastic", "plasticine", "sand"} and found.families[0] == ""
    assert torch.equal(found.latents[0], z) and len(found.latents) == len(found.errors) == len(found.families) > 16
    assert float(found.errors.min()) < 0.3 * float(found.errors[0])
    assert image_error(prepared, operator, found.best) == pytest.approx(float(found.errors.min()), rel=1e-5)
    assert 0.5 < float(p_wave_modulus(operator, found.best[None])[0]) / 6e4 < 2


def test_a_law_that_does_not_run_is_left_out(prepared, operator):
    far = 30 * torch.randn(128, generator=torch.Generator().manual_seed(0))
    stiff = operator.latents[int(p_wave_modulus(operator, operator.latents).argmax())] + far
    assert image_error(prepared, operator, stiff) == math.inf
    alone = IntrinsicDynamicsOperator.load().requires_grad_(False)
    alone.set_latents(torch.zeros(0, 128), [], [])
    found = explore(prepared, alone, stiff, 8)
    assert found.errors.tolist() == [math.inf] and torch.equal(found.best, stiff)


def test_a_fit_starts_there(prepared):
    names = {"init_from": "pretrained-small", "rank": 0, "start_draws": 6}
    read, chosen = (LowRankAdaptation(start=start, **names).for_scene(prepared) for start in ("encoder", "posterior"))
    assert torch.equal(chosen.z, chosen.origin)
    found = explore(prepared, read.operator, read.z.detach(), 6)
    torch.testing.assert_close(chosen.z.detach(), found.best)
    assert float(found.errors.min()) <= float(found.errors[0])
