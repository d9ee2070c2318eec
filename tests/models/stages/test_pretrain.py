"""Stage I learns, scores materials that it has not seen, and goes on after SIGKILL as if nothing had happened."""

import math
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from lightning.pytorch import Trainer, seed_everything

from neuido.data.trajectories.options import make_trajectories
from neuido.data.trajectories.trajectory_module import TrajectoryDataModule
from neuido.errors import UserError
from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
from neuido.models.stages.operator_scores import (
    ConstitutiveMetrics,
    evaluate_operator,
    fit_latents,
    silhouette,
    viscosity_errors,
    viscosity_scores,
)
from neuido.models.stages.pretrain import PretrainModule
from neuido.physics.laws.classical import FixedCorotated, Sigma, VonMises
from neuido.types import TrajectoryBatch
from tests.waiting import HANGS, wait_for

SMALL = {"latent_dim": 8, "basis_dim": 8, "hidden_dim": 16, "head_dim": 16}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Six training trajectories and three held-out ones of 40 steps of 64 particles."""
    path = tmp_path_factory.mktemp("stage1")
    make_trajectories(
        str(path), instances=2, held_out=1, particles_per_side=4, steps=40, velocity=(1.0, -30.0, -2.0), device="cpu", progress=False
    )
    return path


def trainer(tmp_path, **options):
    options = {"max_epochs": 3, "logger": False, "enable_checkpointing": False, **options}
    return Trainer(
        accelerator="cpu", default_root_dir=tmp_path, enable_progress_bar=False, enable_model_summary=False, log_every_n_steps=10, **options
    )


def synthetic(materials=16, samples=32):
    """Jelly and plasticine of several stiffnesses, from their laws."""
    generator = torch.Generator().manual_seed(0)
    young = torch.logspace(4, 6, materials)
    trial = torch.eye(3) + 0.05 * torch.randn(materials, samples, 3, 3, generator=generator)
    corrected, stress = torch.empty_like(trial), torch.empty_like(trial)
    for i, E in enumerate(young.tolist()):
        plastic = VonMises(0.03 * E, E, 0.3) if i % 2 else (lambda F: F)
        corrected[i] = plastic(trial[i])
        stress[i] = (Sigma if i % 2 else FixedCorotated)(E, 0.3)(corrected[i])
    flat = [t.reshape(-1, 3, 3).contiguous() for t in (trial, corrected, stress)]
    rms = stress.flatten(2).norm(dim=2).square().mean(1).sqrt(), (corrected - trial).flatten(2).norm(dim=2).square().mean(1).sqrt()
    return TrajectoryBatch(*flat, torch.arange(materials).repeat_interleave(samples)), 0.01 * rms[0], 0.01 * rms[1] + 1e-5


@pytest.mark.slow
def test_training_learns_and_an_unseen_material_needs_only_its_latent():
    batch, stress_epsilon, residual_epsilon = synthetic()
    torch.manual_seed(0)
    operator = IntrinsicDynamicsOperator("objective", latent_dim=16, basis_dim=16, hidden_dim=32, head_dim=32)
    z = torch.randn(16, 16, requires_grad=True)
    optimizer = torch.optim.AdamW([{"params": operator.parameters()}, {"params": [z], "lr": 5e-2}], lr=5e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, 600)
    for _ in range(600):
        optimizer.zero_grad()
        answers = evaluate_operator(operator, z, batch, stress_epsilon, residual_epsilon)
        (answers.stress_error.mean() + answers.plastic_error.mean()).backward()
        optimizer.step()
        schedule.step()
    assert answers.stress_error.median() < 0.02
    assert answers.plastic_error[1::2].median() < 0.4  # plasticine
    assert answers.plastic_error[::2].median() == 0  # jelly

    # A jelly whose stiffness lies between those of training.
    frozen = [p.clone() for p in operator.parameters()]
    F = batch.trial[:64]
    new = TrajectoryBatch(F, F, FixedCorotated(5e4, 0.3)(F), torch.zeros(64, dtype=torch.long))
    epsilons = 0.01 * new.stress.flatten(1).norm(dim=1).mean()[None], torch.tensor([1e-5])
    before = min(evaluate_operator(operator, row[None], new, *epsilons).stress_error.mean() for row in z.detach())
    fitted = fit_latents(operator, new, z.detach(), *epsilons, steps=150)
    after = evaluate_operator(operator, fitted, new, *epsilons)
    assert before > 0.05 and after.stress_error.mean() < 0.025
    assert after.plastic_error.max() == 0
    assert all(torch.equal(p, q) and p.requires_grad for p, q in zip(operator.parameters(), frozen))


def test_metrics_by_hand():
    batch, stress_epsilon, residual_epsilon = synthetic(materials=2, samples=64)
    operator = IntrinsicDynamicsOperator(**SMALL)
    answers = evaluate_operator(operator, torch.randn(2, 8), batch, stress_epsilon, residual_epsilon)
    answers = answers._replace(stress=1.25 * batch.stress.view_as(answers.stress), corrected=batch.corrected.view_as(answers.corrected))
    answers = answers._replace(stress_error=torch.full((2, 64), 0.25), plastic_error=torch.arange(128.0).view(2, 64))
    metrics = ConstitutiveMetrics("val/", ["elastic", "plasticine"])
    metrics.update(answers, batch)
    values = metrics.compute()
    assert values["val/stress_mse"].item() == pytest.approx((0.25 * batch.stress).square().mean().item(), rel=1e-4)
    assert values["val/plastic_mse"].item() == 0
    assert values["val/stress_error"].item() == pytest.approx(0.25, rel=0.03)
    assert values["val/plastic_error/elastic"].item() == pytest.approx(31, rel=0.05)
    assert values["val/plastic_error/plasticine"].item() == pytest.approx(95, rel=0.05)
    flows = (batch.corrected - batch.trial).flatten(1).norm(dim=1) > 1e-5
    assert not flows[:64].any() and flows[64:].any()
    assert "val/plastic_error_yielding/elastic" not in values and values["val/plastic_error_yielding/plasticine"] > 64
    assert values["val/plastic_error_yielding"].item() == pytest.approx(torch.arange(128.0)[flows].median().item(), rel=0.05)


def test_viscosities_are_scored_by_family_beside_the_best_constant():
    true = torch.tensor([0.0, 0.0, 0.0, 1.0, 10.0])
    found = torch.tensor([0.0, 1e-4, 0.0, 1.1, 10.0])
    assert viscosity_errors(found, true).tolist() == pytest.approx([0.0, 0.00995, 0.0, 0.0944, 0.0], abs=1e-4)
    scores = viscosity_scores("val/", found, true, ["sand", "sand", "sand", "fluid", "fluid"])
    assert scores["val/viscosity_error/sand"] == 0.0 and scores["val/viscosity_error_constant"] == 0.0
    assert scores["val/viscosity_error_constant/fluid"].item() == pytest.approx(math.log(101), rel=1e-3)


def test_silhouette_is_that_of_scikit_learn():
    metrics = pytest.importorskip("sklearn.metrics")
    generator = torch.Generator().manual_seed(0)
    families = ["a"] * 7 + ["b"] * 5 + ["c"] * 8
    points = torch.randn(20, 6, generator=generator) + torch.tensor([0.0] * 7 + [2.0] * 5 + [-1.0] * 8)[:, None]
    assert silhouette(points, families) == pytest.approx(metrics.silhouette_score(points.numpy(), families), rel=1e-5)
    assert math.isnan(silhouette(points, ["a"] * 20))


@pytest.mark.parametrize("trunk", ["objective", *(pytest.param(trunk, marks=pytest.mark.slow) for trunk in ("raw", "bounded", "general"))])
def test_fit_writes_the_operator_and_test_scores_it(folder, tmp_path, trunk):
    seed_everything(0)
    data = TrajectoryDataModule(str(folder), batch_size=300, validation_samples=50, instance_samples=60)
    model = PretrainModule(6, trunk, **SMALL, viscous=trunk == "general", instance_steps=10, save_to=str(tmp_path / "operator.safetensors"))
    fit = trainer(tmp_path, enable_checkpointing=True)
    fit.fit(model, data)
    loaded = IntrinsicDynamicsOperator.load(tmp_path / "operator.safetensors")
    assert torch.equal(loaded.latents, model.latents.detach())
    assert {"jelly", "plasticine", "sand"} <= set(loaded.latent_names)
    assert loaded.card["figures"]["val/stress_error"] > 0 and loaded.card["figures"]["instance/stress_error"] > 0

    again = PretrainModule.load_from_checkpoint(fit.checkpoint_callback.best_model_path, weights_only=True)
    assert all(torch.equal(a, b) for a, b in zip(again.state_dict().values(), model.state_dict().values(), strict=True))
    (values,) = trainer(tmp_path).test(model, TrajectoryDataModule(str(folder), batch_size=300), verbose=False)
    assert {"test/stress_mse", "test/plastic_mse", "instance/stress_error", "instance/plastic_error_yielding"} <= set(values)

    assert -1 <= values["test/silhouette"] <= 1 and 0 < values["test/stress_error_zero/elastic"] <= 1
    started = PretrainModule(6, trunk, **SMALL, viscous=trunk == "general", init_from=str(tmp_path / "operator.safetensors"))
    assert torch.equal(started.latents, model.latents)


def test_errors_name_the_option(folder, tmp_path):
    with pytest.raises(UserError, match=r"model.trajectory_count = 7.*6 trajectories"):
        trainer(tmp_path).fit(PretrainModule(7, **SMALL), TrajectoryDataModule(str(folder)))
    with pytest.raises(UserError, match="plastic_target = 'half'"):
        PretrainModule(6, plastic_target="half")
    IntrinsicDynamicsOperator(**SMALL).save(tmp_path / "small.safetensors")
    with pytest.raises(UserError, match="init_from"):
        PretrainModule(6, init_from=str(tmp_path / "small.safetensors"))


RUN = """
import sys, torch
from lightning.pytorch import Trainer, seed_everything
from lightning.pytorch.callbacks import ModelCheckpoint
from neuido.data.trajectories.trajectory_module import TrajectoryDataModule
from neuido.models.stages.pretrain import PretrainModule

root, out, resume = sys.argv[1], sys.argv[2], sys.argv[3:] or [None]
torch.set_num_threads(1)
seed_everything(0)
model = PretrainModule(6, latent_dim=8, basis_dim=8, hidden_dim=16, head_dim=16, instance_steps=0, save_to=out + "/operator.safetensors")
data = TrajectoryDataModule(root, batch_size=120)
checkpoint = ModelCheckpoint(dirpath=out, every_n_train_steps=30, save_last=True)
trainer = Trainer(max_epochs=3, accelerator="cpu", logger=False, callbacks=[checkpoint], gradient_clip_val=1.0, num_sanity_val_steps=0,
                  enable_progress_bar=False, enable_model_summary=False, log_every_n_steps=7)
trainer.fit(model, data, ckpt_path=resume[0])
"""


@pytest.mark.slow
def test_killed_and_resumed_ends_with_the_same_weights(folder, tmp_path):
    def start(out, *resume):
        (tmp_path / out).mkdir(exist_ok=True)
        command = [sys.executable, "-c", RUN, str(folder), str(tmp_path / out), *resume]
        return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, cwd=Path(__file__).parents[3])

    def finish(process):
        _, errors = process.communicate(timeout=HANGS)
        assert process.returncode == 0, errors

    last = tmp_path / "killed" / "last.ckpt"
    killed, whole = start("killed"), start("whole")
    wait_for(last.is_file, killed)
    time.sleep(0.05)
    killed.send_signal(signal.SIGKILL)
    killed.communicate()
    assert killed.returncode == -signal.SIGKILL
    state = torch.load(last, weights_only=True)
    steps = len(order(folder))
    assert 0 < state["global_step"] < 3 * steps and state["global_step"] % steps != 0  # in the middle of an epoch
    assert not (tmp_path / "killed" / "operator.safetensors").exists()

    finish(start("killed", str(last)))
    finish(whole)
    one, two = (IntrinsicDynamicsOperator.load(tmp_path / out / "operator.safetensors") for out in ("killed", "whole"))
    assert torch.equal(one.latents, two.latents)
    for (name, a), b in zip(one.state_dict().items(), two.state_dict().values(), strict=True):
        assert torch.equal(a, b), name
    assert one.card["steps"] == two.card["steps"] == 3 * steps


def order(folder):
    data = TrajectoryDataModule(str(folder), batch_size=120)
    data.setup()
    return data.order


def test_latents_start_as_far_apart_as_asked():
    torch.manual_seed(0)
    wide = PretrainModule(40, **SMALL).latents.detach()
    torch.manual_seed(0)
    near = PretrainModule(40, **SMALL, latent_std=0.1).latents.detach()
    assert wide.std() == pytest.approx(1.0, abs=0.1)  # paper
    assert torch.allclose(near, 0.1 * wide)
    with pytest.raises(UserError, match="latent_std = 0"):
        PretrainModule(40, latent_std=0.0)


def test_decay_draws_back_what_the_laws_do_not_feel():
    """A latent without any gradient shrinks by lr decay a step, and the weights are left to their own decay."""
    model = PretrainModule(40, **SMALL, lr=1e-2, latent_lr_factor=10.0, latent_decay=0.5)
    model.trainer = Trainer(max_steps=100, accelerator="cpu", logger=False, enable_checkpointing=False)
    optimizer = model.configure_optimizers()["optimizer"]
    before = model.latents.detach().clone()
    for p in model.parameters():
        p.grad = torch.zeros_like(p)
    optimizer.step()
    assert torch.allclose(model.latents.detach(), (1 - 0.1 * 0.5) * before)
    assert optimizer.param_groups[0]["weight_decay"] == 1e-4
    with pytest.raises(UserError, match="latent_decay = -1"):
        PretrainModule(40, latent_decay=-1.0)


def test_decay_to_the_family_gathers_each_about_its_own_mean(folder, tmp_path):
    """Weights and latents that learn at no rate but that of the decay: distances within a family shrink, its mean stays."""

    class Still(PretrainModule):
        def training_step(self, batch, batch_idx):
            return 0.0 * (super().training_step(batch, batch_idx) + self.latents.sum())

    def run(to):
        seed_everything(0)
        data = TrajectoryDataModule(str(folder), batch_size=300)
        model = Still(6, **SMALL, instance_steps=0, lr=1e-2, latent_decay=5.0, latent_decay_to=to)
        before = model.latents.detach().clone()
        trainer(tmp_path, max_steps=3, limit_val_batches=0).fit(model, data)
        return data.families, before, model.latents.detach()

    families, before, after = run("family")
    for family in set(families):
        rows = [i for i, name in enumerate(families) if name == family]
        mean = before[rows].mean(0)
        assert torch.allclose(after[rows].mean(0), mean, atol=1e-6)
        shrunk = (after[rows] - mean).norm() / (before[rows] - mean).norm()
        assert 0.05 < shrunk < 0.7
    _, before, after = run("zero")
    assert torch.allclose(after / before, (after / before)[0, 0].expand_as(after), rtol=1e-4)
    with pytest.raises(UserError, match="latent_decay_to = 'mean': choose zero or family"):
        PretrainModule(40, latent_decay_to="mean")
