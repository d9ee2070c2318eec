"""3D VAEs for flow videos behind one interface: a small VAE that ships with neuido, or that of CogVideoX (as in Tora) from diffusers."""

import os
from pathlib import Path
from typing import Protocol

import torch
from torch import Tensor, nn

from neuido.errors import UserError
from neuido.models.video.flow_vae import FlowVAE

PREFIX = "cogvideox:"
PRETRAINED = Path(__file__).parents[1] / "weights" / "stage2_bounded.safetensors"


class VideoVAE(Protocol):
    """Frozen encoder of videos into latents."""

    channels: int
    """Number of latent channels."""

    def encode(self, video: Tensor) -> Tensor:
        """Encode videos, (B, 3, T, H, W) in [-1, 1] -> (B, channels, T', H/8, W/8), T' = floor((T - 1) / 4) + 1."""
        ...


class CogVideoXVAE(nn.Module):
    """Encoder of the CogVideoX VAE, with which Tora encodes flow; the decoder is discarded.

    Args:
        source: Folder in the layout of diffusers (config.json, *.safetensors), or a name on the Hugging Face hub such as
            `THUDM/CogVideoX-5b`, whose licence applies.
        subfolder: Subfolder of the VAE; `vae` for a whole pipeline.

    Raises:
        UserError: diffusers is not installed, or the weights are missing.
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
        self.inner.decoder = nn.Identity()  # saves half of the memory
        self.channels = int(whole.config.latent_channels)
        self.factor = float(whole.config.scaling_factor)

    @torch.no_grad()
    def encode(self, video: Tensor) -> Tensor:
        """Return the mean latents times the scaling factor of the weights, encoding one video at a time."""
        like = next(self.inner.parameters())
        rows = [self.inner.encode(clip[None].to(like)).latent_dist.mean for clip in video]
        return self.factor * torch.cat(rows).to(video.dtype)


def open_vae(source: str | os.PathLike) -> FlowVAE | CogVideoXVAE:
    """Open a frozen VAE.

    Args:
        source: A file of `FlowVAE.save`; `pretrained`, which ships with neuido; or `cogvideox:` followed by a folder or the name of a
            repository on the Hugging Face hub.

    Raises:
        UserError: The VAE is missing.
    """
    name = str(source)
    vae = (
        CogVideoXVAE(name.removeprefix(PREFIX)) if name.startswith(PREFIX) else FlowVAE.load(PRETRAINED if name == "pretrained" else source)
    )
    return vae.eval().requires_grad_(False)
