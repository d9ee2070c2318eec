"""Interruption is no success: a signal ends every command with 128 + n, its state is saved, and it is taken up again."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
import yaml
from lightning.pytorch import Callback, LightningModule, Trainer
from safetensors.torch import load_file

from neuido.commands.cli.interruption import SIGNALS, received, stop_at_step, watched
from neuido.commands.main import main
from neuido.commands.sweep import sweep
from neuido.data.sampling import FixedBatches, ResumableLoader
from tests.small_fits import write_fit
from tests.waiting import HANGS, wait_for

FIT = {
    "model": {"class_path": "PretrainModule", "init_args": {"latent_dim": 4, "instance_steps": 1}},
    "data": {"class_path": "TrajectoryDataModule", "init_args": {"root": "trajectories", "batch_size": 30}},
    "trainer": {
        "max_epochs": 1_000_000,
        "max_steps": -1,
        "accelerator": "cpu",
        "num_sanity_val_steps": 0,
        "limit_val_batches": 0,
        "enable_progress_bar": False,
        "log_every_n_steps": 1,
        "logger": {"class_path": "lightning.pytorch.loggers.CSVLogger", "init_args": {"save_dir": "log", "flush_logs_every_n_steps": 1}},
    },
}

BEGUN: list[subprocess.Popen] = []


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A folder with small trajectories and the configuration of a fit that has no end by itself."""
    return write_fit(tmp_path_factory.mktemp("fit"), FIT)


@pytest.fixture(autouse=True)
def no_process_stays():
    """Kill what a failed test leaves running."""
    yield
    while BEGUN:
        process = BEGUN.pop()
        if process.poll() is None:
            process.kill()
            process.communicate()


def heed_signals() -> None:
    """Undo what is inherited: background jobs of a shell ignore SIGINT, and commands of nohup SIGHUP."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


def begin(folder: Path, *args: str) -> subprocess.Popen:
    command = [sys.executable, "-m", "neuido", *args]
    pipe = subprocess.PIPE
    BEGUN.append(subprocess.Popen(command, cwd=folder, stderr=pipe, stdout=pipe, text=True, preexec_fn=heed_signals))
    return BEGUN[-1]


def logged(folder: Path) -> bool:
    return any(path.read_text().count("\n") > 2 for path in folder.rglob("metrics.csv"))


def fit(folder: Path, *more: str) -> tuple[str, ...]:
    return ("fit", "--config", str(folder / "fit.yaml"), "--data.root", str(folder / "trajectories"), *more)


def interrupted(folder: Path, number: signal.Signals, *args: str) -> Path:
    """The state that a fit leaves which gets a signal once it is at work."""
    process = begin(folder, *args)
    wait_for(lambda: logged(folder), process)
    process.send_signal(number)
    _, err = process.communicate(timeout=HANGS)
    assert process.returncode == 128 + number, err
    assert err.splitlines()[-1] == f"neuido: interrupted by {number.name}" and "Traceback" not in err
    (state,) = folder.rglob("interrupted.ckpt")
    assert f"{state.relative_to(folder)}: --ckpt_path" in err
    return state


@pytest.mark.slow
def test_a_fit_ends_after_its_step_with_its_state(made, tmp_path):
    state = interrupted(tmp_path, signal.SIGTERM, *fit(made))
    assert torch.load(state, weights_only=True)["global_step"] >= 2


@pytest.mark.slow
def test_an_interrupted_fit_goes_on_to_the_same_bits(made, tmp_path):
    end = ["--trainer.max_steps=1500", "--trainer.max_epochs=-1"]
    state = interrupted(tmp_path, signal.SIGHUP, *fit(made, *end))
    assert torch.load(state, weights_only=True)["global_step"] < 1500
    for name, more in (("resumed", [f"--ckpt_path={state}"]), ("whole", [])):
        done = begin(tmp_path, *fit(made, *end, f"--model.save_to={name}.safetensors", *more))
        assert done.communicate(timeout=HANGS) and done.returncode == 0
    resumed, whole = (load_file(tmp_path / f"{name}.safetensors") for name in ("resumed", "whole"))
    assert resumed.keys() == whole.keys() and all(torch.equal(resumed[name], whole[name]) for name in whole)


class Points(ResumableLoader[torch.Tensor]):
    """Two batches of points an epoch."""

    def __len__(self) -> int:
        return 2

    def batches(self, epoch: int, start: int) -> list[torch.Tensor]:
        return list(torch.linspace(0.0, 1.0, 8).reshape(2, 2, 2)[start:])


class Line(LightningModule):
    """A line through points."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.layer = torch.nn.Linear(2, 1)

    def training_step(self, batch, _):
        return (self.layer(batch) - 1.0).square().mean()

    def validation_step(self, batch, _):
        self.layer(batch)

    def configure_optimizers(self):
        return torch.optim.Adam(self.parameters(), lr=0.1)

    def train_dataloader(self):
        return Points({})

    def val_dataloader(self):
        return FixedBatches(Points({}).batches(0, 0))


class Terminates(Callback):
    """Send SIGTERM to this process by a hook of the second epoch, after the hook that ends a fit."""

    def __init__(self, hook: str) -> None:
        setattr(self, hook, self.send)

    def send(self, trainer: Trainer, *_) -> None:
        if trainer.current_epoch == 1 and not received():
            signal.raise_signal(signal.SIGTERM)


def fitted(state: Path, *callbacks: Callback, ckpt_path: Path | None = None) -> list[float]:
    module = Line()
    trainer = Trainer(
        max_epochs=4, accelerator="cpu", logger=False, enable_progress_bar=False, enable_model_summary=False, num_sanity_val_steps=0,
        enable_checkpointing=False, callbacks=[stop_at_step(state), *callbacks],
    )  # fmt: skip
    trainer.fit(module, ckpt_path=ckpt_path, weights_only=True)
    return torch.cat([part.detach().flatten() for part in module.parameters()]).tolist()


@pytest.mark.parametrize("hook", ["on_train_batch_start", "on_train_batch_end", "on_train_epoch_end", "on_validation_batch_end"])
def test_sigterm_leaves_the_state_wherever_it_comes(tmp_path, hook):
    """Lightning has a handler of its own for SIGTERM, which ends a fit between two hooks."""
    state = tmp_path / "interrupted.ckpt"
    with watched(), pytest.raises(SystemExit):
        fitted(state, Terminates(hook))
    assert state.is_file()
    with watched():
        assert fitted(state, ckpt_path=state) == fitted(tmp_path / "none.ckpt")


@pytest.mark.slow
@pytest.mark.parametrize("number", SIGNALS)
def test_a_light_command_ends_with_the_signal_and_leaves_nothing_half_written(tmp_path, number):
    args = ["trajectories", "--out", "out", "--instances=1", "--held_out=0", "--setup.steps=200000", "--device=cpu", "--progress=false"]
    process = begin(tmp_path, *args)
    wait_for(lambda: (tmp_path / "out" / "plan.json").exists(), process)
    process.send_signal(number)
    _, err = process.communicate(timeout=HANGS)
    assert process.returncode == 128 + number and err.startswith("neuido: interrupted") and err.count("\n") == 1
    assert [path.name for path in (tmp_path / "out").iterdir() if not path.name.startswith(".")] == ["plan.json"]


def test_a_signal_that_was_ignored_stays_so(tmp_path):
    code = (
        "import signal, os, sys; signal.signal(signal.SIGHUP, signal.SIG_IGN)\n"
        "import neuido.commands.main as m\n"
        "m._dispatch = lambda args: os.kill(os.getpid(), signal.SIGHUP)\n"
        "m.main(['doctor'])"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def sweep_file(folder: Path, command: list[str], **parameters) -> str:
    path = folder / "plan.yaml"
    content = {"method": "grid", "program": "neuido", "command": command, "parameters": {k: {"values": v} for k, v in parameters.items()}}
    path.write_text(yaml.safe_dump(content))
    return str(path)


def status(folder: Path) -> list[str]:
    return [json.loads(path.read_text())["status"] for path in sorted(folder.glob("*/run.json"))]


@pytest.mark.slow
def test_a_sweep_takes_an_interrupted_fit_up_again(made, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command = [sys.executable, "-m", "neuido", *fit(made, "--trainer.max_epochs=1000000"), "${args}"]
    file = sweep_file(tmp_path, command, **{"model.lr": [1e-3]})
    process = begin(tmp_path, "sweep", file, "--out", "out", "--report=false")
    wait_for(lambda: logged(tmp_path / "out"), process)
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=HANGS)
    assert process.returncode == 128 + signal.SIGTERM and status(tmp_path / "out") == ["interrupted"]
    (state,) = (tmp_path / "out").rglob("interrupted.ckpt")
    step = torch.load(state, weights_only=True)["global_step"]
    before = set((tmp_path / "out").rglob("metrics.csv"))
    process = begin(tmp_path, "sweep", file, "--out", "out", "--report=false")
    wait_for(
        lambda: any(p.read_text().count("\n") > 2 for p in set((tmp_path / "out").rglob("metrics.csv")) - before),
        process,
    )
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=HANGS)
    assert torch.load(state, weights_only=True)["global_step"] > step


def test_a_run_that_a_signal_ended_is_not_done_and_starts_again(tmp_path, monkeypatch):
    """The signal reaches the run alone, which ends by its own handler or by none."""
    script = "import os, signal, sys; os.path.exists('again') or (open('again', 'w'), %s)"
    for i, end in enumerate(("os.kill(os.getpid(), signal.SIGTERM)", "sys.exit(143)")):
        folder = tmp_path / str(i)
        folder.mkdir()
        monkeypatch.chdir(folder)
        file = sweep_file(folder, [sys.executable, "-c", script % end], a=[1])
        assert sweep(file, out=str(folder / "out")) == 1 and status(folder / "out") == ["interrupted"]
        assert sweep(file, out=str(folder / "out")) == 0 and status(folder / "out") == ["done"]
        assert "interrupted" not in (folder / "out" / "results.csv").read_text()


def test_a_worker_that_was_forked_dies_of_its_signal():
    with watched():
        child = os.fork()
        if child == 0:
            try:
                os.kill(os.getpid(), signal.SIGTERM)
                time.sleep(5)
            finally:
                os._exit(3)
        _, ended = os.waitpid(child, 0)
    assert os.WIFSIGNALED(ended) and os.WTERMSIG(ended) == signal.SIGTERM


@pytest.mark.parametrize("call", [2, 3, 4, 5], ids=["set", "all set", "restored", "half restored"])
def test_a_signal_while_handlers_are_set_or_restored_ends_in_one_line(monkeypatch, capfd, call):
    handlers, calls, real = [signal.getsignal(number) for number in SIGNALS], [], signal.signal

    def interrupted_by(number, handler):
        before = real(number, handler)
        calls.append(number)
        if len(calls) == call:
            signal.raise_signal(signal.SIGTERM)  # in this thread: a signal to the process may reach another one, and that later
        return before

    monkeypatch.setattr("neuido.commands.main._dispatch", lambda args: 0)
    try:
        with monkeypatch.context() as patch, pytest.raises(SystemExit) as stop:
            for number in SIGNALS:  # what pytest has would end it, and what is ignored, as in a background job, gets no handler
                real(number, lambda *_: None)
            patch.setattr(signal, "signal", interrupted_by)
            main(["doctor"])
    finally:
        for number, handler in zip(SIGNALS, handlers):
            real(number, handler)
    late = call == 5  # SIGTERM has its earlier handler again
    assert stop.value.code == (0 if late else 128 + signal.SIGTERM)
    assert capfd.readouterr().err == ("" if late else "neuido: interrupted by SIGTERM\n")


def test_an_early_ctrl_c_shows_no_traceback():
    code = (
        "import builtins, os, signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "import neuido.__main__ as program; real = builtins.__import__\n"
        "def late(name, *rest):\n    if name == 'neuido.commands.main': os.kill(os.getpid(), signal.SIGINT)\n    return real(name, *rest)\n"
        "builtins.__import__ = late; program.run()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == -signal.SIGINT and not done.stderr
