"""The reader: a distribution of material family and properties from flow latents (not in the paper).

Views are encoded separately; the mean of their features gives one distribution for all of them. Training draws the number of views, so
that the spread that is predicted is right for one view and for several. Each family has its own mean and standard deviation of each
property: what is said of a property holds if the family is right.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from neuido.data.files.values import with_prefix
from neuido.errors import UserError
from neuido.models.video.material_properties import SYMBOLS, UNITS, from_scale
from neuido.models.video.pooling import AttentionPool, positions

COVERAGE = 0.9
"""Probability of the intervals that are printed."""
NORMAL = 1.6449
"""Half width of the central 90 % of a normal distribution, in standard deviations."""
FAMILIAR = 0.99
"""Share of held-out training-like videos that count as like the training."""
NARROWEST, WIDEST = -4.0, 1.5
"""Bounds of the logarithm of a predicted standard deviation, relative to the spread over the training clips."""


class Reading(NamedTuple):
    """One property of a material, as read from a video."""

    name: str
    """`young`, `poisson`, `yield_stress`, `friction_angle` or `viscosity`."""
    value: float
    """Median."""
    low: float
    """Lower end of the 90 % interval."""
    high: float
    """Upper end of the 90 % interval."""
    unit: str

    def __str__(self) -> str:
        def shown(value: float) -> str:
            if self.unit.startswith("Pa"):
                return with_prefix(value, self.unit)
            return f"{value:.3g}{'' if self.unit == '°' else ' ' if self.unit else ''}{self.unit}"

        return f"{SYMBOLS[self.name]} = {shown(self.value)} (90 %: {shown(self.low)} to {shown(self.high)})"


class Readings(NamedTuple):
    """What an encoder reads of a material from a video."""

    families: dict[str, float]
    """Probability of each family, the largest first."""
    properties: tuple[Reading, ...]
    """Properties that the most probable family has, with their 90 % intervals."""
    novelty: float
    """Mahalanobis distance of the video's features from those of the training videos [-]."""
    limit: float
    """Novelty below which 99 % of held-out videos like the training ones lie [-]."""

    @property
    def family(self) -> str:
        """The most probable family."""
        return next(iter(self.families))

    @property
    def unlike(self) -> bool:
        """Whether the video is unlike the training videos, so that the intervals promise nothing."""
        return self.novelty > self.limit

    def __getitem__(self, name):  # type: ignore[override]
        """Return the reading of a property by its name, or a field by its index."""
        if isinstance(name, str):
            return next(one for one in self.properties if one.name == name)
        return tuple.__getitem__(self, name)

    def lines(self) -> list[str]:
        """Return a line for the family, one for each property, and a warning if the video is unlike the training videos."""
        shown = [f"{name} ({100 * share:.0f} %)" for name, share in self.families.items() if share >= 0.01]
        out = [f"family: {', '.join(shown)}", *map(str, self.properties)]
        if self.unlike:
            out.append(
                f"warning: the video is unlike the training videos (distance {self.novelty:.3g}, usual at most {self.limit:.3g}): "
                "do not trust these numbers"
            )
        return out

    def as_dict(self) -> dict[str, object]:
        """Return the readings as JSON can hold them."""
        properties = {one.name: {"value": one.value, "low": one.low, "high": one.high, "unit": one.unit} for one in self.properties}
        return {"families": self.families, "properties": properties, "novelty": self.novelty, "limit": self.limit, "unlike": self.unlike}

    def __repr__(self) -> str:
        return f"Readings({'; '.join(self.lines())})"


class Distribution(NamedTuple):
    """Predictions for B bodies, on the standardised scale of the properties."""

    logits: Tensor
    """(B, families)."""
    mean: Tensor
    """Of each property if the family is right, (B, families, properties)."""
    log_std: Tensor
    """(B, families, properties)."""


class Block(nn.Module):
    """Residual block of two 3D convolutions."""

    def __init__(self, width: int):
        super().__init__()
        self.norm1, self.norm2 = nn.GroupNorm(8, width), nn.GroupNorm(8, width)
        self.conv1, self.conv2 = nn.Conv3d(width, width, 3, padding=1), nn.Conv3d(width, width, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.conv2(functional.silu(self.norm2(self.conv1(functional.silu(self.norm1(x))))))


class Reader(nn.Module):
    """Network that maps flow latents of V views to a distribution of family and properties.

    Args:
        families: Names of the families.
        properties: Names of the properties.
        channels: Number of channels of the flow latents.
        width: Width of the features, a multiple of 48.
        heads: Number of heads of the attention pooling.
        dropout: Dropout rate of the features.

    Attributes (stored with the weights):
        centre, spread: Mean and standard deviation of each property over the training clips, on the scale of `to_scale`.
        known: Which family has which property, (families, properties).
        temperature: Divisor of the logits, from held-out clips.
        interval_scale: Factor on the standard deviation of each property, from held-out clips.
        usual, whitening, limit: Mean and inverse root covariance of the features of training views, and the largest usual distance.

    Raises:
        UserError: A name is unknown, or a size is wrong.
    """

    def __init__(
        self,
        families: Sequence[str],
        properties: Sequence[str] = tuple(UNITS),
        channels: int = 16,
        width: int = 192,
        heads: int = 4,
        dropout: float = 0.0,
    ):
        super().__init__()
        if not families or not properties or not set(properties) <= set(UNITS):
            raise UserError(
                f"a reader needs families, and properties among {', '.join(UNITS)}; got {list(families)} and {list(properties)}"
            )
        if width < 48 or width % 48 or width % heads or channels < 1:
            raise UserError(f"width = {width} must be a multiple of 48 and of heads = {heads}, and channels = {channels} at least 1")
        self.families, self.properties = tuple(map(str, families)), tuple(map(str, properties))
        self.config = {"families": list(families), "properties": list(properties), "channels": channels, "width": width, "heads": heads}
        self.entry = nn.Conv3d(channels, width // 2, 3, padding=1)
        self.film = nn.Sequential(nn.Linear(2, width), nn.SiLU(), nn.Linear(width, 2 * width))
        self.down = nn.Conv3d(width // 2, width, 3, stride=2, padding=1)
        self.blocks = nn.Sequential(Block(width), Block(width))
        self.norm, self.dropout = nn.LayerNorm(width), nn.Dropout(dropout)
        self.pool = AttentionPool(width, heads)
        self.features = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, width), nn.SiLU())
        outputs = len(families) * len(properties)
        self.family = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, len(families)))
        self.property = nn.Sequential(nn.Linear(width, 2 * width), nn.SiLU(), nn.Linear(2 * width, 2 * outputs))
        self.centre: Tensor
        self.spread: Tensor
        self.known: Tensor
        self.temperature: Tensor
        self.interval_scale: Tensor
        self.usual: Tensor
        self.whitening: Tensor
        self.limit: Tensor
        self.register_buffer("centre", torch.zeros(len(properties)))
        self.register_buffer("spread", torch.ones(len(properties)))
        self.register_buffer("known", torch.ones(len(families), len(properties)))
        self.register_buffer("temperature", torch.ones(()))
        self.register_buffer("interval_scale", torch.ones(len(properties)))
        self.register_buffer("usual", torch.zeros(width + 2))
        self.register_buffer("whitening", torch.eye(width + 2))
        self.register_buffer("limit", torch.full((), 1e6))

    def describe(self, volume: Tensor, conditions: Tensor) -> Tensor:
        """Return the features of each view (N, width) from flow latents (N, channels, T', h, w) and conditions (N, 2)."""
        x = functional.silu(self.entry(volume))
        x = self.down(x)
        gain, shift = self.film(conditions)[..., None, None, None].chunk(2, 1)
        x = self.blocks(x * (1 + gain) + shift + positions(x))
        return self.features(self.pool(self.dropout(self.norm(x.flatten(2).transpose(1, 2)))))

    def forward(self, volume: Tensor, conditions: Tensor) -> Distribution:
        """Return one distribution for each of B bodies from V views: latents (B, V, channels, T', h, w) and conditions (B, V, 2)."""
        features = self.describe(volume.flatten(0, 1), conditions.flatten(0, 1)).unflatten(0, volume.shape[:2]).mean(1)
        return self.predict(features)

    def predict(self, features: Tensor) -> Distribution:
        """Return the distributions of mean features (B, width)."""
        features = self.dropout(features)
        found = self.property(features).unflatten(1, (2, len(self.families), len(self.properties)))
        return Distribution(self.family(features), found[:, 0], found[:, 1].clamp(NARROWEST, WIDEST))

    def loss(self, found: Distribution, family: Tensor, target: Tensor, present: Tensor) -> Tensor:
        """Return the loss of B bodies: cross entropy of the family and negative log likelihood of the properties.

        The likelihood of a property is weighted by its predicted standard deviation, held constant, so that what is hard to read keeps its
        share of the gradient (Seitzer et al. 2022, beta = 0.5).

        Args:
            found: Predictions.
            family: Index of the true family, (B,).
            target: True properties, standardised, (B, properties).
            present: Which properties the material has, (B, properties), 0 or 1.
        """
        row = torch.arange(len(family), device=family.device)
        mean, log_std = found.mean[row, family], found.log_std[row, family]
        likelihood = 0.5 * ((target - mean) * (-log_std).exp()).square() + log_std
        weighted = log_std.detach().exp() * likelihood * present
        return functional.cross_entropy(found.logits, family) + weighted.sum() / present.sum().clamp(min=1)

    # Calibration, on clips that training did not use.

    @torch.no_grad()
    def calibrate(self, found: Distribution, family: Tensor, target: Tensor, present: Tensor) -> None:
        """Set temperature and interval scales from held-out clips; the arguments are those of `loss`.

        A temperature is the one of least cross entropy. An interval scale makes the intervals of the most probable family cover 90 %.
        """
        grid = torch.logspace(-0.5, 1.0, 61, device=family.device)
        losses = torch.stack([functional.cross_entropy(found.logits / t, family) for t in grid])
        self.temperature.copy_(grid[losses.argmin()])
        row, chosen = torch.arange(len(family), device=family.device), found.logits.argmax(1)
        valid = present.bool() & self.known[chosen].bool()
        error = ((target - found.mean[row, chosen]) * (-found.log_std[row, chosen]).exp()).abs() / NORMAL
        for p in range(len(self.properties)):
            own = error[valid[:, p], p]
            if len(own) >= MINIMUM:
                rank = min(len(own), math.ceil(COVERAGE * (len(own) + 1)))  # as in split conformal prediction
                self.interval_scale[p] = own.sort().values[rank - 1]

    @torch.no_grad()
    def familiarise(self, training: Tensor, held_out: Tensor) -> None:
        """Set what counts as unlike the training from features and conditions of single views, (N, width + 2) each.

        The covariance is shrunk towards its diagonal by a tenth, as there are hardly more clips than features.
        """
        mean = training.mean(0)
        covariance = torch.cov(training.double().T)
        covariance = 0.9 * covariance + 0.1 * covariance.diagonal().diag() + 1e-6 * torch.eye(len(mean)).to(covariance)
        values, vectors = torch.linalg.eigh(covariance)
        self.usual.copy_(mean)
        self.whitening.copy_((vectors * values.clamp(min=1e-9).rsqrt()) @ vectors.T)
        self.limit.copy_(torch.quantile(self.distance(held_out), FAMILIAR))

    def distance(self, features: Tensor) -> Tensor:
        """Return the Mahalanobis distances (N,) of features and conditions of views (N, width + 2), over the root of their number."""
        return ((features - self.usual) @ self.whitening).norm(dim=1) / features.shape[1] ** 0.5

    @torch.no_grad()
    def read(self, volume: Tensor, conditions: Tensor) -> Readings:
        """Return the readings of one body from latents (V, channels, T', h, w) and conditions (V, 2) of its views; call it in eval mode."""
        views = self.describe(volume, conditions)
        found = self.predict(views.mean(0, keepdim=True))
        shares = (found.logits[0] / self.temperature).softmax(0).tolist()
        order = sorted(range(len(shares)), key=lambda f: -shares[f])
        chosen = order[0]
        readings = []
        for p, name in enumerate(self.properties):
            if not bool(self.known[chosen, p]):
                continue
            centre, spread = float(self.centre[p]), float(self.spread[p])
            mean = centre + spread * float(found.mean[0, chosen, p])
            half = NORMAL * spread * float(found.log_std[0, chosen, p].exp() * self.interval_scale[p])
            value, low, high = (from_scale(name, mean + sign * half) for sign in (0, -1, 1))
            low, high = (min(max(end, LOWEST.get(name, end)), HIGHEST.get(name, end)) for end in (low, high))
            readings.append(Reading(name, value, low, high, UNITS[name]))
        novelty = float(self.distance(torch.cat([views, conditions.to(views)], 1)).mean())
        return Readings({self.families[f]: shares[f] for f in order}, tuple(readings), novelty, float(self.limit))


MINIMUM = 10
"""Least number of held-out clips from which an interval scale is taken."""
LOWEST, HIGHEST = {"poisson": -1.0, "friction_angle": 0.0}, {"poisson": 0.5, "friction_angle": 90.0}
"""Ends beyond which a property has no meaning."""
