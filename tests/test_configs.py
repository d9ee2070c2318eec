"""Every YAML under configs is accepted by the real command line."""

import inspect
import re
import shlex
from pathlib import Path

import pytest
import yaml

import neuido
from neuido.commands import main as cli
from neuido.commands.cli.sweep_file import command_of as sweep_command
from neuido.commands.cli.sweep_file import read_sweep, runs_of
from neuido.commands.diagnose import diagnose
from neuido.commands.film import film
from neuido.commands.latents import latents
from neuido.commands.simulation.scenes import scenes
from neuido.commands.simulation.trajectories import trajectories
from neuido.data.files.score_tables import read_rows

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
    if keys <= {*inspect.signature(latents).parameters}:
        return "latents"
    if keys <= {*inspect.signature(scenes).parameters}:
        return "scenes"
    if keys <= {*inspect.signature(trajectories).parameters}:
        return "trajectories"
    if keys <= {*inspect.signature(film).parameters}:
        return "film"
    return None


def test_there_are_configurations():
    assert {"stage1.yaml", "quickstart.yaml"} <= {path.name for path in CONFIGS}


def of_a_command(path) -> bool:
    """A file of one scene, of conditions, of loggers alone, or of a sweep, is for no command of its own."""
    whole = not {"loggers", "conditions"} & set(path.parts) and "parameters" not in content(path)
    return whole and (path.parent.name != "scenes" or "scenes" in content(path))


@pytest.mark.parametrize("path", [path for path in CONFIGS if of_a_command(path)], ids=lambda p: p.stem)
def test_command_line_accepts(path, capsys):
    command = command_of(path)
    assert command is not None, f"no command takes {path.name}"
    required = ["--out", "nowhere"] if command in ("scenes", "trajectories", "film", "diagnose") and "out" not in content(path) else []
    required += ["--folder", "nowhere"] if command == "diagnose" else []
    with pytest.raises(SystemExit) as stop:
        cli.main([command, "--config", str(path), *required, "--print_config"])
    out, err = capsys.readouterr()
    assert stop.value.code == 0, err
    printed = yaml.safe_load(out)
    for key, value in content(path).items():
        if not isinstance(value, dict | list):
            assert printed[key] == value


SWEEPS = [path for path in CONFIGS if "parameters" in content(path)]


def commands_of(file, run) -> list[list[str]]:
    """Every `neuido ...` of a run of a sweep, as a shell would split it."""
    words = sweep_command(file, run, {})
    if words[1] != "sh":
        return [words[2:]]
    own = [word for word in words[words.index("neuido") + 1 :]]
    script = re.sub(r"\\\n", " ", words[3]).replace('"$@"', shlex.join(own)).replace("$run", "nowhere")
    data = re.search(r'^data="(.*)"$', script, flags=re.MULTILINE)
    script = script.replace("$data", data[1] if data else "").replace(" $lpips", "")
    script = re.sub(r"\$\{fits:\+(.*?)\}", r"\1", script)
    return [shlex.split(line)[1:] for line in script.splitlines() if line.strip().startswith("neuido ")]


def runs_to_try(path) -> list:
    """The last run of a sweep; all of one over whole configurations."""
    runs = runs_of(read_sweep(path))
    return runs if "config" in runs[0].parameters else runs[-1:]


@pytest.mark.parametrize(
    ("path", "run"), [(path, run) for path in SWEEPS for run in runs_to_try(path)], ids=lambda v: getattr(v, "stem", None)
)
@pytest.mark.slow
def test_command_line_accepts_the_runs_of_a_sweep(path, run, capsys, monkeypatch):
    monkeypatch.chdir(ROOT.parent)  # from where the file says that it is run
    commands = commands_of(read_sweep(path), run)
    assert commands
    printed = ""
    for words in commands:
        with pytest.raises(SystemExit) as stop:
            cli.main([*words, "--print_config"])
        out, err = capsys.readouterr()
        assert stop.value.code == 0, err
        printed += out
    for name, value in run.parameters.items():
        if name != "config" and not isinstance(value, list):
            text = str(value).lower() if isinstance(value, bool) else str(value)
            assert re.search(rf"[.:\- ]{re.escape(text)}$", printed, flags=re.MULTILINE), value


def test_the_first_table_has_every_method():
    table = {Path(run.parameters["config"]) for run in runs_of(read_sweep(ROOT / "experiments" / "table1.yaml"))}
    assert table == {Path("configs/adapt.yaml"), *(Path("configs/baselines", path.name) for path in (ROOT / "baselines").glob("*.yaml"))}


@pytest.mark.parametrize("path", sorted(ROOT.rglob("*.paper.csv")), ids=lambda p: p.name)
def test_quoted_tables_belong_to_a_sweep(path):
    assert path.with_name(path.name.replace(".paper.csv", ".yaml")) in SWEEPS
    rows = read_rows(path)
    assert len(rows) >= 3
    assert len({tuple(row) for row in rows}) == 1


def test_loggers_go_on_top_of_another_configuration(capsys):
    with pytest.raises(SystemExit):
        cli.main(["fit", "--config", "stage1", "--config", "loggers/wandb", "--print_config"])
    loggers = yaml.safe_load(capsys.readouterr().out)["trainer"]["logger"]
    assert [each["class_path"].rpartition(".")[2] for each in loggers] == ["CSVLogger", "WandbLogger"]
