"""The flow VAE keeps CogVideoX's contract, sees no future, learns, and survives its file."""

import sys

import pytest
import torch

from neuido.errors import UserError
from neuido.models.video.flow_vae import FlowVAE
from neuido.models.video.video_vae import open_vae


@pytest.mark.parametrize("frames", [1, 2, 5, 8, 9, 16, 17])
def test_contract(frames):
    vae = FlowVAE(8)
    latent = vae.encode(torch.rand(2, 3, frames, 32, 48))
    assert latent.shape == (2, 16, (frames - 1) // 4 + 1, 4, 6)
    assert vae.decode(latent).shape == (2, 3, 4 * latent.shape[2] - 3, 32, 48)


def test_it_sees_no_future():
    torch.manual_seed(0)
    vae = FlowVAE(8).eval()
    video = torch.rand(1, 3, 17, 16, 16)
    other = video.clone()
    other[:, :, 9:] = 0
    a, b = vae.encode(video), vae.encode(other)
    assert torch.allclose(a[:, :, :3], b[:, :, :3], atol=1e-6)  # frames up to 8
    assert (a[:, :, 3:] - b[:, :, 3:]).abs().max() > 1e-4


@pytest.mark.slow
def test_it_learns():
    torch.manual_seed(0)
    vae = FlowVAE(16)
    ramp = torch.linspace(-1, 1, 16)
    video = torch.stack([a * ramp[:, None] * ramp for a in torch.linspace(0.2, 1, 4)])[:, None, None].expand(4, 3, 5, 16, 16)
    optimizer = torch.optim.AdamW(vae.parameters(), lr=2e-3)
    first = (vae.reconstruct(vae.posterior(video)[0]) - video).square().mean().item()
    for _ in range(90):
        error = (vae.reconstruct(vae.posterior(video)[0]) - video).square().mean()
        optimizer.zero_grad()
        error.backward()
        optimizer.step()
    assert error < 0.05 * first
    mean = vae.posterior(video)[0].detach()
    vae.normalise(mean)
    assert vae.encode(video).std().item() == pytest.approx(1.0, rel=1e-4)


def test_file(tmp_path):
    vae = FlowVAE(8)
    vae.scale.fill_(0.5)
    vae.save(tmp_path / "vae.safetensors", {"note": "a test"})
    loaded = open_vae(tmp_path / "vae.safetensors")
    video = torch.rand(1, 3, 5, 16, 16)
    assert torch.equal(vae.encode(video), loaded.encode(video))
    assert loaded.card["note"] == "a test"
    assert not any(p.requires_grad for p in loaded.parameters())
    (tmp_path / "wrong.safetensors").write_bytes(b"nothing")
    for path in ("missing.safetensors", "wrong.safetensors"):
        with pytest.raises(UserError, match=path):
            open_vae(tmp_path / path)


def test_wrong_shapes_are_named():
    with pytest.raises(UserError, match="multiples of 8"):
        FlowVAE(8).encode(torch.rand(1, 3, 5, 20, 16))
    with pytest.raises(UserError, match="multiple of 8"):
        FlowVAE(12)


def test_cogvideox_without_diffusers_is_one_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "diffusers", None)
    with pytest.raises(UserError, match=r"neuido\[video\]"):
        open_vae("cogvideox:THUDM/CogVideoX-5b")


def test_cogvideox_has_the_same_contract(tmp_path):
    diffusers = pytest.importorskip("diffusers")
    torch.manual_seed(0)
    whole = diffusers.AutoencoderKLCogVideoX(
        block_out_channels=(8, 8, 8, 8), layers_per_block=1, norm_num_groups=2, sample_height=32, sample_width=32
    )
    whole.save_pretrained(tmp_path / "vae")
    vae = open_vae(f"cogvideox:{tmp_path}")
    latent = vae.encode(torch.rand(1, 3, 9, 32, 32))
    assert latent.shape == (1, 16, 3, 4, 4)
    assert vae.channels == 16
