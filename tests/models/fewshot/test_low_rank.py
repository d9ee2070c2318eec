"""LoRA on the trunks: it starts at the law of its start, its law is that of the merged operator, and its files are PEFT's."""

import json
import shutil

import pytest
import torch
from peft import PeftModel
from safetensors.torch import load_file

from neuido.errors import UserError
from neuido.models.fewshot.low_rank import PEFT_FILES, LowRankAdaptation
from neuido.models.inference.law_file import load_law
from neuido.models.inference.prepared_scene import prepare
from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
from tests.models.visual_samples import tiny_scene


@pytest.fixture(scope="module")
def prepared(tmp_path_factory):
    return prepare(tiny_scene(tmp_path_factory.mktemp("scene")), None)


def disturbed(prepared, start="jelly", **options):
    """A fit whose adapter and latent have moved, as after some steps."""
    fit = LowRankAdaptation(start=start, **options).for_scene(prepared)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for name, p in fit.trainable().items():
            p += (0.1 if name == "z" else 0.01) * torch.randn(p.shape, generator=generator)
    return fit


def some_F():
    return torch.eye(3) + 0.1 * torch.randn(50, 3, 3, generator=torch.Generator().manual_seed(0))


def answers(laws, F):
    return [law(F) for law in laws]


def test_it_starts_at_the_law_of_its_start(prepared):
    fit = LowRankAdaptation(start="jelly").for_scene(prepared)
    plain = IntrinsicDynamicsOperator.load()
    for a, b in zip(answers(fit.laws(prepared), some_F()), answers(plain.laws(plain.latent("jelly")), some_F())):
        assert torch.allclose(a, b, rtol=1e-4, atol=1e-5 * float(b.detach().abs().max()))
    names = set(fit.trainable())
    assert "z" in names and len(names) == 13  # two factors in each of three layers of two trunks
    assert all("lora_" in name for name in names - {"z"})
    assert [group["lr"] for group in fit.parameter_groups()] == [fit.lr, fit.latent_lr]


def test_the_merged_law_equals_the_unmerged_one(prepared):
    fit = disturbed(prepared)
    merged = fit.merged()
    assert not any("lora" in name for name, _ in merged.named_parameters())
    z = fit.z.detach().requires_grad_()
    steps = 4 * prepared.every
    motions = [prepared.simulator.rollout(steps, *laws, every=prepared.every) for laws in (fit.laws(prepared), merged.laws(z))]
    gradients = [torch.autograd.grad(motion.x[-1].square().sum(), at)[0] for motion, at in zip(motions, (fit.z, z))]
    assert torch.allclose(motions[0].x, motions[1].x, atol=1e-5)
    assert torch.allclose(*gradients, rtol=2e-3, atol=2e-3 * float(gradients[0].abs().max()))
    start = LowRankAdaptation(start="jelly").for_scene(prepared)
    with torch.no_grad():
        assert not torch.allclose(motions[0].x, prepared.simulator.rollout(steps, *start.laws(prepared), every=prepared.every).x, atol=1e-5)


def test_gradients_reach_every_parameter(prepared):
    fit = disturbed(prepared, start="plasticine")  # what does not yield has no gradient for its yielding
    motion = fit.rollout(prepared, prepared.frames)
    (motion.x[-1].sum() + motion.F[-1].square().sum() + fit.regulariser()).backward()
    assert all(p.grad is not None and float(p.grad.abs().max()) > 0 for p in fit.trainable().values())


def test_files_are_those_of_peft(prepared, tmp_path):
    fit = disturbed(prepared, rank=4, alpha=8.0)
    fit.save(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {*PEFT_FILES, "latent.safetensors", "law.safetensors", "law.json", "method.json"}
    config = json.loads((tmp_path / "adapter_config.json").read_text())
    assert (config["peft_type"], config["r"], config["lora_alpha"]) == ("LORA", 4, 8.0)
    assert all(".lora_" in name for name in load_file(tmp_path / "adapter_model.safetensors"))
    by_peft = PeftModel.from_pretrained(IntrinsicDynamicsOperator.load(), str(tmp_path)).merge_and_unload()
    again = LowRankAdaptation(start="mean").for_scene(prepared)  # another start and rank: the files count
    again.load(tmp_path)
    assert again.rank == 4 and set(again.trainable()) == set(fit.trainable())
    expected = answers(fit.laws(prepared), some_F())
    for laws in (by_peft.laws(fit.z), again.laws(prepared), load_law(tmp_path / "law.safetensors")):
        for a, b in zip(answers(laws, some_F()), expected):
            assert torch.allclose(a, b, rtol=1e-4, atol=1e-5 * float(b.detach().abs().max()))
    assert again.summary() == fit.summary() and fit.summary().startswith("E = ") and "Pa, nu = 0." in fit.summary()
    assert again.describe()["latent"] == pytest.approx(fit.describe()["latent"])


def test_no_rank_refines_the_latent_alone(prepared, tmp_path):
    fit = disturbed(prepared, rank=0)
    assert set(fit.trainable()) == {"z"}
    fit.save(tmp_path)
    again = LowRankAdaptation(start="mean").for_scene(prepared)
    again.load(tmp_path)
    assert again.rank == 0 and torch.equal(again.z, fit.z)


def test_starts(prepared, tmp_path):
    fit = disturbed(prepared)
    fit.save(tmp_path)
    operator = IntrinsicDynamicsOperator.load()
    elastic = [i for i, family in enumerate(operator.latent_families) if family == "elastic"]
    for start, expected in (
        ("mean", operator.latents.mean(0)),
        ("elastic", operator.latents[elastic].mean(0)),
        (str(tmp_path / "law.safetensors"), fit.z),
    ):
        assert torch.equal(LowRankAdaptation(start=start).for_scene(prepared).z, expected)


def test_retreat_leads_to_the_mean_law(prepared):
    fit = disturbed(prepared)
    before = fit.recovery_loss()
    gradients = torch.autograd.grad(before, list(fit.trainable().values()), allow_unused=True)
    with torch.no_grad():
        for p, g in zip(fit.trainable().values(), gradients):
            p -= 0.0 if g is None else 10 * g
    assert 0 < float(fit.recovery_loss().detach()) < float(before.detach())


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"rank": -1}, "rank"),
        ({"alpha": 0.0}, "alpha"),
        ({"lr": float("nan")}, "lr"),
        ({"start": "marble"}, "marble"),
        ({"start": "no.safetensors"}, "missing"),
        ({"start": "encoder", "init_from": "no.safetensors"}, "missing"),
        ({"operator": "no.safetensors"}, "missing"),
    ],
)
def test_impossible_options_are_named(options, word):
    with pytest.raises(UserError, match=word):
        LowRankAdaptation(**{"start": "mean", **options})


def test_damaged_folders_are_named(prepared, tmp_path):
    fit = disturbed(prepared)
    fit.save(tmp_path / "whole")
    other = LowRankAdaptation(start="mean").for_scene(prepared)

    def refused(word, change):
        shutil.rmtree(tmp_path / "broken", ignore_errors=True)
        shutil.copytree(tmp_path / "whole", tmp_path / "broken")
        change(tmp_path / "broken")
        with pytest.raises(UserError, match=word):
            other.load(tmp_path / "broken")

    refused("method.json", lambda folder: (folder / "method.json").unlink())
    refused("method.json", lambda folder: (folder / "method.json").write_text("[1, 2"))
    refused("of the method 'Other'", lambda folder: edit(folder / "method.json", "LowRankAdaptation", "Other"))
    refused("another operator", lambda folder: edit(folder / "method.json", fit.fingerprint, "0" * 12))
    refused("adapter_model.safetensors is missing", lambda folder: (folder / "adapter_model.safetensors").unlink())
    refused("adapter_model.safetensors", lambda folder: (folder / "adapter_model.safetensors").write_bytes(b"nonsense"))
    refused("adapter_config.json is missing", lambda folder: (folder / "adapter_config.json").unlink())
    refused("LoRA", lambda folder: (folder / "adapter_config.json").write_text("{}"))
    refused("LoRA", lambda folder: edit(folder / "adapter_config.json", '"r": 16', '"r": 3'))
    refused("latent.safetensors", lambda folder: (folder / "latent.safetensors").write_bytes(b""))


def edit(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
