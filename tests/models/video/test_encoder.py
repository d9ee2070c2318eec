"""The projector: shapes, averaging of views, its start, its gradients, its file."""

import pytest
import torch

from neuido.errors import UserError
from neuido.models.video.encoder import DynamicsEncoder, Projector, scale_conditions
from neuido.models.video.flow import Velocities
from neuido.models.video.flow_vae import FlowVAE


@pytest.fixture
def encoder():
    torch.manual_seed(0)
    return DynamicsEncoder(FlowVAE(8), latent_dim=12, flow_size=32, width=48)


def test_any_length_and_size_give_one_latent(encoder):
    for shape in ((1, 16, 1, 4, 4), (3, 16, 20, 8, 8)):
        volume = torch.randn(shape)
        z = encoder(volume, torch.zeros(shape[0], 2))
        assert z.shape == (12,)
        each = torch.stack([encoder(volume[v : v + 1], torch.zeros(1, 2)) for v in range(shape[0])])
        assert torch.allclose(z, each.mean(0), atol=1e-5)


def test_time_and_place_matter(encoder):
    encoder.eval()
    torch.manual_seed(1)
    volume = torch.randn(1, 16, 5, 4, 4)
    z = encoder(volume, torch.zeros(1, 2))
    assert (encoder(volume.flip(2), torch.zeros(1, 2)) - z).abs().max() > 1e-4
    assert (encoder(volume.flip(3), torch.zeros(1, 2)) - z).abs().max() > 1e-4
    assert (encoder(volume, torch.ones(1, 2)) - z).abs().max() > 1e-4


def test_paper_has_no_conditions():
    projector = Projector(latent_dim=6, width=48, conditions=False)
    volume = torch.randn(1, 16, 3, 4, 4)
    assert torch.equal(projector(volume, torch.zeros(1, 2)), projector(volume, torch.ones(1, 2)))


def test_it_starts_near_the_mean_latent():
    torch.manual_seed(0)
    latents = torch.randn(40, 12) @ torch.diag(torch.linspace(2, 0, 12)) + 3
    projector = Projector(latent_dim=12, width=96)
    projector.start_near(latents, spread=0.1)
    z = projector(torch.randn(64, 16, 3, 4, 4), torch.zeros(64, 2)).detach()
    distance = ((z - latents.mean(0)) / latents.std(0).clamp(min=0.1)).abs()
    assert 1e-4 < distance.mean() < 0.5
    assert z[:, -1].std() < 1e-3  # the latents do not vary there


def test_gradients_reach_the_projector_alone(encoder):
    flow = 0.3 * torch.randn(2, 8, 32, 32, 2)
    volume, conditions = encoder.embed(Velocities(flow, torch.full((2,), 0.01), 5e-3))
    assert volume.shape == (2, 16, 3, 4, 4) and not volume.requires_grad
    assert torch.allclose(conditions, torch.zeros(2, 2), atol=1e-6)
    encoder(volume, conditions + 1).square().sum().backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for name, p in encoder.projector.named_parameters() if "key.bias" not in name)
    assert all(p.grad is None and not p.requires_grad for p in encoder.vae.parameters())
    encoder.train()
    assert not encoder.vae.training


def test_conditions_are_logarithms():
    a, b = scale_conditions(5e-3, torch.tensor([0.01])), scale_conditions(1e-2, torch.tensor([0.04]))
    assert torch.allclose(b - a, torch.tensor([[2.0, 4.0]]).log())


def test_file(encoder, tmp_path):
    encoder.vae.scale.fill_(0.7)
    encoder.save(tmp_path / "encoder.safetensors", {"stage": "test"})
    loaded = DynamicsEncoder.load(tmp_path / "encoder.safetensors")
    flow = Velocities(torch.randn(1, 4, 32, 32, 2), torch.full((1,), 0.02), 1e-2)
    assert torch.equal(encoder.eval()(*encoder.embed(flow)), loaded.eval()(*loaded.embed(flow)))
    assert loaded.card["stage"] == "test" and loaded.flow == encoder.flow
    with pytest.raises(UserError, match="missing"):
        DynamicsEncoder.load(tmp_path / "other.safetensors")


def test_impossible_sizes_are_named():
    with pytest.raises(UserError, match="width"):
        Projector(width=50)
    with pytest.raises(UserError, match="flow_size"):
        DynamicsEncoder(FlowVAE(8), flow_size=30)
    with pytest.raises(UserError, match="flow_encoding"):
        DynamicsEncoder(FlowVAE(8), flow_encoding="rainbow")
