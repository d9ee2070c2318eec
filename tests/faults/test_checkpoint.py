"""A checkpoint names no path, no module and no class, and what the user states wins over its numbers.

A configuration names no class of other packages, unless the user trusts it.
"""

import pytest
import torch
from lightning.pytorch.cli import LightningCLI

from neuido.commands.cli.checkpoint_options import does_not_fit
from neuido.commands.cli.config_files import find_config
from neuido.commands.cli.trainer import run_lightning
from neuido.errors import UserError
from tests.command import run


def parsed(monkeypatch, path, hyperparameters, *words):
    class Stop(Exception):
        pass

    def stop(self):
        raise Stop(self.config)

    torch.save({"state_dict": {}, "hyper_parameters": hyperparameters}, path)
    monkeypatch.setattr(LightningCLI, "instantiate_classes", stop)
    with pytest.raises(Stop) as found:
        run_lightning(
            ["fit", "--config", find_config("quickstart"), "--model.save_to", "mine.safetensors", "--ckpt_path", str(path), *words]
        )
    return found.value.args[0].fit.model


def test_paths_and_classes_of_a_checkpoint_are_not_taken(tmp_path, monkeypatch):
    evil = {
        "_class_path": "neuido.models.stages.pretrain.PretrainModule",
        "_instantiator": "os.system",
        "hidden_dim": 7,
        "save_to": "/evil",
    }
    model = parsed(monkeypatch, tmp_path / "a.ckpt", evil)
    assert model.init_args.save_to == "mine.safetensors" and model.init_args.hidden_dim == 7  # of which the configuration says nothing
    assert model.init_args.instance_steps == 100 and model.class_path.endswith("PretrainModule")


def test_what_the_user_states_wins_over_the_checkpoint_and_is_told(tmp_path, monkeypatch, capsys):
    numbers = {"latent_dim": 7, "hidden_dim": 9, "head_dim": 5, "lr": 3e-3}
    model = parsed(monkeypatch, tmp_path / "a.ckpt", numbers, "--model.head_dim", "6")
    assert (model.init_args.latent_dim, model.init_args.hidden_dim, model.init_args.head_dim) == (128, 9, 6)
    err = capsys.readouterr().err
    assert (
        err.count("\n") == 1
        and "latent_dim = 128 (" in err
        and "quickstart.yaml:8), not 7" in err
        and "head_dim = 6 (--model.head_dim), not 5" in err
    )
    assert "lr" not in err and "hidden_dim" not in err


def test_a_checkpoint_whose_arrays_do_not_fit_is_one_line():
    found = does_not_fit(
        RuntimeError("Error(s) in loading state_dict for M:\n\tsize mismatch for z: copying a param with shape [7] from checkpoint, [8]."),
        ["fit", "--ckpt_path", "a.ckpt"],
    )
    assert str(found).startswith("ckpt_path = a.ckpt does not fit the model: size mismatch for z") and "\n" not in str(found)


def test_a_foreign_class_is_refused_before_it_is_imported(tmp_path, monkeypatch):
    with pytest.raises(UserError, match=r"antigravity\.Evil"):
        parsed(monkeypatch, tmp_path / "b.ckpt", {"_class_path": "antigravity.Evil", "latent_dim": 7})


FOREIGN = [
    ("model:\n  class_path: os.system\n", 3),
    ("model:\n  class_path: own_module.Model\n", 3),
    ("data: own_module.Data\n", 2),
    ("model:\n  init_args:\n    method:\n      class_path: own_module.Law\n", 5),
    ("model:\n  init_args:\n    effects:\n      class_path: own_module.Effect\n", 5),
    ("trainer:\n  callbacks:\n    - class_path: own_module.Callback\n", 4),
    ("trainer:\n  callbacks: [own_module.Callback]\n", 3),
    ("trainer:\n  logger: own_module.Logger\n", 3),
    ("trainer:\n  logger:\n    class_path: own_module.Logger\n", 4),
    ("trainer:\n  strategy:\n    class_path: subprocess.Popen\n    init_args: {args: id}\n", 4),
    ("trainer:\n  logger:\n    init_args:\n      deep: [{class_path: own_module.Deep}]\n", 5),
    (
        "trainer:\n  callbacks:\n    - class_path: lightning.pytorch.callbacks.LambdaCallback\n      init_args: {on_fit_start: os.abort}\n",
        5,
    ),
    ("trust: true\n", 2),
]


@pytest.mark.parametrize(("text", "line"), FOREIGN)
def test_a_configuration_names_no_class_of_others(tmp_path, monkeypatch, text, line):
    (tmp_path / "own_module.py").write_text("import pathlib\npathlib.Path(__file__).with_name('imported').touch()\n")
    monkeypatch.syspath_prepend(tmp_path)
    path = tmp_path / "own.yaml"
    path.write_text(f"base: adapt\n{text}")
    with pytest.raises(UserError, match="--trust" if "trust" not in text else "not known") as error:
        run_lightning(["fit", "--config", str(path)])
    assert f"own.yaml:{line}: " in str(error.value)
    assert not (tmp_path / "imported").exists()
    (tmp_path / "above.yaml").write_text("base: own.yaml\n")  # nor by way of a base
    with pytest.raises(UserError, match=rf"own\.yaml:{line}: "):
        run_lightning(["fit", "--config", str(tmp_path / "above.yaml")])


def test_a_file_that_an_option_names_is_no_way_around(tmp_path):
    (tmp_path / "model.yaml").write_text("class_path: own_module.Model\n")
    with pytest.raises(UserError, match="--trust"):
        run_lightning(["fit", "--config", find_config("adapt"), "--model", str(tmp_path / "model.yaml")])


OWN = """from neuido.models.baselines.known_law import KnownLaw


class Stiff(KnownLaw):
    \"\"\"Fit a known family from a stiffer start.\"\"\"

    def __init__(self, factor: float = 2.0):
        super().__init__(young=1e5 * factor)
"""


def test_a_class_of_ones_own_takes_trust(tmp_path, monkeypatch, capsys):
    (tmp_path / "stiff_law.py").write_text(OWN)
    monkeypatch.syspath_prepend(tmp_path)
    path = tmp_path / "own.yaml"
    path.write_text("base: adapt\nmodel:\n  init_args:\n    method:\n      class_path: stiff_law.Stiff\n      init_args: {factor: 3.0}\n")
    status, out, err = run(capsys, "fit", "--config", path, "--trust", "--print_config")
    assert (status, err) == (0, "") and "class_path: stiff_law.Stiff" in out and "factor: 3.0" in out
    status, _, err = run(capsys, "fit", "--config", path, "--trust", "--model.method.facto", "3")
    assert status == 2 and "did you mean '--model.method.factor'?" in err


def test_the_command_line_is_the_users_own(capsys, tmp_path, monkeypatch):
    (tmp_path / "stiff_law.py").write_text(OWN)
    monkeypatch.syspath_prepend(tmp_path)
    status, _, err = run(capsys, "fit", "--config", "adapt", "--model.method", "stiff_law.Stiff", "--print_config")
    assert (status, err) == (0, "")
