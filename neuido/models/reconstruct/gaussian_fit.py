"""Reconstruction of the first frame as 3D Gaussians, optimised on images of several views (Kerbl et al. 2023).

The Gaussians are initialised on the visual hull of the masks, rendered by `splatting.rasterize`, and cloned, split and pruned as in 3DGS.
Colours are independent of the viewing direction (spherical harmonics of degree 0).
"""

import math
from typing import Any

import torch
from lightning.pytorch import LightningModule
from torch import Tensor, nn

from neuido.data.files.renamed_options import renamed_options
from neuido.errors import UserError
from neuido.models.reconstruct.filling import LEVEL, Volume, visual_hull
from neuido.models.render.gaussians import covariances_of, harmonics_of
from neuido.models.render.similarity import structural_similarity
from neuido.models.render.splatting import rasterize
from neuido.types import Cameras, Gaussians, MultiViewBatch, Vector

PARTS = ("means", "log_scales", "quaternions", "logits", "harmonics")
RATES = {"means": 1e-3, "log_scales": 1e-2, "quaternions": 3e-3, "logits": 5e-2, "harmonics": 2e-2}
"""Learning rates of Adam; that of the means is relative to the size of the body, and decays to a hundredth."""


@renamed_options(start="initial_gaussians", limit="max_gaussians", largest="max_scale")
class ReconstructModule(LightningModule):
    """Fit Gaussians to the first frame.

    The attribute `batch` of the data module holds the training views (`MultiViewBatch`; only the first frame is used). The items of its
    loader are ignored: the views of a step are derived from the step number, so a resumed run continues exactly as an uninterrupted one.

    Args:
        lower, upper: Corners of a box that contains the body [m].
        steps: Optimiser steps, which determine the schedules.
        initial_gaussians: Initial number of Gaussians.
        max_gaussians: Maximum number of Gaussians.
        views: Views in each step.
        lr: Factor on all learning rates.
        ssim: Weight of 1 - SSIM relative to L1 (3DGS: 0.2).
        silhouette: Weight of the L1 error between opacity and mask.
        densify_gradient: Mean gradient with respect to the projected centre, per half image, above which a Gaussian is cloned or split
            (3DGS: 2e-4).
        densify_every: Steps between densifications, which stop after three fifths of all steps.
        prune_opacity: Opacity below which a Gaussian is removed.
        max_scale: Maximum standard deviation relative to the size of the body; large Gaussians cannot follow a deformation.
        resolution: Cells of the hull along the longest side of the body.
        seed: Random seed.
    """

    def __init__(
        self,
        lower: Vector = (0.0, 0.0, 0.0),
        upper: Vector = (1.0, 1.0, 1.0),
        steps: int = 2000,
        initial_gaussians: int = 5000,
        max_gaussians: int = 25000,
        views: int = 4,
        lr: float = 1.0,
        ssim: float = 0.2,
        silhouette: float = 0.5,
        densify_gradient: float = 2e-4,
        densify_every: int = 100,
        prune_opacity: float = 0.05,
        max_scale: float = 0.02,
        resolution: int = 96,
        seed: int = 0,
    ):
        super().__init__()
        positive = {"steps": steps, "initial_gaussians": initial_gaussians, "views": views, "lr": lr, "densify_every": densify_every}
        for name, value in positive.items():
            if not value > 0:
                raise UserError(f"{name} = {value}: it must be positive")
        if max_gaussians < initial_gaussians:
            raise UserError(f"max_gaussians = {max_gaussians} is less than initial_gaussians = {initial_gaussians}")
        self.save_hyperparameters()
        shapes = {"means": (0, 3), "log_scales": (0, 3), "quaternions": (0, 4), "logits": (0,), "harmonics": (0, 1, 3)}
        self.means: nn.Parameter
        self.log_scales: nn.Parameter
        self.quaternions: nn.Parameter
        self.logits: nn.Parameter
        self.harmonics: nn.Parameter
        for name in PARTS:
            setattr(self, name, nn.Parameter(torch.empty(shapes[name])))
        self.gradient: Tensor
        self.count: Tensor
        self.size: Tensor
        self.register_buffer("gradient", torch.zeros(0))
        self.register_buffer("count", torch.zeros(()))
        self.register_buffer("size", torch.ones(()))
        self.hull: Volume | None = None
        self.length = self.half_per_depth = 1.0
        """Size of the body [m], and half images per tangent of the angle of view, on the host: asking the device in each step stops it."""

    def gaussians(self) -> Gaussians:
        """Return the current Gaussians, differentiable in the parameters."""
        covariances = covariances_of(self.log_scales.exp(), self.quaternions)
        return Gaussians(self.means, covariances, self.logits.sigmoid(), self.harmonics)

    def render(self, cameras: Cameras, background: Tensor) -> tuple[Tensor, Tensor]:
        """Return images (V, H, W, 3) over the background (3,), and alphas (V, H, W)."""
        g = self.gaussians()
        return rasterize(g.means, g.covariances, g.opacities, g.harmonics, *cameras, sh_degree=0, background=background)

    def setup(self, stage: str) -> None:
        """Carve the hull, and initialise the Gaussians on it."""
        batch = self.trainer.datamodule.batch
        self.batch = _first_frame(batch, self.trainer.strategy.root_device)  # the module itself is moved to it only after `setup`
        masks, cameras = self.batch.masks[:, 0], self.batch.cameras
        self.hull = visual_hull(masks, cameras, self.hparams.lower, self.hparams.upper, resolution=self.hparams.resolution)
        if not len(self.means):
            self._initialise()

    @torch.no_grad()
    def _initialise(self) -> None:
        assert self.hull is not None
        generator = torch.Generator().manual_seed(self.hparams.seed)
        hull = self.hull
        inside = hull.values > LEVEL
        eroded = -torch.nn.functional.max_pool3d(-inside[None, None].float(), 3, 1, 1)[0, 0] > 0
        surface = (inside & ~eroded).nonzero()
        picked = torch.randint(len(surface), (self.hparams.initial_gaussians,), generator=generator).to(surface.device)
        jitter = torch.rand(len(picked), 3, generator=generator).to(surface.device)
        x = hull.lower + hull.spacing * (surface[picked] + jitter)
        near = math.sqrt(len(surface) * hull.spacing**2 / len(x))  # spacing of the Gaussians on the surface
        self.size.copy_((hull.centres()[inside].amax(0) - hull.centres()[inside].amin(0)).norm())
        new = {
            "means": x,
            "log_scales": torch.full_like(x, math.log(0.6 * near)),
            "quaternions": torch.nn.functional.normalize(torch.randn(len(x), 4, generator=generator)).to(x),
            "logits": torch.full_like(x[:, 0], 1.0),
            "harmonics": harmonics_of(self._colours_on(x, hull)),
        }
        for name in PARTS:
            setattr(self, name, nn.Parameter(new[name].contiguous()))
        self.gradient = torch.zeros(len(x), device=x.device)

    def _colours_on(self, x: Tensor, hull: Volume) -> Tensor:
        """Return the colours of points on the hull (N, 3), as a mean over the views that face them."""
        step = hull.spacing
        normal = torch.stack([hull.at(x - step * e) - hull.at(x + step * e) for e in torch.eye(3, device=x.device)], 1)
        total, weights = torch.full_like(x, 1e-6), torch.full_like(x[:, :1], 2e-6)
        cameras = self.batch.cameras
        for image, viewmat, K in zip(self.batch.images[:, 0], cameras.viewmats, cameras.Ks):
            seen = x @ viewmat[:3, :3].T + viewmat[:3, 3]
            pixel = seen[:, :2] / seen[:, 2:] * torch.stack([K[0, 0], K[1, 1]]) + K[:2, 2]
            grid = 2 * pixel / pixel.new_tensor([cameras.width, cameras.height]) - 1
            colour = torch.nn.functional.grid_sample(image.permute(2, 0, 1)[None], grid.view(1, 1, -1, 2), align_corners=False)[0, :, 0].T
            facing = -(normal @ viewmat[:3, :3].T * torch.nn.functional.normalize(seen, dim=1)).sum(1, keepdim=True)
            weight = facing.clamp(min=0) ** 4 * (seen[:, 2:] > 0)
            total, weights = total + weight * colour, weights + weight
        return total / weights

    # Fitting.

    def configure_optimizers(self) -> torch.optim.Optimizer:
        rates = {name: rate * self.hparams.lr * (float(self.size) if name == "means" else 1) for name, rate in RATES.items()}
        groups = [{"params": [getattr(self, name)], "lr": rates[name], "name": name} for name in PARTS]
        return torch.optim.Adam(groups, eps=1e-15, fused=self.means.is_cuda)

    def on_train_start(self) -> None:
        self.length = float(self.size)
        self.half_per_depth = 0.5 * self.batch.cameras.width / float(self.batch.cameras.Ks[:, 0, 0].mean())

    def training_step(self, step: Any, batch_idx: int) -> Tensor:
        here = self.global_step
        generator = torch.Generator().manual_seed(1_000_003 * self.hparams.seed + here)
        views = torch.randperm(len(self.batch.images), generator=generator)[: self.hparams.views].to(self.device)
        truth, masks, cameras = self.batch.images[views, 0], self.batch.masks[views, 0], self.batch.cameras
        chosen = cameras._replace(viewmats=cameras.viewmats[views], Ks=cameras.Ks[views])
        images, alphas = self.render(chosen, self.batch.background)
        one, other = images.permute(0, 3, 1, 2), truth.permute(0, 3, 1, 2)
        difference, outline = (images - truth).abs().mean(), (alphas - masks).abs().mean()
        similarity = structural_similarity(one, other).mean()
        loss = (1 - self.hparams.ssim) * difference + self.hparams.ssim * (1 - similarity) + self.hparams.silhouette * outline
        if here % self.trainer.log_every_n_steps == 0:
            square = (images.detach() - truth).square().mean()
            values = {"loss": loss.detach(), "psnr": -10 * square.log10(), "ssim": similarity.detach(), "outline": outline.detach()}
            self.log_dict(values | {"gaussians": float(len(self.means))}, prog_bar=True)
        return loss

    def optimizer_step(self, epoch: int, batch_idx: int, optimizer: Any, optimizer_closure: Any = None) -> None:
        """Take a step and densify; not in `on_train_batch_end`, because Lightning saves checkpoints before it."""
        super().optimizer_step(epoch, batch_idx, optimizer, optimizer_closure)
        self._after_step(self.global_step + 1)

    @torch.no_grad()
    def _after_step(self, done: int) -> None:
        self._accumulate_gradient()
        low, high = math.log(1e-4 * self.length), math.log(self.hparams.max_scale * self.length)
        self.log_scales.clamp_(low, high)
        if done % self.hparams.densify_every == 0 and done <= 0.6 * self.hparams.steps:
            self._densify(done)
        for group in self.optimizers().optimizer.param_groups:
            if group["name"] == "means":
                group["lr"] = RATES["means"] * self.hparams.lr * self.length * 0.01 ** min(1.0, done / self.hparams.steps)

    def _accumulate_gradient(self) -> None:
        """Accumulate the gradient of the loss with respect to the projected centre of each Gaussian, per half image."""
        cameras = self.batch.cameras
        depth = (self.means @ cameras.viewmats[:, 2, :3].T + cameras.viewmats[:, 2, 3]).mean(1).abs()
        assert self.means.grad is not None  # a step came before
        self.gradient += self.means.grad.norm(dim=1) * depth * self.half_per_depth
        self.count += 1

    def _densify(self, done: int) -> None:
        """Clone small and split large Gaussians with a large gradient, and prune transparent ones (3DGS, section 5)."""
        generator = torch.Generator().manual_seed(7_000_003 * self.hparams.seed + done)
        mean = self.gradient / self.count.clamp(min=1)
        spread = self.log_scales.exp().amax(1)
        kept = self.logits.sigmoid() > self.hparams.prune_opacity
        wanted = (mean > self.hparams.densify_gradient) & kept
        room = self.hparams.max_gaussians - int(kept.sum())
        if int(wanted.sum()) > room:  # those with the largest gradients
            order = torch.where(wanted, mean, -1.0).argsort(descending=True)
            wanted = torch.zeros_like(wanted).index_fill(0, order[: max(room, 0)], True)
        split = wanted & (spread > 0.5 * self.hparams.max_scale * self.size)
        shift = torch.randn(self.means.shape, generator=generator).to(self.means)
        covariances = covariances_of(self.log_scales.exp().double(), self.quaternions.double())
        axes = (torch.linalg.cholesky(covariances) @ shift.double().unsqueeze(-1)).to(shift)
        grown = {name: getattr(self, name).detach().clone() for name in PARTS}
        twin = {name: grown[name][wanted] for name in PARTS}
        grown["log_scales"][split] -= math.log(1.6)
        twin["log_scales"] = grown["log_scales"][wanted]
        grown["means"][split] += axes[split].squeeze(-1)
        twin["means"] = twin["means"] - torch.where(split, 1.0, 0.3)[wanted, None] * axes[wanted].squeeze(-1)
        optimizer = self.optimizers().optimizer
        for group in optimizer.param_groups:
            name = group["name"]
            old = group["params"][0]
            new = nn.Parameter(torch.cat([grown[name][kept], twin[name]]).contiguous())
            state = optimizer.state.pop(old, {})
            for key in ("exp_avg", "exp_avg_sq"):
                if key in state:
                    state[key] = torch.cat([state[key][kept], torch.zeros_like(twin[name])]).contiguous()
            optimizer.state[new] = state
            group["params"][0] = new
            setattr(self, name, new)
        if not len(self.means):
            raise UserError("all Gaussians became transparent: check masks and cameras, or lower lr")
        self.gradient = torch.zeros(len(self.means), device=self.device)
        self.count.zero_()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Resize the parameters to the number of Gaussians in the checkpoint."""
        state = checkpoint["state_dict"]
        for name in PARTS:
            setattr(self, name, nn.Parameter(torch.empty_like(state[name], device=self.device)))
        self.gradient = torch.zeros_like(state["gradient"], device=self.device)


def _first_frame(batch: MultiViewBatch, device: torch.device) -> MultiViewBatch:
    still = batch.cameras.at(0)
    cameras = still._replace(viewmats=still.viewmats.to(device), Ks=still.Ks.to(device))
    images, masks = batch.images[:, :1].to(device), batch.masks[:, :1].to(device)
    return batch._replace(images=images, masks=masks, cameras=cameras, background=batch.background.to(device))
