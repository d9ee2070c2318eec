"""A small causal 3D-convolutional VAE for flow videos, with the interface of the CogVideoX VAE (which Tora uses).

Videos have three channels; latents have 16 channels and T' = floor((T - 1) / 4) + 1 frames of H/8 x W/8. Every convolution uses only past
and present frames, so later frames do not change the latents of earlier ones.
"""

import json
import os
from collections.abc import Callable, Mapping
from datetime import date
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor, nn
from torch.nn import functional

from neuido.data.files.missing_weights import weights_hint
from neuido.data.files.values import mapping
from neuido.data.weight_files import build, parse_metadata, read_safetensors, write_safetensors
from neuido.errors import UserError

FORMAT = "neuido-flow-vae/1"
ENCODER_FORMAT = "neuido-encoder/2"
"""Format of `encoder.DynamicsEncoder`, whose files hold a VAE in addition to the projector, and a reader or none."""
ENCODER_FORMATS = (ENCODER_FORMAT, "neuido-encoder/1")
"""Formats of encoders that can be read; those of the first version have no reader."""
CHANNELS = 16
"""Number of latent channels, as in CogVideoX."""


class CausalConv3d(nn.Module):
    """Causal convolution of (B, C, T, H, W), padded in time by copies of the first frame and in space by zeros."""

    def __init__(self, inputs: int, outputs: int, *, stride: tuple[int, int, int] = (1, 1, 1)):
        super().__init__()
        self.conv = nn.Conv3d(inputs, outputs, 3, stride=stride, padding=(0, 1, 1))

    def forward(self, x: Tensor) -> Tensor:
        return self.conv(torch.cat([x[:, :, :1]] * 2 + [x], 2))


class Residual(nn.Module):
    """Residual block of two causal convolutions, normalised frame by frame to preserve causality."""

    def __init__(self, channels: int):
        super().__init__()
        self.norm1, self.norm2 = nn.GroupNorm(8, channels), nn.GroupNorm(8, channels)
        self.conv1, self.conv2 = CausalConv3d(channels, channels), CausalConv3d(channels, channels)

    def forward(self, x: Tensor) -> Tensor:
        h = self.conv1(functional.silu(frame_by_frame(self.norm1, x)))
        return x + self.conv2(functional.silu(frame_by_frame(self.norm2, h)))


class Activation(nn.Module):
    """SiLU of a normalised input; without the norm a bad step can leave all channels in the flat part of SiLU for good."""

    def __init__(self, channels: int):
        super().__init__()
        self.norm = nn.GroupNorm(8, channels)

    def forward(self, x: Tensor) -> Tensor:
        return functional.silu(frame_by_frame(self.norm, x))


def frame_by_frame(layer: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """Apply an image layer to each frame of (B, C, T, H, W)."""
    flat = x.transpose(1, 2).flatten(0, 1)
    return layer(flat).unflatten(0, (x.shape[0], x.shape[2])).transpose(1, 2)


class FlowVAE(nn.Module):
    """Causal VAE for flow videos.

    Args:
        width: Number of channels of the inner layers, a multiple of 8.
        latent_channels: Number of latent channels (CogVideoX: 16).
        last_norm: Normalise before the last convolutions of encoder and decoder.

    Attributes:
        scale: Factor that scales latents to unit variance, like `scaling_factor` of CogVideoX; set by `normalise`.
        card: Information on the training from the weights file.
    """

    def __init__(self, width: int = 32, latent_channels: int = CHANNELS, last_norm: bool = True):
        super().__init__()
        if width < 8 or width % 8 or latent_channels < 1:
            raise UserError(f"width = {width} must be a multiple of 8, and latent_channels = {latent_channels} at least 1")
        self.config = {"width": width, "latent_channels": latent_channels, "last_norm": last_norm}
        self.channels = latent_channels
        last = CausalConv3d(2 * width, 2 * latent_channels)
        self.encoder = nn.Sequential(
            CausalConv3d(12, width),
            Residual(width),
            CausalConv3d(width, 2 * width, stride=(2, 2, 2)),
            Residual(2 * width),
            CausalConv3d(2 * width, 2 * width, stride=(2, 2, 2)),
            Residual(2 * width),
            *([Activation(2 * width)] if last_norm else []),
            last,
        )
        self.decoder = nn.ModuleList(
            [
                CausalConv3d(latent_channels, 2 * width),
                Residual(2 * width),
                CausalConv3d(2 * width, 2 * width),
                Residual(2 * width),
                CausalConv3d(2 * width, width),
                Residual(width),
                Activation(width) if last_norm else nn.SiLU(),
                CausalConv3d(width, 12),
            ]
        )
        assert last.conv.bias is not None  # as is usual of a convolution
        with torch.no_grad():  # little noise at first; otherwise the decoder learns to ignore the latent
            last.conv.bias[latent_channels:] = -6.0
            last.conv.weight[latent_channels:] *= 0.1
        self.scale: Tensor
        self.register_buffer("scale", torch.ones(()))
        self.card: dict[str, Any] = {}

    def posterior(self, video: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and log variance of the unscaled latents, (B, 16, T', H/8, W/8) each, of videos (B, 3, T, H, W) in [-1, 1].

        Raises:
            UserError: The shape is wrong, or height or width is not a multiple of 8.
        """
        if video.ndim != 5 or video.shape[1] != 3 or video.shape[-1] % 8 or video.shape[-2] % 8:
            raise UserError(f"a flow video must be (B, 3, T, H, W) with H and W multiples of 8, got {tuple(video.shape)}; change flow_size")
        squares = frame_by_frame(
            lambda frame: functional.pixel_unshuffle(frame, 2), video
        )  # full resolution is the most expensive and adds little
        mean, variance = self.encoder(squares).chunk(2, 1)
        return mean, variance.clamp(-20, 2)

    def encode(self, video: Tensor) -> Tensor:
        """Encode videos (B, 3, T, H, W) in [-1, 1] to scaled mean latents (B, 16, T', H/8, W/8), T' = floor((T - 1) / 4) + 1."""
        return self.scale * self.posterior(video)[0]

    def decode(self, latent: Tensor) -> Tensor:
        """Decode scaled latents to videos (B, 3, 4 T' - 3, H, W)."""
        return self.reconstruct(latent / self.scale)

    def reconstruct(self, latent: Tensor) -> Tensor:
        """Decode unscaled latents to videos."""
        first, before, middle, after, narrow, last, active, out = self.decoder
        h = before(first(latent))
        h = after(middle(_upsample(h)))
        h = last(narrow(_upsample(h)))
        return frame_by_frame(lambda frame: functional.pixel_shuffle(frame, 2), out(active(h)))

    @torch.no_grad()
    def normalise(self, latents: Tensor) -> None:
        """Set `scale` from unscaled mean latents."""
        self.scale.copy_(1 / latents.std().clamp(min=1e-6))

    def save(self, path: str | os.PathLike, card: Mapping[str, Any] | None = None) -> None:
        """Write weights and card to a safetensors file atomically."""
        tensors = {name: t.detach().contiguous().cpu() for name, t in self.state_dict().items()}
        card = {"date": date.today().isoformat(), **(card or {})}
        write_weights(path, FORMAT, self.config, tensors, card)

    @classmethod
    def load(cls, path: str | os.PathLike) -> Self:
        """Load a file of `save`, or the VAE from the file of an encoder.

        Raises:
            UserError: The file is missing or has another format.
        """
        config, tensors, card = read_weights(path, (FORMAT, *ENCODER_FORMATS), "vae")
        if "projector" in config:
            if config.get("vae") is None:
                raise UserError(f"vae: {path} holds no VAE: its encoder uses {config.get('source')!r}")
            config, card = mapping(config["vae"], f"{path}: vae"), {}
            tensors = {name.removeprefix("vae."): t for name, t in tensors.items() if name.startswith("vae.")}
        vae = build(cls, config, tensors, path)
        vae.card = card
        return vae


def _upsample(x: Tensor) -> Tensor:
    """Upsample by two in space, and in time from T' to 2 T' - 1 frames, the inverse of a causal stride of two."""
    return functional.interpolate(x, scale_factor=(2, 2, 2))[:, :, 1:]


def write_weights(
    path: str | os.PathLike, kind: str, config: Mapping[str, Any], tensors: dict[str, Tensor], card: Mapping[str, Any]
) -> None:
    """Write a safetensors file with its format, configuration and card atomically."""
    write_safetensors(path, tensors, {"format": kind, "config": json.dumps(dict(config)), "card": json.dumps(dict(card))})


def read_weights(path: str | os.PathLike, kinds: tuple[str, ...], option: str) -> tuple[dict[str, Any], dict[str, Tensor], dict[str, Any]]:
    """Read configuration, tensors and card from a file of `write_weights`.

    Args:
        path: The file.
        kinds: Accepted formats.
        option: Name of the option that errors mention.

    Raises:
        UserError: The file is missing or has another format.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"{option}: the weights {path} are missing: {weights_hint(path, option)}")
    try:
        tensors, metadata = read_safetensors(path)
    except UserError as error:
        raise UserError(f"{option}: {error}") from error
    if metadata.get("format") not in kinds:
        raise UserError(f"{option}: {path} has format {metadata.get('format')!r}, not {' or '.join(map(repr, kinds))}")
    return parse_metadata(metadata, "config", path), tensors, parse_metadata(metadata, "card", path)
