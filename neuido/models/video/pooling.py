"""Tokens of flow latents: their positions, and attention pooling; shared by projector and reader."""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional


class AttentionPool(nn.Module):
    """Attention pooling of tokens, (B, N, width) -> (B, width), with one learned query for each head."""

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.heads = heads
        self.query = nn.Parameter(torch.randn(1, 1, width) / width**0.5)
        self.key, self.value, self.out = nn.Linear(width, width), nn.Linear(width, width), nn.Linear(width, width)

    def forward(self, tokens: Tensor) -> Tensor:
        q, k, v = (t.unflatten(-1, (self.heads, -1)).transpose(1, 2) for t in (self.query, self.key(tokens), self.value(tokens)))
        pooled = functional.scaled_dot_product_attention(q.expand(len(tokens), -1, -1, -1), k, v)
        return self.out(pooled.transpose(1, 2).flatten(1))


def positions(x: Tensor) -> Tensor:
    """Return sinusoidal position encodings (1, C, T, H, W): space relative to the image, time in latent frames."""
    _, channels, T, H, W = x.shape
    axes = (torch.arange(T) / 8.0, (torch.arange(H) + 0.5) / H, (torch.arange(W) + 0.5) / W)
    share = channels // 6
    frequency = math.pi * 2.0 ** torch.linspace(0, 2, share)
    parts = []
    for a, axis in enumerate(axes):
        angle = frequency[:, None] * axis
        wave = torch.cat([angle.sin(), angle.cos()])
        shape = [1, 2 * share, 1, 1, 1]
        shape[2 + a] = len(axis)
        parts.append(wave.view(shape).expand(1, 2 * share, T, H, W))
    return torch.cat(parts, 1).to(x)
