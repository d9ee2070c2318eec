"""A checkpoint names no path, no module and no class: of its hyperparameters the numbers count alone."""

import pytest
import torch
from lightning.pytorch.cli import LightningCLI

from neuido.commands.cli.config_files import find_config
from neuido.commands.cli.trainer import run_lightning
from neuido.errors import UserError


def parsed(monkeypatch, path, hyperparameters):
    class Stop(Exception):
        pass

    def stop(self):
        raise Stop(self.config)

    torch.save({"state_dict": {}, "hyper_parameters": hyperparameters}, path)
    monkeypatch.setattr(LightningCLI, "instantiate_classes", stop)
    with pytest.raises(Stop) as found:
        run_lightning(["fit", "--config", find_config("quickstart"), "--model.save_to", "mine.safetensors", "--ckpt_path", str(path)])
    return found.value.args[0].fit.model


def test_paths_and_classes_of_a_checkpoint_are_not_taken(tmp_path, monkeypatch):
    evil = {
        "_class_path": "neuido.models.stages.pretrain.PretrainModule",
        "_instantiator": "os.system",
        "latent_dim": 7,
        "save_to": "/evil",
    }
    model = parsed(monkeypatch, tmp_path / "a.ckpt", evil)
    assert model.init_args.save_to == "mine.safetensors" and model.init_args.latent_dim == 7
    assert model.init_args.instance_steps == 100 and model.class_path.endswith("PretrainModule")


def test_a_foreign_class_is_refused_before_it_is_imported(tmp_path, monkeypatch):
    with pytest.raises(UserError, match=r"antigravity\.Evil"):
        parsed(monkeypatch, tmp_path / "b.ckpt", {"_class_path": "antigravity.Evil", "latent_dim": 7})
