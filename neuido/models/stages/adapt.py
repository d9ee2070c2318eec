"""Few-shot adaptation: fit the parameters of a method to the images of each scene in turn (paper, "Few-Shot")."""

import gc
import sys
import time
from pathlib import Path
from typing import Any, Literal, cast

import torch
import warp as wp
from torch import Tensor, nn

from neuido.data.files.score_tables import folder_of, write_rows
from neuido.data.scenes.filmed_scene import VisualScene
from neuido.errors import UserError
from neuido.models.fewshot.fit_progress import Progress, restore
from neuido.models.fewshot.method import CARD, Method, scalars
from neuido.models.fewshot.relative_density import RelativeDensity
from neuido.models.fewshot.scene_fit import DENSITY, SceneFit
from neuido.models.inference.pipeline import rollout_with_retries
from neuido.models.inference.prepared_scene import EffectSource, Laws, PreparedScene, prepare
from neuido.models.inference.transfer import read_conditions, run_condition
from neuido.models.scoring import motion_scores as scores
from neuido.models.stages.image_module import (
    SCORES,
    check_options,
    curriculum_frames,
    image_losses,
    sample_views,
    without_gradients,
    write_frame_scores,
    write_prediction,
)
from neuido.models.stages.scene_ranks import SharesScenes
from neuido.models.stages.training import gradients_of, is_finite
from neuido.types import ParticleState

GIGABYTE = 1e9


class AdaptModule(SharesScenes):
    """Fit a method to each scene separately, and score it on held-out views before and after.

    One epoch is one scene; leave `trainer.max_epochs` at -1. The loss is that of Stage II (`image_losses`), and the data module is a
    `VisualDataModule`. `out/scores.csv` has two rows for each scene, whose `stage` is before and after. `out/<scene>/fit` holds the fit.
    Several processes share the scenes with the strategy `scenes` (`SceneRanks`).

    Args:
        method: The method to fit (`fewshot.method`).
        steps: Optimiser steps for each scene; the default of the method where absent (ours: 100, as in the paper).
        views_per_step: Training views in each step, sampled anew; 0: all.
        encoder_views: Training views for the encoder; 0: all.
        fit_frames: Number of initial frames to fit; 0: all. Scores of the remaining frames are reported separately, as `later_...`.
        curriculum: Successive rollout lengths, as shares of the fitted frames. Each takes an equal part of `curriculum_share` of the steps.
        curriculum_share: Share of the steps that the curriculum takes; the steps after it roll out all fitted frames.
        image_loss: `relative`: squared error relative to that of a still first frame, equal in all scenes; `mse`: the squared error itself
            (paper).
        image_weight: Weight of the squared error of the images; 0: only silhouettes.
        silhouette_weight: Weight of the squared error of the silhouettes.
        estimate_velocity: Estimate a rigid velocity at t = 0, which is added to the known velocity of the body.
        velocity_lr: Learning rate of this velocity, in m/s and rad/s a step.
        velocity_steps: Initial steps that fit only the velocity, with their own cosine schedule.
        velocity_frames: Rollout length of these steps, in frames.
        estimate_density: Estimate the relative density of the body, which the first frame does not show (`fewshot.relative_density`);
            paper: no.
        density_lr: Learning rate of the logarithm of the relative density.
        density_from: Share of the steps after which the relative density is fitted too; before that, only the law explains the motion.
        density_weight: Weight of the mean squared logarithm of the relative density, a prior for an even filling.
        stop_on: Criterion for early stopping: `none`, `loss` (of all training views), or `view` (the loss of the last training view, which
            is then excluded from training). The best parameters are kept.
        patience: Steps without an improvement of 1 % after which the fit of a scene stops.
        check_every: Steps between two evaluations of the criterion.
        segment: Gradient checkpointing: keep the state of a rollout only every so many frames (`Simulator.rollout`); 0: keep all.
        effects: Known effects that act in addition to the law, for example those of a diagnosis.
        adapter: For test and predict: folder of an earlier fit, either its `out` or an `out/<scene>/fit`.
        cache: Folder for cached optical flow.
        out: Folder for results.
        lpips_backbone: Local file with the weights of VGG16 or AlexNet; without one, LPIPS is not reported.
        lpips_net: `vgg` or `alex`.
        condition_files: For predict: files of conditions (`inference.transfer`) to simulate with the fitted laws.
    """

    commands_with_results = ("fit", "test", "predict")
    """Commands that write into the folder `out`."""

    def __init__(
        self,
        method: Method,
        steps: int | None = None,
        views_per_step: int = 2,
        encoder_views: int = 0,
        fit_frames: int = 0,
        curriculum: list[float] = [0.25, 0.5],  # noqa: B006 (read only)
        curriculum_share: float = 0.3,
        image_loss: Literal["relative", "mse"] = "relative",
        image_weight: float = 1.0,
        silhouette_weight: float = 0.1,
        estimate_velocity: bool = False,
        velocity_lr: float = 0.2,
        velocity_steps: int = 40,
        velocity_frames: int = 8,
        estimate_density: bool = False,
        density_lr: float = 0.03,
        density_from: float = 0.0,
        density_weight: float = 1e-3,
        stop_on: Literal["none", "loss", "view"] = "none",
        patience: int = 20,
        check_every: int = 5,
        segment: int = 0,
        effects: EffectSource | None = None,
        adapter: str | None = None,
        cache: str | None = None,
        out: str = "runs/adapt",
        lpips_backbone: str | None = None,
        lpips_net: str = "vgg",
        condition_files: list[str] | None = None,
    ):
        super().__init__()
        counts = {"steps": steps or 0, "fit_frames": fit_frames, "velocity_steps": velocity_steps, "segment": segment}
        counts |= {"views_per_step": views_per_step, "encoder_views": encoder_views}
        weights = {"image_weight": image_weight, "silhouette_weight": silhouette_weight, "velocity_lr": velocity_lr}
        weights |= {"density_lr": density_lr, "density_weight": density_weight}
        check_options(counts, weights, {"curriculum_share": curriculum_share, "density_from": density_from}, curriculum)
        if image_weight + silhouette_weight == 0:
            raise UserError("model.image_weight and silhouette_weight are both 0: nothing would be compared")
        if fit_frames == 1 or velocity_frames < 2:
            raise UserError(f"model.fit_frames = {fit_frames}, velocity_frames = {velocity_frames}: a motion needs at least 2 frames")
        if patience < 1 or check_every < 1:
            raise UserError(f"model.patience = {patience}, check_every = {check_every}: at least 1 is needed")
        self.save_hyperparameters(ignore=["method", "effects"])
        object.__setattr__(self, "plan", method)  # not a submodule: each scene trains its own copy
        self.effects = effects
        self.steps = method.steps if steps is None else steps
        self.ahead = velocity_steps if estimate_velocity else 0
        """Number of initial steps that fit only the velocity."""
        self.fits = nn.ModuleList()
        self._names: list[str] = []
        self._current: tuple[str, PreparedScene] | None = None
        self._progress: dict[str, Progress] = {}
        self._idle = False
        """Whether the scene of this step is done while those of other processes are not."""
        self._predicted: list[tuple[PreparedScene, Laws]] = []

    # Scenes.

    def open_scene(self, scene: VisualScene, device: torch.device, *, watched: bool) -> PreparedScene:
        """Prepare the scene on the device; `watched`: with the flow for the encoder of the method."""
        encoder = self.plan.encoder.to(device) if watched and self.plan.encoder is not None else None
        return prepare(scene, encoder, device=device, encoder_views=self.hparams.encoder_views, cache=self.hparams.cache)

    def new_fit(self, prepared: PreparedScene, uneven: bool = False) -> SceneFit:
        """Create an unfitted `SceneFit`; `uneven`: with a relative density even if `estimate_density` is off."""
        density = None
        if self.hparams.estimate_density or uneven:
            simulator = prepared.simulator
            density = RelativeDensity(simulator.state.x, simulator.volume, simulator.scenes[0].dx)
        method = self.plan.for_scene(prepared)
        return SceneFit(method, self.hparams.estimate_velocity, self.effects, density).to(prepared.images.device)

    def setup(self, stage: str) -> None:
        if stage != "fit" or len(self.fits):
            return
        data = self.trainer.datamodule
        self.trainer.fit_loop.max_epochs = self.share_scenes([scene.name for scene in data.scenes])
        data.steps_in_a_row = self.ahead + self.steps
        for scene in data.scenes:
            prepared = self.open_scene(scene, self.trainer.strategy.root_device, watched=True)
            self._training_views(prepared)
            self.fits.append(self.new_fit(prepared))
            self._names.append(scene.name)

    def fit_of(self, name: str) -> SceneFit:
        """Return the fit of a scene of this run."""
        return cast(SceneFit, self.fits[self._names.index(name)])

    def _training_views(self, prepared: PreparedScene) -> list[int]:
        """Return the indices of the views to train on."""
        if self.hparams.stop_on != "view":
            return prepared.training_views
        if len(prepared.training_views) < 2:
            raise UserError(f"model.stop_on = view: {prepared.source.name} has one training view, so none would remain; use loss or none")
        return prepared.training_views[:-1]

    def _frames(self, prepared: PreparedScene) -> int:
        """Return the number of frames to fit."""
        return min(prepared.frames, self.hparams.fit_frames or prepared.frames)

    # Fitting.

    def configure_optimizers(self) -> torch.optim.Optimizer | None:
        groups = []
        for i, fit in enumerate(self.fits):
            own = [{**group, "of": i, "start_lr": group["lr"], "first": self.ahead} for group in fit.method.parameter_groups()]
            if fit.twist is not None:
                rate = self.hparams.velocity_lr
                own.append({"params": [fit.twist], "lr": rate, "of": i, "start_lr": rate, "first": 0})
            if fit.density is not None:
                rate, first = self.hparams.density_lr, self.ahead + round(self.hparams.density_from * self.steps)
                own.append({"params": list(fit.density.parameters()), "lr": rate, "of": i, "start_lr": rate, "first": first})
            groups += own
        return self.plan.optimizer(groups) if groups and self.ahead + self.steps else None

    def on_fit_start(self) -> None:
        for scene in self.trainer.datamodule.scenes:
            if not self.ahead + self.steps:  # Lightning then runs no epoch
                self._begin(scene)
                self.fit_of(scene.name).save(folder_of(self.hparams.out, scene.name) / "fit")
            elif scene.name in self._progress and self._progress[scene.name].done:  # killed between the last step and the scores
                self._begin(scene)
                self._finish_scene()
        self.publish()

    def on_train_batch_start(self, batch: VisualScene, batch_idx: int) -> int | None:
        self._idle = batch.name in self._progress and self._progress[batch.name].done
        if not self._idle:
            self._begin(batch)
        return -1 if self.trainer.strategy.reduce_boolean_decision(self._idle) else None

    def _begin(self, scene: VisualScene) -> PreparedScene:
        """Prepare a scene on the device, and score it before its first step."""
        if self._current is None or self._current[0] != scene.name:
            self._finish_scene()
            self._current = None
            gc.collect()  # free the tapes of the previous scene first
            self._current = scene.name, self.open_scene(scene, self.device, watched=False)
            if scene.name not in self._progress:
                self._progress[scene.name] = Progress()
                self._score_fit("before")
            if self.device.type == "cuda":
                torch.cuda.reset_peak_memory_stats(self.device)
        return self._current[1]

    def training_step(self, scene: VisualScene, batch_idx: int) -> Tensor:
        if self._idle:
            return torch.zeros((), device=self.device, requires_grad=True)
        prepared, fit, step = self._begin(scene), self.fit_of(scene.name), self._progress[scene.name].steps
        frames = self.rollout_frames(prepared, step)
        motion = self._rollout_or_restore(prepared, fit, frames)
        if motion is None:
            return fit.method.recovery_loss()
        views = sample_views(self._training_views(prepared), self.hparams.views_per_step, step)
        loss, silhouette = image_losses(prepared, motion, views, self.hparams.image_loss)
        regular = fit.regulariser(self.hparams.density_weight)
        self._log({"train/loss": loss, "train/silhouette": silhouette, "train/regulariser": regular, "train/frames": float(frames)})
        return self._weighted(loss, silhouette) + regular

    def _rollout_or_restore(self, prepared: PreparedScene, fit: SceneFit, frames: int) -> ParticleState | None:
        """Simulate; on failure restore the last working parameters, halve the learning rates and retry.

        Returns:
            The motion, or None if there are no working parameters.
        """
        name = prepared.source.name
        progress = self._progress[name]
        for _ in range(2):
            try:
                motion = fit.rollout(prepared, frames, segment=self.hparams.segment)
                progress.record_success(fit)
                return motion
            except UserError as error:  # a law that cannot run has no image
                print(f"{name}: {error}", file=sys.stderr)
                self._log({"train/failed": 1.0})
            if not progress.restore_last_good(fit):
                return None
        return None

    def _weighted(self, loss: Tensor, silhouette: Tensor) -> Tensor:
        return self.hparams.image_weight * loss + self.hparams.silhouette_weight * silhouette

    def rollout_frames(self, prepared: PreparedScene, step: int) -> int:
        """Return the rollout length, in frames, at this step of a scene."""
        frames = self._frames(prepared)
        if step < self.ahead:
            return min(frames, self.hparams.velocity_frames)
        return curriculum_frames((step - self.ahead) / max(1, self.steps), frames, self.hparams.curriculum, self.hparams.curriculum_share)

    def on_before_optimizer_step(self, optimizer: torch.optim.Optimizer) -> None:
        """Skip a step whose gradient is not finite; restore the last working parameters if that happens repeatedly."""
        if not is_finite(gradients := gradients_of(optimizer)):
            self._log({"train/not_finite": 1.0})
            for g in gradients:
                g.zero_()
            if self._current is not None:
                name = self._current[0]
                self._progress[name].restore_last_good(self.fit_of(name), ran=True)

    def optimizer_step(self, epoch: int, batch_idx: int, optimizer: Any, optimizer_closure: Any = None) -> None:
        if self._idle:
            optimizer_closure()
            return
        name, prepared = self._current  # type: ignore[misc]
        progress = self._progress[name]
        self._set_rates(optimizer, name, progress)
        begun = time.perf_counter()
        super().optimizer_step(epoch, batch_idx, optimizer, optimizer_closure)
        progress.steps += 1
        if self.hparams.stop_on != "none" and progress.steps >= self.ahead and progress.steps % self.hparams.check_every == 0:
            self._check_early_stop(prepared, progress)
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
            progress.peak_memory_gb = max(progress.peak_memory_gb, torch.cuda.max_memory_allocated(self.device) / GIGABYTE)
            if wp.is_mempool_enabled(str(self.device)):
                progress.warp_memory_gb = wp.get_mempool_used_mem_high(str(self.device)) / GIGABYTE
        progress.seconds += time.perf_counter() - begun
        progress.done = progress.steps >= self.ahead + self.steps or progress.over

    def _set_rates(self, optimizer: Any, name: str, progress: Progress) -> None:
        step, ahead = progress.steps, self.ahead
        share = step / ahead if step < ahead else (step - ahead) / max(1, self.steps)
        factor = progress.damping * self.fit_of(name).method.rate(share)
        for group in optimizer.param_groups:
            group["lr"] = 0.0 if step < group["first"] or group["of"] != self._names.index(name) else factor * group["start_lr"]

    @without_gradients
    def _check_early_stop(self, prepared: PreparedScene, progress: Progress) -> None:
        """Evaluate the loss of all fitted frames on all training views, or on the view reserved for early stopping."""
        fit = self.fit_of(prepared.source.name)
        motion = self._try(prepared, fit)
        if motion is None:
            return
        views = prepared.training_views[-1:] if self.hparams.stop_on == "view" else prepared.training_views
        value = float(self._weighted(*image_losses(prepared, motion, views, self.hparams.image_loss)))
        self._log({"train/looked": value})
        progress.record_loss(value, fit, self.hparams.patience)

    def on_train_epoch_end(self) -> None:
        self._finish_scene()
        self.publish()

    def on_train_end(self) -> None:
        self._finish_scene()
        self.publish()
        self._report_missing_lpips()

    def _finish_scene(self) -> None:
        """Score the current scene once its steps are done, and write its fit."""
        if self._current is None:
            return
        name, prepared = self._current
        progress, fit = self._progress[name], self.fit_of(name)
        if not progress.done or any(row["scene"] == name and row["stage"] == "after" for row in self._rows):
            return
        if not restore(fit, progress.best) and self._try(prepared, fit) is None:  # the law after the last step has not been simulated yet
            restore(fit, progress.good)
        progress.best, progress.good, progress.first = {}, {}, {}
        fit.save(folder_of(self.hparams.out, name) / "fit")
        self._score_fit("after")
        self._current = None

    @without_gradients
    def _try(self, prepared: PreparedScene, fit: SceneFit) -> ParticleState | None:
        """Simulate all fitted frames; None if the simulation fails."""
        try:
            return fit.rollout(prepared, self._frames(prepared))
        except UserError:
            return None

    @without_gradients
    def _score_fit(self, stage: str) -> None:
        name, prepared = self._current  # type: ignore[misc]
        fit = self.fit_of(name)
        row = {"scene": name, "method": type(self.plan).__name__, "stage": stage}
        if stage == "after":
            keys = ("steps", "seconds", "peak_memory_gb", "warp_memory_gb") if self.device.type == "cuda" else ("steps", "seconds")
            row |= {key: getattr(self._progress[name], key) for key in keys}
        self.record(row | self.score(prepared, fit, stage))

    def score(self, prepared: PreparedScene, fit: SceneFit, stage: str) -> dict[str, Any]:
        """Return the mean scores of a fit and its parameters; write the scores of each frame to `out/<scene>/<stage>`."""
        found = {f"found_{key}": value for key, value in scalars(fit.describe()).items()}
        try:
            motion, halvings = rollout_with_retries(prepared, lambda scene: fit.rollout(scene, prepared.frames))
        except UserError as error:
            return {"failed": str(error), **found}
        figures, particles, pictures = self.score_motion(prepared, motion)
        write_frame_scores(folder_of(self.hparams.out, prepared.source.name) / stage, particles, pictures)
        if self._frames(prepared) < prepared.frames:
            later = scores.mean_from_frame(particles, pictures, self._frames(prepared), SCORES)
            figures |= {f"later_{key}": value for key, value in later.items()}
        return {**figures, "halvings": halvings, **found}

    # Checkpoints.

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        self.keep_all(checkpoint, {name: progress.state() for name, progress in self._progress.items()})

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        self._progress = {name: Progress(**state) for name, state in self.take_own(checkpoint).items()}

    # Test and prediction, from a saved fit.

    def load_fit(self, scene: VisualScene) -> tuple[PreparedScene, SceneFit]:
        """Return the scene and its fit: from this run, from `adapter`, or else unfitted."""
        if scene.name in self._names:
            return self.open_scene(scene, self.device, watched=False), self.fit_of(scene.name)
        prepared = self.open_scene(scene, self.device, watched=True)
        if self.hparams.adapter is None:
            return prepared, self.new_fit(prepared)
        folder = self._folder_of_fit(scene.name)
        fit = self.new_fit(prepared, uneven=(folder / DENSITY).is_file())
        fit.load(folder)
        return prepared, fit

    def _folder_of_fit(self, name: str) -> Path:
        given = Path(self.hparams.adapter)
        for folder in (given, folder_of(given, name) / "fit"):
            if (folder / CARD).is_file():
                return folder
        raise UserError(f"model.adapter = {given}: neither it nor {folder_of(given, name) / 'fit'} holds {CARD}")

    @without_gradients
    def test_step(self, scene: VisualScene, batch_idx: int) -> None:
        prepared, fit = self.load_fit(scene)
        row = {"scene": scene.name, "method": type(self.plan).__name__, "stage": "test", **self.score(prepared, fit, "test")}
        self._rows.append(row)
        self.show(row)

    def on_test_epoch_end(self) -> None:
        rows, self._rows = self.rows_of_all(), []
        self.log_dict({f"test/{name}": value for name, value in scores.mean_of(rows, SCORES).items()})
        if self.trainer.is_global_zero:
            write_rows(Path(self.hparams.out) / "test.csv", rows)
            self._report_missing_lpips()

    @without_gradients
    def predict_step(self, scene: VisualScene, batch_idx: int) -> dict[str, Any]:
        """Write the fit, particles, video and contact sheet of a scene; return their folder."""
        prepared, fit = self.load_fit(scene)
        folder = folder_of(self.hparams.out, scene.name)
        fit.save(folder / "fit")
        self.print(f"{scene.name}: {fit.method.summary()}")
        try:
            motion, _ = rollout_with_retries(prepared, lambda refined: fit.rollout(refined, prepared.frames))
        except UserError as error:
            print(f"{scene.name}: the law is in {folder}, but its simulation failed: {error}", file=sys.stderr)
            return {"scene": scene.name, "folder": str(folder), "failed": str(error)}
        write_prediction(folder, prepared, motion)
        if self.hparams.condition_files:
            self._predicted.append((prepared, fit.method.laws(prepared)))
        self.print(f"{scene.name}: results in {folder}")
        return {"scene": scene.name, "folder": str(folder)}

    @without_gradients
    def on_predict_epoch_end(self) -> None:
        for path in self.hparams.condition_files or []:
            condition = read_conditions(path)
            self.print(f"condition {condition.name}: {run_condition(condition, self._predicted, self.hparams.out)}")
        self._predicted = []
