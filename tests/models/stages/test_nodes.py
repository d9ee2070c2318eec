"""Training on two nodes by torchrun, played by two launchers on this machine: what one does, and no rank waits for one that died."""

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from tests.small_fits import write_fit
from tests.waiting import HANGS, wait_for

ROOT = Path(__file__).parents[3]
RANKS = 4
FIT = {
    "seed_everything": 0,
    "model": {"class_path": "PretrainModule", "init_args": {"latent_dim": 4, "instance_steps": 1}},
    "data": {"class_path": "TrajectoryDataModule", "init_args": {"root": "trajectories", "batch_size": 30, "num_workers": 0}},
    "trainer": {
        "accelerator": "cpu",
        "max_epochs": -1,
        "num_sanity_val_steps": 0,
        "limit_val_batches": 0,
        "enable_progress_bar": False,
        "logger": {"class_path": "lightning.pytorch.loggers.CSVLogger", "init_args": {"save_dir": "log"}},
        "callbacks": [
            {"class_path": "lightning.pytorch.callbacks.ModelCheckpoint",
             "init_args": {"dirpath": "kept", "save_last": True, "save_top_k": 0, "every_n_train_steps": 1}}
        ],
    },
}  # fmt: skip


@pytest.fixture
def folder(tmp_path):
    return write_fit(tmp_path, FIT)


def begin(folder: Path, *command: str) -> subprocess.Popen:
    paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    own = {"PYTHONPATH": paths, "OMP_NUM_THREADS": "1", "GLOO_SOCKET_IFNAME": "lo"}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    return subprocess.Popen([sys.executable, *command], cwd=folder, env=os.environ | own, start_new_session=True, **pipes)


def nodes(folder: Path, *options: str) -> list[subprocess.Popen]:
    """Start two launchers of two ranks each, as on two machines."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    ranks = ["--nnodes=2", f"--nproc-per-node={RANKS // 2}", "--master-addr=127.0.0.1", f"--master-port={port}"]
    shared = ["--trainer.strategy=ddp", f"--trainer.devices={RANKS // 2}", "--trainer.num_nodes=2"]
    fit = ["-m", "neuido", "fit", "--config", "fit.yaml", *shared, *options]
    return [begin(folder, "-m", "torch.distributed.run", *ranks, f"--node-rank={node}", *fit) for node in range(2)]


@pytest.mark.slow
def test_two_nodes_do_what_one_process_does_with_all_batches(folder):
    fit = ["--trainer.max_steps=5"]
    alone = begin(folder, "-m", "neuido", "fit", "--config", "fit.yaml", *fit, "--model.save_to=one.safetensors",
                  f"--trainer.accumulate_grad_batches={RANKS}")  # fmt: skip
    for process in (alone, *nodes(folder, *fit, "--model.save_to=four.safetensors")):
        printed, _ = process.communicate(timeout=HANGS)
        assert process.returncode == 0, printed[-3000:]
    one, four = (load_file(folder / f"{name}.safetensors") for name in ("one", "four"))
    assert one.keys() == four.keys()
    for name in one:
        assert torch.allclose(one[name], four[name], atol=1e-6, rtol=1e-4), name


@pytest.mark.slow
def test_a_rank_that_dies_ends_all_within_a_minute_and_the_rest_is_resumed(folder):
    both = nodes(folder, "--trainer.max_steps=1000000")
    last = folder / "kept" / "last.ckpt"
    wait_for(last.is_file, both[0])
    children = Path(f"/proc/{both[1].pid}/task/{both[1].pid}/children").read_text().split()
    os.kill(int(children[-1]), signal.SIGKILL)
    died, printed = time.monotonic(), []
    try:
        for process in both:
            printed.append(process.communicate(timeout=60)[0])  # the promise itself
            assert process.returncode not in (0, None)
    finally:
        for process in both:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
    assert time.monotonic() - died < 60
    assert "neuido: another process of this training has ended" in "".join(printed)
    done = torch.load(last, weights_only=True)["global_step"]
    for process in nodes(folder, f"--trainer.max_steps={done + 1}", f"--ckpt_path={last}"):
        assert process.communicate(timeout=HANGS) and process.returncode == 0
    assert torch.load(last, weights_only=True)["global_step"] == done + 1
