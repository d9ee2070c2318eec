"""What the trainer's commands print in the end, and the folder that they hold."""

import os
from pathlib import Path

import pytest
import torch
from lightning.pytorch import LightningDataModule, LightningModule

from neuido.commands.cli.trainer import run_lightning
from neuido.data.files.output_folder import held_folder
from neuido.errors import UserError


class Line(LightningModule):
    commands_with_results = ("test",)

    def __init__(self, out: str = "out", broken: bool = False) -> None:
        super().__init__()
        self.save_hyperparameters()
        self.layer = torch.nn.Linear(1, 1)

    def training_step(self, batch, batch_idx):
        loss = self.layer(batch).square().mean()
        self.log("train/loss", loss)
        return loss

    def test_step(self, batch, batch_idx):
        self.log("test/error", 0.25)
        self.log("test/error/one-scene", 0.5)
        if self.hparams.broken:
            raise UserError("broken")
        with (
            pytest.raises(UserError, match=f"model.out = .* is held by process {os.getpid()}"),
            held_folder(self.place(), option="model.out"),
        ):
            pass
        (self.place() / "scores.csv").write_text("error\n0.25\n")

    validation_step = training_step

    def place(self):
        return Path(self.hparams.out)

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), 0.1)


class Ones(LightningDataModule):
    def train_dataloader(self):
        return torch.utils.data.DataLoader(torch.ones(2, 1))

    val_dataloader = test_dataloader = train_dataloader


def command(tmp_path, name, *words, logger=True):
    here = __name__
    logs = ["CSVLogger", "--trainer.logger.save_dir", str(tmp_path), "--trainer.logger.name", "log"] if logger else ["false"]
    out = ["--model.out", str(tmp_path / "deep" / "out")]
    quiet = ["--trainer.enable_progress_bar", "false", "--trainer.accelerator", "cpu"]
    steps = ["--trainer.max_steps", "2"] if name == "fit" else []
    model = ["--model", f"{here}.Line", *out, "--data", f"{here}.Ones"]
    run_lightning([name, *model, "--trainer.logger", *logs, *quiet, *steps, *words])


def test_fit_says_where_its_log_and_checkpoint_are(tmp_path, capsys):
    for version in ("version_0", "version_1"):  # a used folder is not written again
        command(tmp_path, "fit")
        *_, metrics, results = capsys.readouterr().out.strip().splitlines()
        log = tmp_path / "log" / version
        assert metrics.startswith("last metrics: ") and "train/loss 0" in metrics
        saved = next((log / "checkpoints").glob("*.ckpt"))
        assert results == f"results in {log} (log); checkpoint in {saved}"
    assert not (tmp_path / "deep").exists()


def test_a_test_holds_the_folder_of_its_results(tmp_path, capsys):
    command(tmp_path, "test")
    *_, metrics, results = capsys.readouterr().out.strip().splitlines()
    folder = tmp_path / "deep" / "out"
    assert metrics == "last metrics: test/error 0.25"
    assert results == f"results in {folder} (tables and fits); log in {tmp_path / 'log' / 'version_0'}"
    assert [path.name for path in folder.iterdir()] == ["scores.csv"]
    with held_folder(folder), pytest.raises(UserError, match="is held by process"):
        command(tmp_path, "test")


def test_a_refused_test_leaves_no_folder(tmp_path):
    with pytest.raises(UserError, match="broken"):
        command(tmp_path, "test", "--model.broken", "true")
    assert not (tmp_path / "deep").exists()


def test_nothing_is_written(tmp_path, capsys):
    command(tmp_path, "validate", logger=False)
    assert capsys.readouterr().out.strip().endswith("no results are written: neither a logger nor a checkpoint is on")
