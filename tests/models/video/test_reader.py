"""The reader: its intervals cover what they promise, its file, its words, and its warning."""

import json

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from neuido.data.bodies.families import laws
from neuido.errors import UserError
from neuido.models.stages.true_properties import properties_of
from neuido.models.video.encoder import DynamicsEncoder
from neuido.models.video.flow_vae import FlowVAE
from neuido.models.video.material_properties import LENGTH_POWERS, UNITS, from_scale, to_scale
from neuido.models.video.reader import Distribution, Reader

FAMILIES = ["elastic", "plasticine"]


@pytest.fixture
def reader():
    torch.manual_seed(0)
    return Reader(FAMILIES, width=48).eval()


def test_intervals_cover_ninety_percent_after_calibration(reader):
    generator = torch.Generator().manual_seed(0)
    count, P = 2000, len(UNITS)
    family = torch.randint(2, (count,), generator=generator)
    log_std = torch.full((count, 2, P), -1.0)  # said: 0.37; true: twice that
    mean = torch.randn(count, 2, P, generator=generator)
    row = torch.arange(count)
    target = mean[row, family] + 2 * torch.exp(torch.tensor(-1.0)) * torch.randn(count, P, generator=generator)
    logits = 4.0 * (2 * torch.nn.functional.one_hot(family, 2) - 1) * torch.where(torch.rand(count, 1, generator=generator) < 0.9, 1, -1)
    reader.calibrate(Distribution(logits.float(), mean, log_std), family, target, torch.ones(count, P))
    right = logits.argmax(1) == family
    inside = (target - mean[row, family]).abs() <= 1.6449 * reader.interval_scale * torch.exp(torch.tensor(-1.0))
    assert 0.85 < inside[right].float().mean() < 0.97  # a wrong family has wrong means, so that right ones get wider intervals
    stated = (logits / reader.temperature).softmax(1).max(1).values.mean()
    assert stated == pytest.approx(0.9, abs=0.02)  # named rightly in nine of ten cases


def test_a_strange_video_is_called_unlike(reader):
    generator = torch.Generator().manual_seed(0)
    spread = torch.linspace(0.1, 2.0, 50)
    usual = lambda n: 3 + spread * torch.randn(n, 50, generator=generator)  # noqa: E731
    reader.familiarise(usual(2000), usual(1000))
    assert (reader.distance(usual(1000)) > reader.limit).float().mean() < 0.03
    assert (reader.distance(usual(100) + 4 * spread) > reader.limit).all()


def test_readings_have_words_units_and_only_what_the_family_has(reader):
    reader.centre.copy_(torch.tensor([to_scale(name, 1e5 if unit == "Pa" else 0.3) for name, unit in UNITS.items()]))
    reader.known.copy_(torch.tensor([[1, 1, 0, 0, 0], [1, 1, 1, 0, 0]]))
    volume, conditions = torch.randn(2, 16, 5, 6, 6), torch.zeros(2, 2)
    found = reader.read(volume, conditions)
    assert sum(found.families.values()) == pytest.approx(1) and set(found.families) == set(FAMILIES)
    assert [one.name for one in found.properties] == ["young", "poisson"] + ["yield_stress"] * (found.family == "plasticine")
    young = found["young"]
    assert young.low < young.value < young.high and found.novelty == found[2]
    assert "kPa (90 %: " in str(young) and str(young).startswith("E = ")
    assert json.loads(json.dumps(found.as_dict()))["properties"]["young"]["unit"] == "Pa"
    assert not found.unlike and "warning" not in repr(found)
    reader.limit.fill_(0.0)
    assert "warning: the video is unlike the training videos" in repr(reader.read(volume, conditions))


def test_one_view_is_read_like_two_equal_ones(reader):
    volume, conditions = torch.randn(1, 16, 4, 4, 4), torch.zeros(1, 2)
    one, two = reader.read(volume, conditions), reader.read(volume.repeat(2, 1, 1, 1, 1), conditions.repeat(2, 1))
    assert one["young"].value == pytest.approx(two["young"].value, rel=1e-4)


def test_the_loss_is_least_at_the_truth(reader):
    family, target, present = torch.tensor([0, 1]), torch.zeros(2, 5), torch.tensor([[1.0, 1, 0, 0, 0], [1, 1, 1, 0, 0]])
    logits = torch.tensor([[5.0, -5.0], [-5.0, 5.0]])
    at = lambda mean: reader.loss(Distribution(logits, mean, torch.zeros(2, 2, 5)), family, target, present)  # noqa: E731
    off = torch.zeros(2, 2, 5)
    off[0, 0, 0] = 1.0
    absent = torch.zeros(2, 2, 5)
    absent[0, 1], absent[0, 0, 2] = 9.0, 9.0  # of the other family, and a property that the material lacks
    assert at(off) > at(torch.zeros(2, 2, 5)) == at(absent)


def test_file_with_and_without_reader(tmp_path):
    torch.manual_seed(0)
    encoder = DynamicsEncoder(FlowVAE(8), latent_dim=12, flow_size=32, width=48)
    encoder.save(tmp_path / "without.safetensors")
    assert DynamicsEncoder.load(tmp_path / "without.safetensors").read(torch.randn(1, 16, 3, 4, 4), torch.zeros(1, 2)) is None
    encoder.reader = Reader(FAMILIES, width=48)
    encoder.reader.limit.fill_(0.7)
    encoder.save(tmp_path / "with.safetensors")
    loaded = DynamicsEncoder.load(tmp_path / "with.safetensors")
    volume = torch.randn(1, 16, 3, 4, 4)
    assert loaded.read(volume, torch.zeros(1, 2)) == encoder.read(volume, torch.zeros(1, 2))

    with safe_open(tmp_path / "without.safetensors", framework="pt") as file:
        tensors, metadata = {name: file.get_tensor(name) for name in file.keys()}, file.metadata()
    config = json.loads(metadata["config"])
    del config["reader"]
    save_file(tensors, tmp_path / "old.safetensors", metadata={**metadata, "format": "neuido-encoder/1", "config": json.dumps(config)})
    assert DynamicsEncoder.load(tmp_path / "old.safetensors").reader is None


def test_wrong_sizes_are_named():
    with pytest.raises(UserError, match="width = 50"):
        Reader(FAMILIES, width=50)
    with pytest.raises(UserError, match="colour"):
        Reader(FAMILIES, ["colour"])


def test_properties_are_those_of_the_law():
    found = properties_of("plasticine", {"young": 3e5, "poisson": 0.25, "yield_stress": 5e3})
    assert found["young"] == pytest.approx(3e5, rel=1e-3) and found["poisson"] == pytest.approx(0.25, abs=1e-3)
    assert set(found) == {"young", "poisson", "yield_stress"}
    assert from_scale("young", to_scale("young", 3e5)) == pytest.approx(3e5)
    # a motion twice as large in the same gravity: speeds grow by the root of two, and wave speeds must too
    assert laws("elastic", [{"young": 2.0 ** LENGTH_POWERS["young"], "poisson": 0.2}])[0].modulus() == pytest.approx(
        2 * float(laws("elastic", [{"young": 1.0, "poisson": 0.2}])[0].modulus())
    )
