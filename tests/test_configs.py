"""Every YAML under configs is accepted by the real command line."""

import inspect

import pytest
import yaml

import neuido
from neuido import cli
from neuido.data.simulate import simulate as trajectories
from neuido.discrepancy.command import diagnose
from neuido.models.film import film
from neuido.simulate import simulate

ROOT = neuido.configs_root()
CONFIGS = sorted(ROOT.rglob("*.yaml"))


def content(path) -> dict:
    return yaml.safe_load(path.read_text())


def command_of(path) -> str | None:
    """The command that a configuration is for, by its keys."""
    keys = set(content(path))
    if "most" in keys and keys <= set(inspect.signature(diagnose).parameters):
        return "diagnose"
    if "model" in keys:
        return "fit"
    if keys <= {*inspect.signature(simulate).parameters, *inspect.signature(trajectories).parameters}:
        return "simulate"
    if keys <= {*inspect.signature(film).parameters}:
        return "film"
    return None


def test_there_are_configurations():
    assert {"stage1.yaml", "quickstart.yaml"} <= {path.name for path in CONFIGS}


def of_a_command(path) -> bool:
    """A file of one scene, of conditions, or of a sweep, is for no command of its own."""
    return not {"sweeps", "conditions"} & set(path.parts) and (path.parent.name != "scenes" or "scenes" in content(path))


@pytest.mark.parametrize("path", [path for path in CONFIGS if of_a_command(path)], ids=lambda p: p.stem)
def test_command_line_accepts(path, capsys):
    command = command_of(path)
    assert command is not None, f"no command takes {path.name}"
    required = ["--out", "nowhere"] if command in ("simulate", "film", "diagnose") and "out" not in content(path) else []
    required += ["--folder", "nowhere"] if command == "diagnose" else []
    with pytest.raises(SystemExit) as stop:
        cli.main([command, "--config", str(path), *required, "--print_config"])
    out, err = capsys.readouterr()
    assert stop.value.code == 0, err
    printed = yaml.safe_load(out)
    for key, value in content(path).items():
        if not isinstance(value, dict | list):
            assert printed[key] == value
