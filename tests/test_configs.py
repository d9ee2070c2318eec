"""Every YAML under configs is accepted by the real command line."""

import functools
import inspect
import re
import shlex
from collections import Counter
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
from neuido.data.files.yaml_files import chain, places, read_configuration
from neuido.errors import UserError

ROOT = neuido.configs_root()
CONFIGS = sorted(ROOT.rglob("*.yaml"))


@functools.cache  # a hundred files of some pages, each of which is asked for several times
def content(path) -> dict:
    """What a configuration says, that of its base included."""
    return read_configuration(path)


def command_of(path) -> str | None:
    """The command that a configuration is for, by its keys."""
    keys = set(content(path))
    if "max_effects" in keys and keys <= set(inspect.signature(diagnose).parameters):
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
    """A file of one scene, of conditions, of loggers alone, a base of others, or a sweep, is for no command of its own."""
    whole = not {"loggers", "conditions", "bases"} & set(path.parts) and "parameters" not in content(path)
    return whole and (path.parent.name != "scenes" or "scenes" in content(path))


WHOLE = [path for path in CONFIGS if of_a_command(path)]


def to_try(path):
    """The first of a folder; the others, which are built of the same classes, in the slow tier."""
    first = next(other for other in WHOLE if other.parent == path.parent)
    return path if path == first or path.parent == ROOT else pytest.param(path, marks=pytest.mark.slow)


@pytest.mark.parametrize("path", [to_try(path) for path in WHOLE], ids=lambda p: p.stem)
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


def told(path) -> Counter:
    """The lines of a file without its comments, and how often each stands there."""
    lines = (re.sub(r"(^|\s)#.*", "", line).strip() for line in path.read_text().splitlines())
    return Counter(line for line in lines if line)


@pytest.mark.parametrize("path", CONFIGS, ids=lambda p: p.stem)
def test_no_file_repeats_another(path):
    for other in CONFIGS[: CONFIGS.index(path)]:
        assert (told(path) & told(other)).total() <= 30, f"{path.name} and {other.name}: give them a base"


def test_a_base_is_taken_by_a_configuration():
    taken = {file for path in CONFIGS for file in chain(path)[:-1]}
    assert taken >= {path for path in CONFIGS if path.parent.name == "bases"}


def write_all(folder, **files) -> None:
    for name, text in files.items():
        (folder / f"{name}.yaml").write_text(text)


def test_a_base_is_merged_and_the_keys_beside_it_win(tmp_path):
    write_all(
        tmp_path,
        far="a: 1\nb: {c: 1, d: [1, 2]}\nm: {class_path: x.One, init_args: {p: 1}}\n",
        near="base: far.yaml\nb: {d: [3]}\n",
        own="base: [near.yaml, quickstart]\na: 2\nm: {class_path: x.Two, init_args: {q: 2}}\n",
    )
    found = read_configuration(tmp_path / "own.yaml")
    assert (found["a"], found["b"], found["m"]) == (2, {"c": 1, "d": [3]}, {"class_path": "x.Two", "init_args": {"q": 2}})
    assert found["trainer"]["max_epochs"] == 2  # of the one that comes with neuido
    assert "base" not in found
    where = places(tmp_path / "own.yaml")
    assert (where["b", "c"].file.name, where["b", "c"].line) == ("far.yaml", 2)
    assert (where["b", "d"].file.name, where["a",].file.name) == ("near.yaml", "own.yaml")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a: 1\nbase: own.yaml\n", "circle"),
        ("base: other.yaml\n", "circle"),
        ("a: 1\nbase: nowhere\n", "own.yaml:2: base = 'nowhere'"),
        ("base: {a: 1}\n", "it must be the path"),
    ],
)
def test_a_base_that_cannot_be_read(tmp_path, text, words):
    write_all(tmp_path, own=text, other="base: [own.yaml]\n")
    with pytest.raises(UserError, match=words):
        read_configuration(tmp_path / "own.yaml")


def test_print_config_shows_what_a_base_says(tmp_path, capsys):
    write_all(tmp_path, own="base: films_small\ncount: 3\n")
    with pytest.raises(SystemExit):
        cli.main(["film", "--config", str(tmp_path / "own.yaml"), "--out", "nowhere", "--print_config"])
    printed, base = yaml.safe_load(capsys.readouterr().out), content(ROOT / "films_small.yaml")
    assert printed["count"] == 3 and "base" not in printed
    assert all(printed[key] == value for key, value in base.items() if key not in ("count", "out"))


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
