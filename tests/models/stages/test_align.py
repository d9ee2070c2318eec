"""Stage II: a step lowers the loss, frozen parts stay, two processes do what one does, and a killed run goes on where it was."""

import csv
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from lightning.pytorch import Trainer, seed_everything

from neuido.errors import UserError
from neuido.models.operator.law_properties import p_wave_modulus
from neuido.models.stages.align import AlignModule
from neuido.models.stages.image_module import sample_views
from neuido.models.video.encoder import DynamicsEncoder
from neuido.models.video.flow_vae import FlowVAE
from tests.models.visual_samples import TinyScenes, tiny_scene
from tests.waiting import HANGS, wait_for

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def vae(tmp_path_factory):
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("vae") / "vae.safetensors"
    FlowVAE(8).save(path)
    return str(path)


def module(vae, **options):
    seed_everything(0)
    return AlignModule(**{"vae": vae, "flow_size": 32, "width": 48, "lr": 3e-3, "curriculum": [0.5], **options})


def trainer(tmp_path, **options):
    options = {"logger": False, "enable_checkpointing": False, "num_sanity_val_steps": 0, "limit_val_batches": 0, **options}
    return Trainer(accelerator="cpu", default_root_dir=tmp_path, enable_progress_bar=False, enable_model_summary=False, **options)


@pytest.mark.slow
def test_training_lowers_the_loss_and_finds_the_stiffness(vae, tmp_path):
    options = {"operator": "pretrained-objective", "curriculum": [], "cache": str(tmp_path / "flow")}
    model = module(vae, save_to=str(tmp_path / "encoder.safetensors"), **options)
    frozen = {name: p.clone() for name, p in model.named_parameters() if "projector" not in name}
    data = TinyScenes(str(tmp_path), youngs=(5e4,))
    prepared = model.prepared(data.scenes[0])
    losses = []
    step = model.training_step
    model.training_step = lambda *a: losses.append(step(*a)) or losses[-1]
    trainer(tmp_path, max_epochs=12, gradient_clip_val=1.0).fit(model, data)
    assert len(losses) == 12 and losses[-1] < 0.2 * losses[0]
    assert all(torch.equal(p, dict(model.named_parameters())[name]) for name, p in frozen.items())
    assert len(list((tmp_path / "flow").glob("*.npz"))) == 1
    with torch.no_grad():
        found = p_wave_modulus(model.operator, model.encoder(prepared.volume, prepared.conditions)[None])
    assert float(found) == pytest.approx(6e4, rel=0.25)  # the P-wave modulus of 5e4 Pa, 0.25
    assert DynamicsEncoder.load(tmp_path / "encoder.safetensors").card["scenes"] == ["tiny-0"]


def test_a_small_step_against_the_gradient_lowers_the_loss(vae, tmp_path):
    model = module(vae, curriculum=[])
    scene = tiny_scene(tmp_path)
    parameters = list(model.encoder.projector.parameters())
    before = model.training_step(scene, 0)
    gradients = torch.autograd.grad(before, parameters, allow_unused=True)
    square = sum(g.square().sum() for g in gradients if g is not None)
    with torch.no_grad():
        for p, g in zip(parameters, gradients):
            if g is not None:
                p -= 1e-3 * before / square * g
    after = model.training_step(scene, 0)
    assert 0.5e-3 < float((before - after) / before) < 1.5e-3  # what the gradient promises is 1e-3


def test_curriculum_and_views(vae, tmp_path):
    model = module(vae, curriculum=[0.4, 0.7], curriculum_share=0.5, views_per_step=1)
    prepared = model.prepared(tiny_scene(tmp_path))
    model._total = 8
    frames = []
    for step in range(8):
        type(model).global_step = property(lambda self, step=step: step)
        frames.append(model.rollout_frames(prepared))
    del type(model).global_step
    assert frames == [3, 3, 5, 5, 6, 6, 6, 6]
    drawn = [sample_views(prepared.training_views, 1, step) for step in range(8)]
    assert all(len(views) == 1 for views in drawn) and {view for views in drawn for view in views} == set(prepared.training_views)


def test_a_law_that_cannot_run_is_drawn_back(vae, tmp_path, capsys):
    model = module(vae, curriculum=[])
    scene = tiny_scene(tmp_path)
    with torch.no_grad():
        model.encoder.projector.head[-1].bias += 60.0
    before = model.training_step(scene, 0)
    assert "tiny:" in capsys.readouterr().err
    before.backward()
    assert model.encoder.projector.head[-1].bias.grad.mean() > 0


def test_scores_and_baselines(vae, tmp_path):
    model = module(vae, out=str(tmp_path / "out"), baselines=2)
    data = TinyScenes(str(tmp_path), youngs=(4e4,), unseen=(2e5,))
    (figures,) = trainer(tmp_path).test(model, data, verbose=False)[:1]
    for name in ("cd", "floor", "rmse", "psnr", "ssim", "crop_psnr"):
        assert figures[f"test/{name}"] > 0
    assert "test/lpips" not in figures  # absent, not zero
    rows = list(csv.DictReader((tmp_path / "out" / "scores.csv").open()))
    assert [row["scene"] for row in rows] == ["tiny-0", "unseen-0"]
    assert float(rows[1]["cd_mean"]) > 0 and rows[0]["cd_mean"] == ""
    steps = list(csv.DictReader((tmp_path / "out" / "unseen-0" / "particles.csv").open()))
    assert [int(row["frame"]) for row in steps] == [1, 2, 3, 4, 5]
    images = list(csv.DictReader((tmp_path / "out" / "tiny-0" / "images.csv").open()))
    assert {row["view"] for row in images} == {"2"}  # the one that is held out


def test_impossible_options_are_named(vae):
    with pytest.raises(UserError, match="curriculum"):
        module(vae, curriculum=[1.5])
    with pytest.raises(UserError, match="silhouette_weight"):
        module(vae, silhouette_weight=-1.0)
    with pytest.raises(UserError, match="lr"):
        module(vae, lr=0.0)


SCRIPT = """
import sys, time
import torch
from lightning.pytorch import Callback, Trainer, seed_everything
from lightning.pytorch.callbacks import ModelCheckpoint
from neuido.models.stages.align import AlignModule
from tests.models.visual_samples import TinyScenes

torch.set_num_threads(1)
out, vae, processes, epochs, pause, resume = sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4]), float(sys.argv[5]), sys.argv[6]

class Record(Callback):
    def on_train_batch_end(self, trainer, module, outputs, batch, index):
        with open(f"{out}/losses-{trainer.global_rank}.txt", "a") as file:
            print(trainer.current_epoch, batch.name, f"{float(outputs['loss']) * trainer.accumulate_grad_batches:.9g}", file=file)
        time.sleep(pause)

if __name__ == "__main__":
    seed_everything(0)
    model = AlignModule(vae=vae, flow_size=32, width=48, lr=3e-3, curriculum=[0.5], curriculum_share=0.5)
    options = {"strategy": "ddp", "devices": 2} if processes == 2 else {"devices": 1, "accumulate_grad_batches": 2 if processes == 1 else 1}
    keep = ModelCheckpoint(dirpath=out, save_last=True, save_top_k=0, every_n_train_steps=1)
    options |= {"logger": False, "enable_progress_bar": False, "enable_model_summary": False, "num_sanity_val_steps": 0}
    options |= {"limit_val_batches": 0, "use_distributed_sampler": False, "gradient_clip_val": 1.0}
    trainer = Trainer(accelerator="cpu", max_epochs=epochs, callbacks=[Record(), keep], **options)
    trainer.fit(model, TinyScenes(out), ckpt_path=None if resume == "no" else resume, weights_only=True)
    if trainer.is_global_zero:
        torch.save(model.encoder.projector.state_dict(), f"{out}/projector.pt")
"""


def start(folder, vae, processes, epochs, pause=0.0, resume="no"):
    folder.mkdir(exist_ok=True)
    script = folder / "run.py"
    script.write_text(SCRIPT)
    paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1", "GLOO_SOCKET_IFNAME": "lo"}
    arguments = [sys.executable, str(script), str(folder), vae, str(processes), str(epochs), str(pause), resume]
    return subprocess.Popen(arguments, env=environment, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def finish(process):
    printed, _ = process.communicate(timeout=HANGS)
    assert process.returncode == 0, printed[-3000:]


def losses(folder):
    rows = [line.split() for path in sorted(folder.glob("losses-*.txt")) for line in path.read_text().splitlines()]
    return {(int(epoch), name): float(loss) for epoch, name, loss in rows}


@pytest.mark.slow
def test_two_processes_do_what_one_does_with_both_scenes(vae, tmp_path):
    runs = {count: start(tmp_path / str(count), vae, count, 2) for count in (1, 2)}
    for process in runs.values():
        finish(process)
    one, two = losses(tmp_path / "1"), losses(tmp_path / "2")
    assert len(one) == 4 and one.keys() == two.keys()
    for key, loss in one.items():
        assert two[key] == pytest.approx(loss, rel=1e-4), key
    assert len((tmp_path / "2" / "losses-1.txt").read_text().splitlines()) == 2  # each process had a scene an epoch


@pytest.mark.slow
def test_a_killed_run_goes_on_where_it_was(vae, tmp_path):
    whole, broken = start(tmp_path / "whole", vae, 0, 4), start(tmp_path / "broken", vae, 0, 4, pause=0.5)
    last = tmp_path / "broken" / "last.ckpt"
    wait_for(lambda: len(losses(tmp_path / "broken")) >= 4, broken)
    broken.send_signal(signal.SIGKILL)
    broken.communicate()
    assert broken.returncode == -signal.SIGKILL
    finish(whole)
    before = len(losses(tmp_path / "broken"))
    assert 4 <= before < 8 and last.is_file()
    again = start(tmp_path / "broken", vae, 0, 4, resume=str(last))
    finish(again)
    expected, resumed = losses(tmp_path / "whole"), losses(tmp_path / "broken")
    assert expected.keys() == resumed.keys()
    for key, loss in expected.items():
        assert resumed[key] == pytest.approx(loss, rel=1e-5), key
    parts = [torch.load(tmp_path / name / "projector.pt", weights_only=True) for name in ("whole", "broken")]
    assert all(torch.allclose(parts[0][name], parts[1][name], atol=1e-6) for name in parts[0])
