"""A fit may start from the law, among those that the encoder leaves possible, whose images are nearest."""

import pytest
import torch

from neuido.models.fewshot.low_rank import LowRankAdaptation
from neuido.models.fewshot.posterior_start import TRUE_OVER_READ, most_probable, pairs_of_a_family, possible_latents
from neuido.models.inference.prepared_scene import prepare
from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
from neuido.models.operator.law_properties import p_wave_modulus
from neuido.models.video.encoder import DynamicsEncoder
from tests.models.visual_samples import tiny_scene


@pytest.fixture(scope="module")
def operator():
    return IntrinsicDynamicsOperator.load().requires_grad_(False)


@pytest.fixture(scope="module")
def encoder():
    return DynamicsEncoder.load("pretrained-small").requires_grad_(False)


@pytest.fixture(scope="module")
def prepared(tmp_path_factory, encoder):
    return prepare(tiny_scene(tmp_path_factory.mktemp("scene")), encoder)


def test_possible_latents_lie_between_materials_of_a_family_near_the_reading(operator):
    z = operator.latent("plasticine") + 0.1
    drawn = possible_latents(operator, z, 40, seed=1)
    assert drawn.shape == (40, 128) and torch.equal(drawn[0], z)
    ratio = p_wave_modulus(operator, drawn[1:]) / p_wave_modulus(operator, z[None])
    assert TRUE_OVER_READ[0] < float(ratio.min()) and float(ratio.max()) < TRUE_OVER_READ[1]
    assert float(ratio.max() / ratio.min()) > 5  # they differ
    pairs = pairs_of_a_family(operator.latent_families)
    a, b = (operator.latents[i] for i in pairs.unbind(1))
    for each in drawn[1:6]:  # on a segment the two distances add up to its length
        surplus = (each - a).norm(dim=1) + (each - b).norm(dim=1) - (a - b).norm(dim=1)
        assert float(surplus.min()) < 1e-3
    assert torch.equal(drawn, possible_latents(operator, z, 40, seed=1))
    assert not torch.equal(drawn, possible_latents(operator, z, 40, seed=2))


def test_pairs_are_of_one_family():
    assert pairs_of_a_family(["a", "b", "a", "b", "c"]).tolist() == [[0, 2], [1, 3]]
    assert pairs_of_a_family(["a", "b"]).shape == (0, 2)


def test_without_pairs_or_draws_the_estimate_stands(operator):
    z = operator.latent("jelly")
    assert torch.equal(possible_latents(operator, z, 1), z[None])
    alone = IntrinsicDynamicsOperator("bounded")
    assert torch.equal(possible_latents(alone, z, 9), z[None])


def test_the_law_whose_images_are_nearest_is_found(prepared, operator):
    """The scene's E is 50 kPa; soft, stiff and flowing laws are farther from its images the more they differ."""
    elastic = [i for i, family in enumerate(operator.latent_families) if family == "elastic"]
    moduli = p_wave_modulus(operator, operator.latents[elastic])
    true = 5e4 * (1 - 0.25) / ((1 + 0.25) * (1 - 0.5))
    wrong = torch.stack([operator.latents[elastic[int((moduli - f * true).abs().argmin())]] for f in (8.0, 2.5)])
    near = operator.latents[elastic[int((moduli - true).abs().argmin())]]
    latents = torch.cat([wrong, near[None], operator.latent("sand")[None]])
    found, errors = most_probable(prepared, operator, latents)
    assert torch.equal(found, near)
    assert float(errors[0]) > float(errors[1]) > 2 * float(errors[2])


def test_a_law_that_does_not_run_is_left_out(prepared, operator):
    far = 30 * torch.randn(128, generator=torch.Generator().manual_seed(0))
    stiff = operator.latents[int(p_wave_modulus(operator, operator.latents).argmax())] + far
    found, errors = most_probable(prepared, operator, torch.stack([stiff, operator.latent("jelly")]))
    assert errors[0] == float("inf") and torch.isfinite(errors[1]) and torch.equal(found, operator.latent("jelly"))
    assert torch.equal(most_probable(prepared, operator, stiff[None])[0], stiff)


def test_a_fit_starts_there(prepared, encoder):
    names = {"init_from": "pretrained-small", "rank": 0, "start_draws": 12}
    read, chosen = (LowRankAdaptation(start=start, **names).for_scene(prepared) for start in ("encoder", "posterior"))
    assert torch.equal(chosen.z, chosen.origin)
    _, errors = most_probable(prepared, read.operator, torch.stack([read.z.detach(), chosen.z.detach()]))
    assert errors[1] <= errors[0]
    candidates = possible_latents(read.operator, read.z.detach(), 12)
    best, errors = most_probable(prepared, read.operator, candidates)
    torch.testing.assert_close(chosen.z.detach(), best)
    assert len(errors) > 6 and float(errors[torch.isfinite(errors)].max()) > 1.5 * float(errors.min())
