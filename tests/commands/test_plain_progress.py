"""Where a trainer has no terminal, plain lines stand in the place of its bar."""

import pytest
import torch
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import TQDMProgressBar

from neuido.commands.cli.plain_progress import needs_plain_lines, plain_progress
from neuido.data.progress import Progress


class Small(LightningModule):
    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(()))

    def training_step(self, batch, _):
        loss = (self.weight - batch.mean()).square()
        self.log("loss", loss, prog_bar=True)
        return loss

    def test_step(self, batch, batch_idx):
        self.log("error", self.weight)

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=0.1)


@pytest.fixture
def lines(monkeypatch):
    """The last plain line of each progress."""
    found, close = [], Progress.close
    monkeypatch.setattr(Progress, "close", lambda self: (found.append(self.line(self.begun + 60)), close(self)))
    return found


def trainer(tmp_path, **options) -> Trainer:
    off = {"logger": False, "enable_checkpointing": False, "enable_model_summary": False, "accelerator": "cpu"}
    return Trainer(default_root_dir=tmp_path, callbacks=[plain_progress()], **off, **options)


def test_lines_of_a_fit_and_of_a_test(tmp_path, lines):
    data = torch.utils.data.DataLoader(torch.ones(6, 1))
    trainer(tmp_path, max_steps=4, max_epochs=-1).fit(Small(), data)
    assert (
        len(lines) == 1
        and lines[0].startswith("fit: 4 of 4 steps, epoch 0, loss ")
        and lines[0].endswith("1 min 0 s elapsed, about 0 s left")
    )
    trainer(tmp_path).test(Small(), data)
    assert len(lines) == 2 and lines[1].startswith("test: 6 of 6 batches")


class Talking(Small):
    def on_train_end(self):
        self.print("the end of training")


def test_a_module_prints_beside_the_lines(tmp_path, lines, capsys):
    trainer(tmp_path, max_steps=1).fit(Talking(), torch.utils.data.DataLoader(torch.ones(2, 1)))
    assert "the end of training" in capsys.readouterr().out


def test_a_bar_that_the_user_chose_or_turned_off_stays_so(monkeypatch):
    assert needs_plain_lines({}) and not needs_plain_lines({"enable_progress_bar": False})
    assert not needs_plain_lines({"callbacks": [TQDMProgressBar()]})
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    assert not needs_plain_lines({})
