"""The dynamics encoder: from a video to the latent z of its material (paper, "Model Architecture Details", branch network).

The frozen 3D VAE (`video_vae.py`) encodes flow videos as a volume of latents. The projector (a 3D convolution, an MLP, attention pooling
and a final MLP) maps the volume to z. Views are encoded separately, and their z are averaged. An encoder of the warm-up over all families
has a reader too (`reader.py`; not in the paper), which predicts a distribution of family and material properties from the same volume.
"""

import os
from collections.abc import Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Any, Literal, Protocol, Self

import torch
from torch import Tensor, nn

from neuido.data.files.parsing import naming
from neuido.data.files.values import mapping
from neuido.data.weight_files import build
from neuido.errors import UserError
from neuido.models.video.flow import ENCODINGS, Velocities, encode_flow, measure_velocities
from neuido.models.video.flow_vae import CHANNELS, ENCODER_FORMAT, ENCODER_FORMATS, FlowVAE, read_weights, write_weights
from neuido.models.video.pooling import AttentionPool, positions
from neuido.models.video.reader import Reader, Readings
from neuido.models.video.video_vae import PREFIX, CogVideoXVAE, open_vae
from neuido.types import MultiViewBatch

WEIGHTS = Path(__file__).parents[1] / "weights"
PRETRAINED = {
    "pretrained": WEIGHTS / "stage2_bounded.safetensors",
    "pretrained-small": WEIGHTS / "stage2_small_bounded.safetensors",
    "pretrained-small-objective": WEIGHTS / "stage2_small.safetensors",
}
REMOVED = "pretrained-objective"
"""An encoder of earlier versions; the operator of this name is still there."""
REFERENCE_INTERVAL, REFERENCE_CELL = 5e-3, 1e-2
"""Frame interval [s] and cell size [m] at which the two conditions of the projector are zero."""


class ReadsLatents(Protocol):
    """What an encoder must know of the operator that reads its latents."""

    latent_dim: int

    def fingerprint(self) -> str:
        """Identify the operator's weights."""
        ...


class Projector(nn.Module):
    """Network that maps flow latents to z; the trained part of the branch.

    Args:
        channels: Number of channels of the flow latents.
        latent_dim: Dimension d of z.
        width: Width of the convolution, the tokens and the MLPs (the paper does not say).
        heads: Number of heads of the attention pooling.
        conditions: Condition on the frame interval and the cell size. A video has no units of time and length, without which different
            stiffnesses look the same; the paper does not condition on them.
        dropout: Dropout rate of the tokens.

    Raises:
        UserError: A size is below one, or the width is not a multiple of heads and of 6.
    """

    def __init__(
        self,
        channels: int = CHANNELS,
        latent_dim: int = 128,
        width: int = 96,
        heads: int = 4,
        conditions: bool = True,
        dropout: float = 0.0,
    ):
        super().__init__()
        if min(channels, latent_dim, width, heads) < 1 or width % heads or width % 6:
            raise UserError(f"width = {width} must be a multiple of heads = {heads} and of 6; channels and latent_dim at least 1")
        if not 0 <= dropout < 1:
            raise UserError(f"dropout = {dropout} must lie in [0, 1)")
        self.config = {"channels": channels, "latent_dim": latent_dim, "width": width, "heads": heads, "conditions": conditions}
        self.conv = nn.Conv3d(channels, width, 3, padding=1)
        self.tokens = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, 2 * width), nn.SiLU(), nn.Linear(2 * width, width))
        self.clock = nn.Linear(2, width) if conditions else None
        self.dropout = nn.Dropout(dropout)
        self.pool = AttentionPool(width, heads)
        self.head = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, 2 * width), nn.SiLU(), nn.Linear(2 * width, latent_dim))

    def forward(self, volume: Tensor, conditions: Tensor) -> Tensor:
        """Return z of each view (V, d) from flow latents (V, channels, T', h, w) and conditions (V, 2) of `scale_conditions`."""
        x = self.conv(volume)
        x = (x + positions(x)).flatten(2).transpose(1, 2)
        x = x + self.tokens(x)
        if self.clock is not None:
            x = x + self.clock(conditions)[:, None]
        return self.head(self.pool(self.dropout(x)))

    @torch.no_grad()
    def start_near(self, latents: Tensor, spread: float = 0.1) -> None:
        """Initialise the output near the mean of latents, varying along the directions in which they vary.

        Args:
            latents: Latents of Stage I, (M, d).
            spread: Initial standard deviation of z relative to that of the latents.
        """
        last = self.head[-1]
        assert isinstance(last, nn.Linear)
        centred = latents - latents.mean(0)
        mix = torch.randn(len(latents), last.in_features, dtype=latents.dtype) / last.in_features**0.5
        last.weight.copy_(spread * centred.T @ mix / max(1, len(latents) - 1) ** 0.5)
        last.bias.copy_(latents.mean(0))


def scale_conditions(frame_interval: Tensor | float, cell: Tensor) -> Tensor:
    """Return the conditions of the projector, (V, 2): logarithms of frame interval and cell size over their reference values.

    Args:
        frame_interval: Frame interval [s], a number or (V,).
        cell: Side of a flow cell at the depth of the body [m], (V,).
    """
    interval = torch.as_tensor(frame_interval).to(cell).expand(len(cell))
    return torch.stack([(interval / REFERENCE_INTERVAL).log(), (cell / REFERENCE_CELL).log()], -1)


class DynamicsEncoder(nn.Module):
    """Encoder that infers the latent z of a material from videos of a body.

    Args:
        vae: Frozen VAE: a file of `FlowVAE.save`, `cogvideox:` and a folder or repository (`video_vae.open_vae`), or a module.
        latent_dim: Dimension d of z.
        flow_size: Side of the flow videos [px], a multiple of 8.
        flow_encoding: `velocity` (preserves the magnitude) or `wheel` (as in the paper, normalised frame by frame).
        speed_scale: Speed that is encoded as one [m/s].
        flow_preset: Preset of DIS: `ultrafast`, `fast` or `medium`.
        width, heads, conditions, dropout: Options of the `Projector`.

    Attributes:
        reader: Network that predicts family and properties of the material with their uncertainty; None in encoders without one.
        card: Information on the training from the weights file.
    """

    def __init__(
        self,
        vae: str | os.PathLike | FlowVAE | CogVideoXVAE,
        latent_dim: int = 128,
        flow_size: int = 64,
        flow_encoding: Literal["velocity", "wheel"] = "velocity",
        speed_scale: float = 2.0,
        flow_preset: str = "medium",
        width: int = 96,
        heads: int = 4,
        conditions: bool = True,
        dropout: float = 0.0,
    ):
        super().__init__()
        if flow_size < 16 or flow_size % 8:
            raise UserError(f"flow_size = {flow_size} must be a multiple of 8 of at least 16")
        if flow_encoding not in ENCODINGS:
            raise UserError(f"flow_encoding = {flow_encoding!r}; one of {', '.join(ENCODINGS)}")
        opened = vae if isinstance(vae, nn.Module) else open_vae(vae)
        self.source = None if isinstance(opened, FlowVAE) else str(vae)
        self.vae = opened.eval().requires_grad_(False)
        self.flow = {"flow_size": flow_size, "flow_encoding": flow_encoding, "speed_scale": speed_scale, "flow_preset": flow_preset}
        self.projector = Projector(opened.channels, latent_dim, width, heads, conditions, dropout)
        self.reader: Reader | None = None
        self.card: dict[str, Any] = {}

    def __repr__(self) -> str:
        sizes, flow = self.projector.config, self.flow
        vae = "FlowVAE" if self.source is None else self.source
        size = f"{flow['flow_size']} px flow, {flow['flow_encoding']}"
        return f"{type(self).__name__}(latent_dim={sizes['latent_dim']}, width={sizes['width']}, vae={vae}, {size})"

    def check_operator(self, operator: ReadsLatents, option: str, *, weights: bool = True) -> None:
        """Check that the latents have the operator's length, and were trained for its weights if the encoder's card says for which.

        Args:
            operator: The operator, without an adapter.
            option: Name of the option that the error mentions.
            weights: Whether to compare the weights too; a training that starts from an encoder of another operator does not.

        Raises:
            UserError: The lengths differ, or the encoder was trained for other weights.
        """
        given = self.projector.config["latent_dim"]
        if given != operator.latent_dim:
            raise UserError(
                f"{option} gives latents of length {given}, but the operator takes {operator.latent_dim}: use an encoder trained for it"
            )
        trained = self.card.get("operator")
        if weights and trained is not None and trained != (own := operator.fingerprint()):
            raise UserError(f"{option} was trained for operator {trained}, not for the given one, {own}: use two that belong together")

    def train(self, mode: bool = True) -> Self:
        """Set the training mode of all modules except the frozen VAE."""
        super().train(mode)
        self.vae.eval()
        return self

    @torch.no_grad()
    def embed(self, seen: Velocities) -> tuple[Tensor, Tensor]:
        """Return flow latents (V, channels, T', S/8, S/8) and conditions (V, 2), which stay constant while the projector is trained."""
        return self.embed_flow(seen.flow, seen.frame_interval, seen.cell)

    @torch.no_grad()
    def embed_flow(self, flow: Tensor, interval: Tensor | float, cell: Tensor, *, batch: int = 1) -> tuple[Tensor, Tensor]:
        """Return flow latents and conditions as `embed`, of N videos that may be of several scenes.

        Args:
            flow: Velocities [m/s], (N, T - 1, S, S, 2).
            interval: Frame interval [s], a number or (N,).
            cell: Side of a flow cell [m], (N,).
            batch: Videos that the VAE encodes at a time.
        """
        like = next(self.projector.parameters())
        options = {"encoding": self.flow["flow_encoding"], "speed_scale": self.flow["speed_scale"]}
        parts = [encode_flow(part.to(like.device, torch.float32), **options) for part in flow.split(batch)]
        volume = torch.cat([self.vae.encode(part) for part in parts])
        return volume.to(like), scale_conditions(interval, cell.to(like.device)).to(like)

    def measure_flow(
        self,
        batch: MultiViewBatch,
        views: Sequence[int],
        centre: Tensor,
        *,
        cache: str | os.PathLike | None = None,
        method: str = "opencv",
    ) -> Velocities:
        """Measure the velocities in the given views of a scene.

        Args:
            batch: The scene.
            views: Indices of the views.
            centre: Centre of the body [m], (3,).
            cache: Folder for cached optical flow.
            method: `opencv`, or `parallel` on the device of the encoder (`flow.optical_flow`).
        """
        views = list(views)
        cameras = batch.cameras._replace(viewmats=batch.cameras.viewmats[views], Ks=batch.cameras.Ks[views])
        options = {"size": self.flow["flow_size"], "preset": self.flow["flow_preset"], "cache": cache, "method": method}
        options["device"] = next(self.projector.parameters()).device
        images, masks = (
            [t[v] for v in views] for t in (batch.images, batch.masks)
        )  # views of the memory: a copy takes as long as the flow
        return measure_velocities(images, masks, batch.times, cameras, centre, **options)

    def forward(self, volume: Tensor, conditions: Tensor) -> Tensor:
        """Return z (d,) from flow latents and conditions: the mean of the projector output over the views."""
        return self.projector(volume, conditions).mean(0)

    @torch.no_grad()
    def read(self, volume: Tensor, conditions: Tensor) -> Readings | None:
        """Return what the reader says of the material, from flow latents and conditions of V views; None without a reader."""
        if self.reader is None:
            return None
        was_training = self.reader.training
        self.reader.eval()
        found = self.reader.read(volume, conditions)
        self.reader.train(was_training)
        return found

    def save(self, path: str | os.PathLike, card: Mapping[str, Any] | None = None) -> None:
        """Write projector, reader and VAE (only the name for CogVideoX) to a safetensors file atomically."""
        parts = {"projector": self.projector} | ({} if self.reader is None else {"reader": self.reader})
        tensors = {
            f"{part}.{name}": t.detach().contiguous().cpu() for part, module in parts.items() for name, t in module.state_dict().items()
        }
        if isinstance(self.vae, FlowVAE):
            tensors |= {f"vae.{name}": t.detach().contiguous().cpu() for name, t in self.vae.state_dict().items()}
        config = {"flow": self.flow, "projector": self.projector.config, "source": self.source, "vae": getattr(self.vae, "config", None)}
        if self.source is not None:
            config["vae"] = None
        config["reader"] = None if self.reader is None else self.reader.config
        write_weights(path, ENCODER_FORMAT, config, tensors, {"date": date.today().isoformat(), **(card or {})})

    @classmethod
    def from_pretrained(cls, name: str | os.PathLike = "pretrained") -> Self:
        """Load an encoder that ships with neuido (`pretrained`, `pretrained-small`), or a file of `save`.

        Raises:
            UserError: As in `load`.
        """
        return cls.load(name)

    @classmethod
    def load(cls, path: str | os.PathLike = "pretrained") -> Self:
        """Load a file of `save`, or an encoder that ships with neuido: `pretrained`, or `pretrained-small` for few, coarse frames on a CPU.

        `pretrained-small-objective` is the predecessor of the second, for the operator `pretrained-objective`.

        Raises:
            UserError: The file is missing, or it is not an encoder.
        """
        if str(path) == REMOVED and not Path(path).exists():
            raise UserError(f"encoder: {REMOVED} no longer comes with neuido: use pretrained, with the operator pretrained")
        file = PRETRAINED.get(str(path)) or Path(path)
        config, tensors, card = read_weights(file, ENCODER_FORMATS, "encoder")
        source = config.get("source")
        if source is not None and not (isinstance(source, str) and source.startswith(PREFIX)):
            raise UserError(f"encoder: {file}: source must begin with {PREFIX}, got {source!r}")
        flow, projector = (mapping(config.get(key), f"encoder: {file}: {key}") for key in ("flow", "projector"))
        own = {
            part: {name.removeprefix(f"{part}."): t for name, t in tensors.items() if name.startswith(f"{part}.")}
            for part in ("projector", "vae", "reader")
        }
        vae = source or build(FlowVAE, mapping(config.get("vae"), f"encoder: {file}: vae"), own["vae"], file)
        fitted = build(Projector, projector, own["projector"], file)
        with naming(file, "is no whole file of an encoder"):
            sizes = {key: fitted.config[key] for key in ("latent_dim", "width", "heads", "conditions")}
            encoder = cls(vae, **flow, **sizes)
        if encoder.projector.config != fitted.config:
            raise UserError(f"encoder: {file}: its projector takes {fitted.config['channels']} channels, its VAE {encoder.vae.channels}")
        encoder.projector, encoder.card = fitted, card
        if config.get("reader") is not None:
            encoder.reader = build(Reader, mapping(config["reader"], f"encoder: {file}: reader"), own["reader"], file)
            if encoder.reader.config["channels"] != encoder.vae.channels:
                raise UserError(
                    f"encoder: {file}: its reader takes {encoder.reader.config['channels']} channels, not {encoder.vae.channels}"
                )
        return encoder


Encoder = DynamicsEncoder
"""The short public name."""
