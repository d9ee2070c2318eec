"""The 3D VAE of a flow encoder: neuido's own small one, or CogVideoX's (Tora's) through diffusers, behind one interface."""

import os
from pathlib import Path
from typing import Protocol

import torch
from torch import Tensor, nn

from neuido.errors import UserError
from neuido.models.video.flow_vae import FlowVAE

PREFIX = "cogvideox:"
PRETRAINED = Path(__file__).parents[1] / "weights" / "stage2.safetensors"


class VideoVAE(Protocol):
    """What turns a video into latents; frozen."""

    channels: int
    """Latent channels."""

    def encode(self, video: Tensor) -> Tensor:
        """Encode videos, (B, 3, T, H, W) in [-1, 1] -> (B, channels, T', H/8, W/8), T' = floor((T - 1) / 4) + 1."""
        ...


class CogVideoXVAE(nn.Module):
    """CogVideoX's encoder, the one that Tora encodes flow with; nothing of its decoder is kept.

    Args:
        source: A folder in diffusers' layout (config.json, *.safetensors), or a name on the Hugging Face hub such as
            `THUDM/CogVideoX-5b`, whose licence applies.
        subfolder: Where it lies in there; `vae` for a whole pipeline.

    Raises:
        UserError: diffusers is not installed, or there are no such weights.
    """

    def __init__(self, source: str, subfolder: str | None = None):
        super().__init__()
        try:
            from diffusers import AutoencoderKLCogVideoX  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            raise UserError("the CogVideoX VAE needs diffusers: pip install 'neuido[video]', or leave vae at its default") from error
        local = Path(source).expanduser()
        if subfolder is None and (not local.is_dir() or (local / "vae").is_dir()):
            subfolder = "vae"
        try:
            whole = AutoencoderKLCogVideoX.from_pretrained(local if local.is_dir() else source, subfolder=subfolder, use_safetensors=True)
        except (OSError, ValueError) as error:
            raise UserError(f"vae = {PREFIX}{source}: there is no CogVideoX VAE: {error}") from error
        self.inner = whole
        self.inner.decoder = nn.Identity()  # half of the memory
        self.channels = int(whole.config.latent_channels)
        self.factor = float(whole.config.scaling_factor)

    @torch.no_grad()
    def encode(self, video: Tensor) -> Tensor:
        """Return mean latents times the file's scaling factor, one video at a time."""
        like = next(self.inner.parameters())
        rows = [self.inner.encode(clip[None].to(like)).latent_dist.mean for clip in video]
        return self.factor * torch.cat(rows).to(video.dtype)


def open_vae(source: str | os.PathLike) -> FlowVAE | CogVideoXVAE:
    """Open a VAE, frozen.

    Args:
        source: A file of `FlowVAE.save`; `pretrained`, the one that comes with neuido; or `cogvideox:` and a folder or the name of
            a repository on the hub.

    Raises:
        UserError: Neither is there.
    """
    name = str(source)
    vae = (
        CogVideoXVAE(name.removeprefix(PREFIX)) if name.startswith(PREFIX) else FlowVAE.load(PRETRAINED if name == "pretrained" else source)
    )
    return vae.eval().requires_grad_(False)
