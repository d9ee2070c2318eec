"""A mistyped key, option or class and a value of a wrong type are one line: where it stands, what is wrong, what was meant."""

import pytest
import yaml

import neuido
from neuido.commands.cli.config_files import find_config
from neuido.commands.cli.mistakes import check_configurations
from neuido.commands.cli.wrong_values import placed
from neuido.errors import UserError, suggest
from tests.command import run

BEFORE_TORCH = [  # keys below `base: adapt`: line, words of the error
    ("model:\n  class_path: AdaptModul", 3, "model.class_path = AdaptModul", "did you mean 'AdaptModule'?"),
    ("model:\n  init_args:\n    stepz: 3", 4, "model.init_args.stepz", "no option of AdaptModule", "did you mean 'steps'?"),
    ("model:\n  init_arg: {steps: 3}", 3, "'init_arg' of model", "did you mean 'init_args'?"),
    ("model:\n  init_args:\n    method:\n      init_args:\n        rnk: 3", 6, "LowRankAdaptation", "did you mean 'rank'?"),
    ("model:\n  init_args:\n    method:\n      class_path: LowRankAdaption", 5, "did you mean 'LowRankAdaptation'?"),
    ("data:\n  class_path: VisualDataModul", 3, "did you mean 'VisualDataModule'?"),
    ("data:\n  init_args:\n    scene: [a]", 4, "VisualDataModule", "did you mean 'scenes'?"),
    ("trainer:\n  max_epoch: 3", 3, "trainer.max_epoch", "did you mean 'max_epochs'?"),
    ("trainr:\n  max_epochs: 3", 2, "'trainr'", "did you mean 'trainer'?"),
    ("trainer: [1]", 2, "trainer must be a mapping"),
    ("trainer:\n  callbacks:\n    - class_path: ModelCheckpont", 4, "did you mean 'ModelCheckpoint'?"),
    ("trainer:\n  callbacks:\n    - ModelCheckpont", 4, "did you mean 'ModelCheckpoint'?"),
    ("trainer:\n  callbacks:\n    - class_path: ModelCheckpoint\n      init_args: {save_las: true}", 5, "did you mean 'save_last'?"),
    ("trainer:\n  logger:\n    init_args:\n      save_dri: x", 5, "CSVLogger", "did you mean 'save_dir'?"),
    ("trainer:\n  callbacks:\n    - class_path: lightning.pytorch.callbacks.ModelCheckpont", 4, "did you mean 'ModelCheckpoint'?"),
    ("model: 3", 2, "model = 3 must be a class"),
    ("model: other.yaml", 2, "base: other.yaml"),
    ("model:\n  init_args: 3", 3, "model.init_args must be a mapping"),
]

WORDS = [
    ("--model.stepz 3", "--model.stepz", "did you mean '--model.steps'?"),
    ("--model.init_args.stepz=3", "did you mean '--model.init_args.steps'?"),
    ("--model.method.rnk 3", "did you mean '--model.method.rank'?"),
    ("--model.method LowRankAdaption", "did you mean 'LowRankAdaptation'?"),
    ("--model AdaptModul", "did you mean 'AdaptModule'?"),
    ("--trainer.max_epoch 3", "did you mean '--trainer.max_epochs'?"),
    ("--trainr.max_epochs 3", "did you mean '--trainer.max_epochs'?"),
    ("--ckpt_pat x", "did you mean '--ckpt_path'?"),
    ("--trainer.callbacks ModelCheckpont", "did you mean 'ModelCheckpoint'?"),
    ("--trainer.logger CSVLoger", "did you mean 'CSVLogger'?"),
    ("--model.steps", "--model.steps needs a value"),
    ("more", "'more' belongs to no option"),
]


def one_line(capsys, args, *words) -> str:
    status, out, err = run(capsys, *args)
    assert (status, out) == (2, "") and err.startswith("neuido: ") and err.count("\n") == 1 and len(err) <= 320, err
    for word in words:
        assert word in err
    for word in ("<class", "NoneType", "keyword-only", "Namespace", "subtypes", "dot import path"):
        assert word not in err
    return err


@pytest.mark.parametrize("case", BEFORE_TORCH, ids=lambda case: case[0].split()[-1])
def test_a_mistake_in_a_configuration_is_found_before_torch_is_loaded(capsys, tmp_path, monkeypatch, case):
    monkeypatch.setattr("neuido.commands.cli.trainer.quiet_lightning", lambda: pytest.fail("loads Lightning"))
    text, line, *words = case
    (tmp_path / "own.yaml").write_text(f"base: adapt\n{text}\n")
    one_line(capsys, ["fit", "--config", tmp_path / "own.yaml"], f"own.yaml:{line}: ", *words)


@pytest.mark.parametrize("case", WORDS, ids=lambda case: case[0])
def test_a_mistake_on_the_command_line_is_found_before_torch_is_loaded(capsys, monkeypatch, case):
    monkeypatch.setattr("neuido.commands.cli.trainer.quiet_lightning", lambda: pytest.fail("loads Lightning"))
    one_line(capsys, ["fit", "--config", "adapt", *case[0].split()], *case[1:])


def test_of_several_configurations_the_right_one_is_named(capsys, tmp_path):
    (tmp_path / "first.yaml").write_text("base: adapt\nmodel:\n  init_args:\n    stepz: 3\n")
    (tmp_path / "second.yaml").write_text("model:\n  init_args:\n    steps: 3\n")
    one_line(capsys, ["fit", "--config", tmp_path / "first.yaml", "--config", tmp_path / "second.yaml"], "first.yaml:4")
    (tmp_path / "third.yaml").write_text(f"base: {tmp_path / 'first.yaml'}\n")
    one_line(capsys, ["fit", "--config", tmp_path / "third.yaml"], "first.yaml:4")


def test_every_configuration_that_comes_with_neuido_passes():
    for name in ("adapt", "stage1", "stage2_ten", "flow_vae", "predict", "baselines/uniphy", "experiments/unseen"):
        check_configurations(["fit", "--config", str(neuido.configs_root() / f"{name}.yaml")])


def test_former_names_of_options_pass(tmp_path):
    (tmp_path / "own.yaml").write_text(
        "base: adapt\nmodel:\n  init_args:\n    method:\n      class_path: SpringMass\n      init_args: {per: body}\n"
    )
    check_configurations(["fit", "--config", str(tmp_path / "own.yaml"), "--model.method.firm", "3"])


@pytest.mark.parametrize(("words", "lacking"), [([], "model and data module"), (["--model", "PretrainModule"], "a data module"),
                                                (["--data", "FilmDataModule"], "a model")])  # fmt: skip
def test_what_is_lacking_is_named(capsys, words, lacking):
    one_line(capsys, ["fit", *words], lacking, "--config", "--data CLASS" if "data" in lacking else "--model CLASS")


def test_a_method_that_is_lacking(capsys):
    one_line(
        capsys, ["fit", "--model", "AdaptModule", "--data", "VisualDataModule", "--data.scenes", "[a]"], "AdaptModule needs model.method"
    )


def test_a_model_of_stage_one_with_other_data(capsys):
    one_line(capsys, ["fit", "--config", "adapt", "--model", "PretrainModule"], "PretrainModule", "TrajectoryDataModule")


WRONG = [
    ("model:\n  init_args:\n    steps: many", 4, "--model.steps: expected int or null, got many"),
    ("model:\n  init_args:\n    method:\n      init_args:\n        rank: many", 6, "--model.method.rank: expected int, got many"),
    ("model:\n  init_args:\n    stop_on: never", 4, "--model.stop_on: expected one of 'none', 'loss', 'view', got never"),
    ("trainer:\n  max_epochs: many", 3, "--trainer.max_epochs: expected int or null, got many"),
    ("trainer:\n  accelerator: gpuu", 2, "trainer: You selected an invalid accelerator name"),
]


@pytest.mark.parametrize("case", WRONG, ids=lambda case: case[0].split()[-1])
def test_a_value_of_a_wrong_type_has_its_line(capsys, tmp_path, case):
    text, line, words = case
    (tmp_path / "own.yaml").write_text(f"base: adapt\n{text}\n")
    one_line(capsys, ["fit", "--config", tmp_path / "own.yaml"], f"own.yaml:{line}: ", words)


LIGHT = [
    ("film", "out: x\ncountz: 3", 2, "did you mean 'count'?"),
    ("film", "out: x\ncells: many", 2, "--cells: expected int, got many"),
    ("film", "out: x\ndts: [a]", 2, "--dts: expected", "got a"),
    ("trajectories", "out: x\nsetup: {lenght: 3}", 2, "did you mean 'setup.length'?"),
    ("trajectories", "out: x\nsetup: 3", 2, "setup must be a mapping"),
    ("trajectories", "out: x\nsetup: {length: abc}", 2, "--setup.length: expected float, got abc"),
    ("trajectories", "out: x\nfamilies: {elastik: {young: [1, 2]}}", 2, "unknown family 'elastik'"),
    ("scenes", "out: x\nscenes: [{name: a}]\nfilm:\n  veiws: 3", 4, "did you mean 'film.views'?"),
]


@pytest.mark.parametrize("case", LIGHT, ids=lambda case: case[1].split()[-1])
def test_a_mistake_in_the_configuration_of_a_light_command(capsys, tmp_path, case):
    command, text, line, *words = case
    (tmp_path / "own.yaml").write_text(f"{text}\n")
    one_line(capsys, [command, "--config", tmp_path / "own.yaml"], f"own.yaml:{line}: ", *words)


@pytest.mark.parametrize(
    ("args", "words"),
    [
        ("film --out x --setup 3", "--setup is no option"),
        ("trajectories --out x --setup.lenght 3", "'setup.length'"),
        ("film --out", "--out needs a value"),
        ("film", "neuido film needs --out"),
        ("film --out x more", "'more' belongs to no option"),
    ],
)
def test_a_mistake_on_the_command_line_of_a_light_command(capsys, args, words):
    one_line(capsys, args.split(), words)


SCENE = """format: neuido-scene/1
name: own
scene:
  domain: [[0, 0, 0], [1, 1, 1]]
  gravity: [0, -9.8, 0]
model: {density: 1000, elasticity: {law: sigma, young: 1.0e5, poisson: 0.3}}
body: {shape: ball, centre: [0.5, 0.5, 0.5], radius: 0.1, spacing: 0.05}
discretisation: {grid: 16, dt: 1.0e-4}
steps: 10
"""

SCENES = [
    ("gravity:", "gravty:", 5, "did you mean 'gravity'?"),
    ("grid: 16", "grid: many", 8, "discretisation.grid"),
    ("young: 1.0e5", "yung: 1.0e5", 6, "young"),
    ("law: sigma", "law: sigm", 6, "did you mean 'sigma'?"),
    ("radius: 0.1", "radios: 0.1", 7, "did you mean 'radius'?"),
    ("radius: 0.1, ", "", 7, "body lacks the key 'radius'"),
    ("radius: 0.1", "radius: big", 7, "body.radius"),
    ("shape: ball", "shape: bal", 7, "did you mean 'ball'?"),
    ("steps: 10", "steps: few", 9, "steps must be a positive whole number"),
]


@pytest.mark.parametrize("case", SCENES, ids=lambda case: case[1] or case[0])
def test_a_mistake_in_a_scene_file_has_its_line(tmp_path, case):
    right, wrong, line, words = case
    from neuido.data import load_scene

    path = tmp_path / "own.yaml"
    path.write_text(SCENE)
    load_scene(path)
    assert right in SCENE
    path.write_text(SCENE.replace(right, wrong))
    with pytest.raises(UserError) as error:
        load_scene(path)
    assert str(error.value).startswith(f"{path}:{line}: ") and words in str(error.value)


def test_only_what_opens_a_message_is_placed(tmp_path):
    path = tmp_path / "own.yaml"
    path.write_text("a: 1\nmodel:\n  init_args: {steps: 3}\n")
    args = ["fit", "--config", str(path)]
    assert placed("model.steps = 3: too few", args).endswith("own.yaml:3: model.steps = 3: too few")
    assert placed("there is no a here", args) == "there is no a here"
    assert placed("model.steps = 3: too few", [*args, "--model.steps", "3"]) == "model.steps = 3: too few"


def test_nothing_close_is_no_suggestion():
    assert suggest("zzz", ["alpha", "beta"]) == ""


@pytest.mark.parametrize("words", ["--trainer.logger TensorBoardLogger", "--trainer.logger=lightning.pytorch.loggers.TensorBoardLogger"])
def test_tensorboard_names_its_extra(capsys, monkeypatch, words):
    monkeypatch.setattr("neuido.commands.cli.mistakes.find_spec", lambda name: None)
    one_line(capsys, ["fit", "--config", "quickstart", *words.split()], "pip install 'neuido[tensorboard]'")


def test_tensorboard_in_a_configuration_names_its_extra(capsys, monkeypatch, tmp_path):
    monkeypatch.setattr("neuido.commands.cli.mistakes.find_spec", lambda name: None)
    (tmp_path / "own.yaml").write_text("base: quickstart\ntrainer:\n  logger:\n    class_path: TensorBoardLogger\n")
    one_line(capsys, ["fit", "--config", tmp_path / "own.yaml"], "pip install 'neuido[tensorboard]'")


def test_tensorboard_keeps_the_folder_of_the_log(capsys):
    status, out, err = run(capsys, "fit", "--config", "quickstart", "--trainer.logger", "TensorBoardLogger", "--print_config")
    assert (status, err) == (0, "")
    logger = yaml.safe_load(out)["trainer"]["logger"]
    assert logger["class_path"].endswith("TensorBoardLogger") and logger["init_args"]["save_dir"] == "runs"


def test_wandb_without_an_account_is_one_line_with_the_way_out(capsys, monkeypatch):
    from wandb.errors import UsageError

    def refused(args):
        raise UsageError("api_key not configured (no-tty). call wandb.login(key=[your_api_key])")

    monkeypatch.setattr("neuido.commands.cli.trainer._run", refused)
    one_line(capsys, ["fit", "--config", "quickstart"], "api_key not configured", "WANDB_MODE=offline")


@pytest.mark.parametrize(
    ("config", "option"),
    [("predict", "--model.init_from"), ("predict", "--model.init_args.init_from"), ("adapt_small", "--model.method.init_args.init_from")],
)
def test_a_file_that_an_option_takes_is_no_configuration(tmp_path, config, option):
    (weights := tmp_path / "encoder.safetensors").write_bytes(b"\x90\x01class_path: os.system")
    check_configurations(["predict", "--config", find_config(config), option, str(weights)])
    with pytest.raises(UserError, match=r"encoder\.safetensors"):
        check_configurations(["predict", "--config", find_config(config), option.partition(".init_")[0], str(weights)])
