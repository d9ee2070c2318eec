"""The law that a video shows: moduli, file, motion, and what `neuido predict` prints of it."""

import json

import pytest
import torch
from lightning.pytorch import Trainer

import neuido.models
from neuido.data.files.values import with_prefix
from neuido.errors import UserError
from neuido.models import DynamicsEncoder, FlowVAE, Operator, VideoLaw, load_law, read_law, small_strain_moduli
from neuido.models.inference.pipeline import infer_latent
from neuido.models.inference.prepared_scene import prepare
from neuido.models.operator.law_properties import p_wave_modulus
from neuido.models.stages.align import AlignModule
from neuido.models.stages.warmup import WarmupModule
from tests.models.visual_samples import TinyScenes, tiny_scene


@pytest.fixture(scope="module")
def operator():
    return Operator.from_pretrained()


@pytest.fixture(scope="module")
def encoder(operator):
    torch.manual_seed(0)
    made = DynamicsEncoder(FlowVAE(8), flow_size=32, width=48)
    made.projector.start_near(operator.latents)
    return made


def test_moduli_of_a_known_material(operator):
    with torch.no_grad():
        young, poisson = (float(t) for t in small_strain_moduli(operator, operator.latent("jelly")[None]))
    assert young == pytest.approx(1e5, rel=0.02)  # NCLaw's jelly
    assert poisson == pytest.approx(0.2, abs=0.01)


def test_moduli_agree_with_the_p_wave_modulus(operator):
    z = operator.latents[:20]
    with torch.no_grad():
        young, poisson = small_strain_moduli(operator, z)
        expected = young * (1 - poisson) / ((1 + poisson) * (1 - 2 * poisson))
        assert torch.allclose(p_wave_modulus(operator, z), expected, rtol=5e-3)


@pytest.mark.parametrize(("value", "text"), [(98_300.0, "98.3 kPa"), (2.1e11, "210 GPa"), (3.0, "3 Pa"), (-1500.0, "-1.5 kPa")])
def test_prefixes(value, text):
    assert with_prefix(value, "Pa") == text


def test_read_law_is_the_inference_of_predict(operator, encoder, tmp_path):
    scene = tiny_scene(tmp_path)
    found = read_law(scene, operator=operator, encoder=encoder, device="cpu")
    expected = infer_latent(encoder, operator, prepare(scene, encoder, device="cpu"), repeat=1).z
    assert torch.equal(found.latent, expected)
    assert found.moduli == tuple(float(t) for t in small_strain_moduli(operator, expected[None]))
    assert (found.scene, found.views, found.frames) == ("tiny", 2, 6)
    motion, _ = found.rollout(3)
    assert motion.x.shape == (3, len(scene.body.x), 3)
    assert repr(found.prepared).startswith("PreparedScene('tiny', ") and "tensor" not in repr(found.prepared)
    assert "Pa" in repr(found) and "tensor" not in repr(found)

    found.save(tmp_path / "law.safetensors")
    F = torch.eye(3) + 0.05 * torch.randn(8, 3, 3, generator=torch.Generator().manual_seed(0))
    for own, read in zip(found.law(), load_law(tmp_path / "law.safetensors")):
        assert torch.equal(own(F), read(F))
    assert json.loads((tmp_path / "law.json").read_text())["young"] == found.moduli.young


def test_latents_of_another_length_are_refused(operator, tmp_path):
    other = DynamicsEncoder(FlowVAE(8), latent_dim=16, flow_size=32, width=48)
    with pytest.raises(UserError, match="latents of length 16, but the operator takes 128"):
        read_law(tiny_scene(tmp_path), operator=operator, encoder=other, device="cpu")


@pytest.mark.parametrize(
    ("encoder", "operator"), [("pretrained-small", "pretrained-objective"), ("pretrained-small-objective", "pretrained")]
)
def test_an_encoder_of_another_operator_is_refused(encoder, operator, tmp_path):
    line = rf"encoder = {encoder} was trained for operator \w{{12}}, not for the given one, \w{{12}}: use two that belong together"
    with pytest.raises(UserError, match=line):
        read_law(tiny_scene(tmp_path), operator=operator, encoder=encoder, device="cpu")
    WarmupModule(operator, init_from=encoder)  # but a training may start from it


@pytest.mark.parametrize(
    "names", [("pretrained", "pretrained", "pretrained-small"), ("pretrained-objective", "pretrained-small-objective")]
)
def test_the_encoders_that_come_with_neuido_name_their_operator(names):
    for name in names[1:]:
        DynamicsEncoder.load(name).check_operator(Operator.load(names[0]), name)


def test_an_encoder_that_no_longer_comes_with_neuido_is_said_to_be_gone():
    with pytest.raises(UserError, match="pretrained-objective no longer comes with neuido: use pretrained"):
        DynamicsEncoder.load("pretrained-objective")


def test_a_law_without_a_scene_does_not_roll_out(operator):
    law = VideoLaw(operator, operator.latent("jelly"))
    with pytest.raises(ValueError, match="has no scene"):
        law.rollout()
    assert "nan" not in law.summary()


def test_predict_prints_the_law_that_it_found(encoder, tmp_path, capsys):
    encoder.save(tmp_path / "encoder.safetensors")
    model = AlignModule(init_from=str(tmp_path / "encoder.safetensors"), out=str(tmp_path / "out"))
    trainer = Trainer(accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False)
    (row,) = trainer.predict(model, TinyScenes(str(tmp_path), youngs=(5e4,)))
    printed = capsys.readouterr().out
    assert f"tiny-0: E = {with_prefix(row['young'], 'Pa')}, nu = {row['poisson']:.3f} (small strain)" in printed
    assert f"tiny-0: results in {tmp_path / 'out' / 'tiny-0'}" in printed


def test_public_names_are_found_and_listed():
    assert set(neuido.models.__all__) <= set(dir(neuido.models))
    for name in neuido.models.__all__:
        assert getattr(neuido.models, name) is not None
    with pytest.raises(AttributeError, match=r"No neuido\.models attribute Nothing"):
        neuido.models.Nothing  # noqa: B018


def test_what_a_user_holds_shows_itself_in_one_line(operator, encoder):
    assert repr(operator).startswith("IntrinsicDynamicsOperator(trunk='bounded', latent_dim=128")
    assert "30 elastic" in repr(operator)
    assert repr(encoder).startswith("DynamicsEncoder(latent_dim=128") and "\n" not in repr(encoder)
