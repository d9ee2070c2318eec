"""The help of the trainer's commands comes from source text alone; it must say what the parser of jsonargparse takes."""

import inspect
import re
from importlib import import_module

import pytest
import yaml

import neuido
from neuido.commands.cli import signatures, trainer_help
from neuido.commands.cli.signatures import BASES, TRAINER, classes, signature, yaml_word
from neuido.commands.cli.trainer_help import COMMON, HEAVY, help_text
from tests.command import run

CLASSES = [(key, path) for key in BASES for path in classes(key).values()]


@pytest.fixture(scope="module")
def parsers():
    from neuido.commands.cli.trainer import trainer_parser

    return trainer_parser()._subcommands_action.choices


def resolved(path: str) -> type:
    module, _, name = path.rpartition(".")
    return getattr(import_module(module), name)


def shown(text: str) -> set[str]:
    return set(re.findall(r"^  (--[\w.]+)", text, flags=re.MULTILINE))


@pytest.mark.parametrize("command", HEAVY)
def test_help_names_every_option_of_the_parser_and_no_other(parsers, command):
    options = {word for action in parsers[command]._actions for word in action.option_strings if word.startswith("--")}
    options = {word for word in options if not word.endswith((".help", "+")) and word not in ("--help", "--trainer", "--model", "--data")}
    assert shown(help_text([command, "--help"])) == options | {"--trust"}  # which is read before the parser


def test_defaults_of_the_trainer_are_those_of_the_parser(parsers):
    defaults = {action.dest: action.default for action in parsers["fit"]._actions}
    for option in signature(TRAINER).options.values():
        assert yaml.safe_load(option.default) == defaults[f"trainer.{option.name}"], option.name


@pytest.mark.parametrize(("key", "path"), CLASSES)
def test_options_of_a_class_are_those_of_the_parser(key, path):
    from jsonargparse import ArgumentParser

    parser = ArgumentParser()
    parser.add_class_arguments(resolved(path), "x")
    real = {action.dest.removeprefix("x."): action for action in parser._actions if action.dest.startswith("x.")}
    real = {name: action for name, action in real.items() if not name.endswith(".help")}
    found = signature(path)
    assert not found.open
    assert set(found.options) == set(real)
    for name, option in found.options.items():
        default = inspect.signature(resolved(path)).parameters[name].default
        assert (option.default is None) == (default is inspect.Parameter.empty), name
        if option.default is not None:
            assert option.default == yaml_word(default), name
        assert option.text, f"{path}: the docstring says nothing of {name}"


def test_classes_are_those_that_the_parser_knows():
    from neuido.commands.cli.trainer import trainer_parser

    trainer_parser()  # imports all of them
    for key, base in {
        "model": "lightning.pytorch.LightningModule",
        "data": "lightning.pytorch.LightningDataModule",
        "method": "neuido.models.fewshot.method.Method",
        "effects": "neuido.models.inference.prepared_scene.EffectSource",
    }.items():
        own = resolved(base)
        known = set()
        for module in signatures.MODULES:
            for name, value in vars(import_module(module)).items():
                if inspect.isclass(value) and issubclass(value, own) and value.__module__ == module and value is not own:
                    known.add(name)
        assert known - {"LatentMethod"} == set(classes(key))


def test_help_of_a_configuration_shows_its_model_method_and_data_with_their_values(capsys):
    status, out, err = run(capsys, "fit", "--config", "baselines/neuma", "--help")
    assert (status, err) == (0, "")
    options = shown(out)
    assert {"--model.method.rank", "--model.steps", "--data.scenes", "--trainer.max_epochs"} <= options
    assert re.search(r"--model\.steps.*?here: 1000", out, flags=re.DOTALL)
    assert "--model.trunk" not in options


def test_help_follows_the_classes_of_the_command_line(capsys):
    _, out, _ = run(capsys, "fit", "--config", "adapt", "--model.method", "KnownLaw", "--help")
    assert "--model.method.yield_stress" in out and "--model.method.rank" not in out


@pytest.mark.parametrize("words", ["--model.help PretrainModule", "--model.help=PretrainModule"])
def test_help_of_a_class(capsys, words):
    status, out, _ = run(capsys, "fit", *words.split())
    assert status == 0
    assert {"--model.latent_dim", "--model.trunk"} <= shown(out)


def test_help_of_a_class_that_is_not_there(capsys):
    status, out, err = run(capsys, "fit", "--model.help", "PretrainModul")
    assert (status, out) == (2, "") and "did you mean 'PretrainModule'?" in err and err.count("\n") == 1


def test_own_classes_are_read_without_being_imported(tmp_path, monkeypatch):
    (tmp_path / "own_law.py").write_text(
        "raise RuntimeError('imported')\nfrom neuido.models.fewshot.method import Method\n\n"
        'class Own(Method):\n    """Fit my own law.\n\n    Args:\n        size: How large.\n    """\n\n'
        "    def __init__(self, size: int = 3, **options: int):\n        super().__init__(**options)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    found = signature("own_law.Own")
    assert found is not None and "Method" in found.bases
    assert found.options["size"][:4] == ("size", "int", "3", "How large.")


def test_common_options_are_said_once():
    assert set(COMMON) & {f"--trainer.{name}" for name in signature(TRAINER).options} == set()
    assert trainer_help.wants_help(["fit", "--help"]) and not trainer_help.wants_help(["fit", "--config", str(neuido.configs_root())])
