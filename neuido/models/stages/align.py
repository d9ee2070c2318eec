"""Stage II: train the projector on images, through the simulator and the renderer (paper, "Visual-to-Dynamics Alignment")."""

import sys
from pathlib import Path
from typing import Any, Literal

import torch
from lightning.pytorch.utilities import rank_zero_only
from torch import Tensor

from neuido.data.files.score_tables import folder_of, write_rows
from neuido.data.scenes.filmed_scene import VisualScene
from neuido.errors import UserError
from neuido.models.inference.pipeline import infer_latent, rollout_latent, rollout_with_retries
from neuido.models.inference.prepared_scene import Laws, PreparedScene, prepare
from neuido.models.inference.transfer import read_conditions, run_condition
from neuido.models.inference.video_law import VideoLaw
from neuido.models.operator.law_properties import implausibility, p_wave_modulus
from neuido.models.scoring import motion_scores as scores
from neuido.models.stages.image_module import (
    SCORES,
    ImageModule,
    check_options,
    curriculum_frames,
    image_losses,
    sample_views,
    without_gradients,
    write_frame_scores,
    write_prediction,
)
from neuido.models.stages.scene_ranks import gathered
from neuido.models.stages.training import open_operator_and_encoder, optimiser_steps, report_and_save

GRAPHED = 24
"""Number of scenes up to which rollouts are captured as CUDA graphs, which keep up to a gigabyte for each scene."""


class AlignModule(ImageModule):
    """Train and score Stage II, and predict zero-shot. Trunks, heads and VAE are frozen; each step uses the next scene.

    The loss of a scene is the squared error of the images over all training views, relative to that of a still first frame. A value of one
    means that none of the motion is explained, whatever the size of the body. (AdamW is invariant to this constant factor of a scene, but
    gradient clipping is not.) The paper's Stage II is `configs/paper/stage2.yaml`.

    The data module is a `VisualDataModule`.

    Args:
        operator: File of the operator, or `pretrained`.
        init_from: Encoder to start from, for example that of the warm-up or `pretrained`; without one, a new projector starts near the mean
            latent of Stage I.
        vae: VAE of a new encoder: a file, `pretrained`, or `cogvideox:` and a source.
        flow_size, flow_encoding, speed_scale, width, heads, conditions, dropout: Options of a new encoder (`DynamicsEncoder`).
        lr: Learning rate of AdamW, with a cosine schedule to zero over the run (paper: AdamW and cosine; it gives no rate).
        weight_decay: Weight decay of the projector.
        views_per_step: Training views in each step, sampled anew; 0: all.
        encoder_views: Training views for the encoder; 0: all.
        curriculum: Successive rollout lengths, as shares of the frames. Each takes an equal part of `curriculum_share` of the run; the rest
            of the run rolls out all frames. Short rollouts come first because the gradient of a long one through several contacts is
            uninformative while the law is far off.
        curriculum_share: Share of the run that the curriculum takes.
        image_loss: `relative`: squared error relative to that of a still first frame, equal in all scenes; `mse`: the squared error itself
            (paper).
        silhouette_weight: Weight of the squared error of the silhouettes, normalised like the images. It guides where colours mislead.
        prior_weight: Weight of the squared distance of z from its value at the start of training, mean over the components of z; 0: none.
        plausibility_weight: Weight of the penalty on elastic laws that a rollout would not survive (`law_properties.implausibility`);
            paper: 0.
        segment: Gradient checkpointing: keep the state of a rollout only every so many frames (`Simulator.rollout`); 0: keep all.
        cache: Folder for cached optical flow.
        flow_method: `opencv` (on the CPU), or `parallel`, the same algorithm for all frames at once on the device of the training.
        save_to: File for the encoder at the end of a fit.
        out: Folder for the results of test and predict.
        lpips_backbone: Local file with the weights of VGG16 or AlexNet; without one, LPIPS is not reported.
        lpips_net: `vgg` or `alex`.
        baselines: Number of random latents with which a test scores each unseen scene, in addition to the mean latent.
        condition_files: For predict: files of conditions (`inference.transfer`) to simulate with the inferred laws.
    """

    commands_with_results = ("test", "predict")
    """Commands that write into the folder `out`."""

    def __init__(
        self,
        operator: str = "pretrained",
        init_from: str | None = None,
        vae: str = "pretrained",
        flow_size: int = 64,
        flow_encoding: Literal["velocity", "wheel"] = "velocity",
        speed_scale: float = 2.0,
        width: int = 96,
        heads: int = 4,
        conditions: bool = True,
        dropout: float = 0.0,
        lr: float = 1e-3,
        weight_decay: float = 0.0,
        views_per_step: int = 0,
        encoder_views: int = 0,
        curriculum: list[float] = [0.25, 0.5],  # noqa: B006 (read only)
        curriculum_share: float = 0.4,
        image_loss: Literal["relative", "mse"] = "relative",
        silhouette_weight: float = 0.1,
        prior_weight: float = 0.0,
        plausibility_weight: float = 1.0,
        segment: int = 0,
        cache: str | None = None,
        flow_method: Literal["opencv", "parallel"] = "opencv",
        save_to: str | None = None,
        out: str = "runs/stage2/results",
        lpips_backbone: str | None = None,
        lpips_net: str = "vgg",
        baselines: int = 8,
        condition_files: list[str] | None = None,
    ):
        super().__init__()
        if not lr > 0:
            raise UserError(f"model.lr = {lr}: it must be positive")
        counts = {"views_per_step": views_per_step, "encoder_views": encoder_views, "segment": segment, "baselines": baselines}
        weights = {"silhouette_weight": silhouette_weight, "prior_weight": prior_weight, "plausibility_weight": plausibility_weight}
        check_options(counts, weights, {"curriculum_share": curriculum_share}, curriculum)
        self.save_hyperparameters()
        flow = {"flow_size": flow_size, "flow_encoding": flow_encoding, "speed_scale": speed_scale}
        sizes = {"width": width, "heads": heads, "conditions": conditions, "dropout": dropout}
        self.operator, self.encoder = open_operator_and_encoder(operator, init_from, vae, **flow, **sizes)  # type: ignore[arg-type]
        self._prepared: dict[str, PreparedScene] = {}
        self._start: dict[str, Tensor] = {}
        self._rows: list[dict[str, Any]] = []
        self._predicted: list[tuple[PreparedScene, Laws]] = []
        self._total = 1

    # Scenes.

    def prepared(self, scene: VisualScene) -> PreparedScene:
        """Return the prepared scene, from the cache after the first call."""
        if scene.name not in self._prepared:
            options = {name: self.hparams[name] for name in ("encoder_views", "cache", "flow_method")} | {"graphs": self._few_scenes()}
            self._prepared[scene.name] = prepare(scene, self.encoder, device=self.device, **options)
        return self._prepared[scene.name]

    def _few_scenes(self) -> bool:
        """Return whether the CUDA graphs of all scenes fit into the memory beside each other."""
        return self._trainer is None or len(self.trainer.datamodule.scenes) <= GRAPHED

    # Fitting.

    def configure_optimizers(self) -> dict[str, Any]:
        self._total = optimiser_steps(self.trainer)
        parameters = self.encoder.projector.parameters()
        optimizer = torch.optim.AdamW(parameters, lr=self.hparams.lr, weight_decay=self.hparams.weight_decay)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, self._total)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def rollout_frames(self, prepared: PreparedScene) -> int:
        """Return the rollout length, in frames, at this point of the run."""
        done = self.global_step / max(1, self._total)
        return curriculum_frames(done, prepared.frames, self.hparams.curriculum, self.hparams.curriculum_share)

    def training_step(self, scene: VisualScene, batch_idx: int) -> Tensor:
        prepared = self.prepared(scene)
        frames = self.rollout_frames(prepared)
        z = self.encoder(prepared.volume, prepared.conditions)
        start = self._start.setdefault(scene.name, z.detach().clone())
        try:
            motion = rollout_latent(prepared, self.operator, z, frames, segment=self.hparams.segment)
        except UserError as error:  # a law that cannot be simulated has no image: move towards laws that can
            print(f"{scene.name}: {error}", file=sys.stderr)
            self._log({"train/failed": 1.0})
            return (z - self._mean_latent(z)).square().mean()
        views = sample_views(prepared.training_views, self.hparams.views_per_step, self.global_step)
        loss, silhouette = image_losses(prepared, motion, views, self.hparams.image_loss)
        total = loss + self.hparams.silhouette_weight * silhouette + self.hparams.prior_weight * (z - start).square().mean()
        if self.hparams.plausibility_weight:
            implausible = implausibility(self.operator, z)
            total = total + self.hparams.plausibility_weight * implausible
            self._log({"train/implausible": implausible})
        self._log({"train/loss": loss, f"train/{scene.name}": loss, "train/silhouette": silhouette, "train/frames": float(frames)})
        return total

    def on_train_batch_end(self, outputs: Any, batch: VisualScene, batch_idx: int) -> None:
        """Release the tape of the scene's rollout where those of all scenes would not fit beside each other."""
        if not self._few_scenes():
            self.prepared(batch).simulator.cache.clear()

    def _mean_latent(self, z: Tensor) -> Tensor:
        """Return the mean latent of Stage I, whose law can be simulated."""
        return self.operator.latents.mean(0).to(z) if len(self.operator.latents) else torch.zeros_like(z)

    # Scores.

    def score(self, scene: VisualScene, *, images: bool = True) -> tuple[dict[str, Any], list[dict[str, Any]], list[dict[str, Any]]]:
        """Score zero-shot inference of a scene; return the means, and the rows of each frame for particles and images."""
        prepared = self.prepared(scene)
        found = infer_latent(self.encoder, self.operator, prepared)
        summary: dict[str, Any] = {"scene": scene.name, "seconds": found.seconds}
        summary["modulus"] = float(p_wave_modulus(self.operator, found.z[None])[0])
        try:
            with torch.no_grad():
                motion, halvings = rollout_with_retries(prepared, lambda scene: rollout_latent(scene, self.operator, found.z))
            summary["halvings"] = halvings
        except UserError as error:
            return summary | {"failed": str(error)}, [], []
        figures, particles, pictures = self.score_motion(prepared, motion, images=images)
        return summary | figures, particles, pictures

    @without_gradients
    def validation_step(self, scene: VisualScene, batch_idx: int) -> None:
        self._rows.append(self.score(scene)[0])

    def on_validation_epoch_end(self) -> None:
        rows = self._gather()
        values = {f"val/{name}": value for name, value in scores.mean_of(rows, SCORES).items()}
        values["val/failed"] = float(sum("failed" in row for row in rows))
        for row in rows:
            values |= {f"val/{row['scene']}/{name}": row[name] for name in ("cd", "rmse", "psnr", "modulus") if name in row}
        self.log_dict(values)

    def _gather(self) -> list[dict[str, Any]]:
        """Gather the rows of all processes, one for each scene in the order of the names, and clear the local rows."""
        rows, self._rows = [row for part in gathered(self._rows) for row in part], []
        return sorted({row["scene"]: row for row in rows}.values(), key=lambda row: row["scene"])

    # Test: all scores, with baselines for unseen scenes.

    @without_gradients
    def test_step(self, scene: VisualScene, batch_idx: int) -> None:
        summary, particles, pictures = self.score(scene)
        unseen = scene.name in getattr(self.trainer.datamodule, "unseen_names", [])
        summary["unseen"] = int(unseen)
        if unseen and self.hparams.baselines and scene.truth is not None:
            summary |= self.score_baselines(self.prepared(scene))
        write_frame_scores(folder_of(self.hparams.out, scene.name), particles, pictures)
        self._rows.append(summary)

    def score_baselines(self, prepared: PreparedScene) -> dict[str, float]:
        """Return the Chamfer distance of the mean latent, of random latents and of random trained latents (medians over those that run)."""
        generator = torch.Generator().manual_seed(0)
        latents, count = self.operator.latents, self.hparams.baselines
        drawn = self.operator.random_latents(count, generator)
        picked = latents[torch.randperm(len(latents), generator=generator)[:count]]
        out: dict[str, float] = {}
        for name, candidates in (("mean", latents.mean(0)[None]), ("random", drawn), ("trained", picked)):
            values = []
            for z in candidates.to(self.device):
                try:
                    with torch.no_grad():
                        motion, _ = rollout_with_retries(prepared, lambda scene, z=z: rollout_latent(scene, self.operator, z))
                except UserError:
                    continue
                values.append(float(scores.chamfer_per_frame(prepared, motion).mean()))
            out[f"cd_{name}_failed"] = len(candidates) - len(values)
            if values:
                out[f"cd_{name}"] = sorted(values)[len(values) // 2]
        return out

    def on_test_epoch_end(self) -> None:
        rows = self._gather()
        parts = {"test": rows, "unseen": [row for row in rows if row.get("unseen")], "seen": [row for row in rows if not row.get("unseen")]}
        for part, own in parts.items():
            self.log_dict({f"{part}/{name}": value for name, value in scores.mean_of(own, (*SCORES, "seconds")).items()})
        self._write_table(rows)

    @rank_zero_only
    def _write_table(self, rows: list[dict[str, Any]]) -> None:
        write_rows(Path(self.hparams.out) / "scores.csv", rows)
        self._report_missing_lpips()
        for row in rows:
            shown = [f"{name} {row[name]:.4g}" for name in (*SCORES, "cd_mean", "cd_random", "cd_trained", "seconds") if name in row]
            self.print(f"{row['scene']:16s} {'unseen ' if row.get('unseen') else ''}{', '.join(shown)}{row.get('failed', '')}")

    # Prediction.

    @without_gradients
    def predict_step(self, scene: VisualScene, batch_idx: int) -> dict[str, Any]:
        """Write the law, particles, video and contact sheet of a scene; return its moduli, folder and inference time."""
        prepared = self.prepared(scene)
        found = VideoLaw.infer(self.encoder, self.operator, prepared)
        folder = folder_of(self.hparams.out, scene.name)
        found.save(folder / "law.safetensors")
        answer: dict[str, Any] = {"scene": scene.name, "folder": str(folder), "seconds": found.seconds, **found.moduli._asdict()}
        if found.readings is not None:
            answer["readings"] = found.readings.as_dict()
        for line in found.report():
            self.print(f"{scene.name}: {line}")
        try:
            motion, halvings = found.rollout()
        except UserError as error:
            print(f"{scene.name}: the law is in {folder}, but its simulation failed: {error}", file=sys.stderr)
            return answer | {"failed": str(error)}
        if halvings:
            print(f"{scene.name}: the law needs a smaller time step, dt / {2**halvings}", file=sys.stderr)
        write_prediction(folder, prepared, motion)
        self.print(f"{scene.name}: results in {folder}")
        self._predicted.append((prepared, found.law()))
        return answer

    @without_gradients
    def on_predict_epoch_end(self) -> None:
        for path in self.hparams.condition_files or []:
            condition = read_conditions(path)
            folder = run_condition(condition, self._predicted, self.hparams.out)
            self.print(f"condition {condition.name}: {folder}")
        self._predicted = []

    def on_train_end(self) -> None:
        names = [scene.name for scene in self.trainer.datamodule.scenes]
        card = {"stage": "II", "operator": self.operator.fingerprint(), "steps": self.global_step, "scenes": names}
        report_and_save(self, self.encoder.save, card)
