"""Trainings pass over a step whose gradient is not finite, end where all are, and write no file of NaN."""

import pytest
import torch
from lightning.pytorch import Trainer
from torch.utils.data import DataLoader

from neuido.data.weight_files import read_safetensors, write_safetensors
from neuido.errors import UserError
from neuido.models.stages import training
from neuido.models.stages.adapt import AdaptModule
from neuido.models.stages.align import AlignModule
from neuido.models.stages.pretrain import PretrainModule
from neuido.models.stages.pretrain_vae import FlowVAEModule
from neuido.models.stages.training import SteadyModule
from neuido.models.stages.warmup import WarmupModule


class Slope(SteadyModule):
    """Two weights under the loss w . x, each with momentum, so that a gradient of zero would still move them."""

    def __init__(self):
        super().__init__()
        self.save_hyperparameters({"lr": 0.1})
        self.w, self.b = torch.nn.Parameter(torch.ones(2)), torch.nn.Parameter(torch.ones(()))
        self.path = []

    def configure_optimizers(self):
        return torch.optim.AdamW(self.parameters(), lr=0.1)

    def training_step(self, x, batch_idx):
        return (self.w * x).sum() + self.b + (torch.inf if bool((x < 0).all()) else 0.0)

    def on_train_batch_end(self, outputs, batch, batch_idx):
        self.path.append(self.w.detach().clone())


def fit(rows):
    module = Slope()
    options = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False, "enable_model_summary": False}
    trainer = Trainer(accelerator="cpu", max_epochs=1, gradient_clip_val=1.0, **options)
    trainer.fit(module, DataLoader(torch.tensor(rows), batch_size=None))
    return module, trainer


@pytest.mark.parametrize("bad", [[torch.inf, 1.0], [torch.nan, 1.0], [-1.0, -1.0]], ids=["gradient", "nan", "loss"])
def test_a_bad_step_is_skipped_whole(bad, capfd):
    module, trainer = fit([[1.0, 2.0], bad, [1.0, 2.0], [2.0, 1.0]])
    first, second, third, last = module.path
    assert torch.equal(first, second) and not torch.equal(second, third) and not torch.equal(third, last)
    assert last.isfinite().all() and module.skipped == 1 and float(trainer.callback_metrics["train/failed"]) == 1
    assert "step 1 is skipped" in capfd.readouterr().err


def test_a_training_of_bad_steps_alone_ends(monkeypatch):
    monkeypatch.setattr(training, "SKIPPED_IN_A_ROW", 3)
    with pytest.raises(UserError, match=r"as in the 2 before; lower model.lr = 0.1"):
        fit([[1.0, 2.0], *[[torch.nan, 1.0]] * 4])
    module, _ = fit([*[[torch.nan, 1.0]] * 2, [1.0, 1.0], *[[torch.nan, 1.0]] * 2])
    assert module.skipped == 4


def test_every_stage_is_steady():
    for stage in (PretrainModule, FlowVAEModule, WarmupModule, AlignModule, AdaptModule):
        assert issubclass(stage, SteadyModule)


def test_no_file_of_nan_is_written(tmp_path):
    path = tmp_path / "weights.safetensors"
    write_safetensors(path, {"a": torch.ones(2), "n": torch.tensor([3])}, {"format": "x"})
    with pytest.raises(UserError, match=r"is not written: b holds a NaN or an infinity"):
        write_safetensors(path, {"a": torch.zeros(2), "b": torch.tensor([0.0, torch.nan])})
    tensors, metadata = read_safetensors(path)
    assert torch.equal(tensors["a"], torch.ones(2)) and metadata == {"format": "x"} and len(list(tmp_path.iterdir())) == 1
