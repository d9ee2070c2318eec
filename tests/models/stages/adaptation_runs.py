"""Adaptations of tiny scenes in processes of their own, with a checkpoint after each step, that tests kill and resume."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from tests.waiting import HANGS, wait_for

ROOT = Path(__file__).parents[3]


def rows_of(path):
    return list(csv.DictReader(path.open()))


SCRIPT = """
import json, sys, time
import torch
from lightning.pytorch import Callback, Trainer, seed_everything
from lightning.pytorch.callbacks import ModelCheckpoint
from neuido.models.stages.adapt import AdaptModule
from neuido.models.fewshot.low_rank import LowRankAdaptation
from tests.models.visual_samples import TinyScenes

torch.set_num_threads(1)
out, pause, resume, youngs, ranks, devices, more = sys.argv[1], float(sys.argv[2]), sys.argv[3], *json.loads(sys.argv[4])

class Record(Callback):
    def on_train_batch_end(self, trainer, module, outputs, batch, index):
        with open(f"{out}/losses.txt", "a") as file:
            if not module._idle:
                print(batch.name, index, f"{float(outputs['loss']):.9g}", file=file)
        time.sleep(pause)

if __name__ == "__main__":
    seed_everything(0)
    method = LowRankAdaptation(start="mean", latent_lr=0.03)
    more = {"steps": 4, "stop_on": "loss", "check_every": 2, **more}
    model = AdaptModule(method, curriculum=[0.5], views_per_step=1, out=f"{out}/out", **more)
    keep = ModelCheckpoint(dirpath=out, save_last=True, save_top_k=0, every_n_train_steps=1)
    options = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False, "num_sanity_val_steps": 0}
    options |= {"limit_val_batches": 0, "gradient_clip_val": 1.0, "max_epochs": -1}
    options |= {"strategy": "auto" if ranks == 1 else "scenes", "num_nodes": ranks // devices}
    trainer = Trainer(accelerator="cpu", devices=devices, callbacks=[Record(), keep], **options)
    trainer.fit(model, TinyScenes(out, youngs=youngs), ckpt_path=None if resume == "no" else resume, weights_only=True)
"""


def start(folder, pause=0.0, resume="no", *, youngs=(4e4, 2e5), ranks=1, devices=0, launcher=(), **more):
    """Begin an adaptation: `devices` processes on each machine of `ranks` together; `launcher` starts them instead of Lightning."""
    folder.mkdir(exist_ok=True)
    script = folder / "run.py"
    script.write_text(SCRIPT)
    paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1", "GLOO_SOCKET_IFNAME": "lo"}
    how = json.dumps([youngs, ranks, devices or ranks, more])
    arguments = [sys.executable, *launcher, str(script), str(folder), str(pause), resume, how]
    return subprocess.Popen(
        arguments, env=environment, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    )


def finish(process):
    printed, _ = process.communicate(timeout=HANGS)
    assert process.returncode == 0, printed[-3000:]


def losses(folder):
    path = folder / "losses.txt"
    rows = [line.split() for line in path.read_text().splitlines()] if path.is_file() else []
    return {(name, int(index)): float(loss) for name, index, loss in rows}


def kill_after(process, folder, steps):
    """Kill a run in the pause after so many steps, whose checkpoint is written."""
    wait_for(lambda: len(losses(folder)) >= steps, process)
    time.sleep(0.3)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert process.returncode == -signal.SIGKILL and steps <= len(losses(folder)) < 8
