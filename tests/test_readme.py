"""What the README says can be done can be done: its commands, its Python, its links, its tables."""

import ast
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

import neuido
from neuido.commands import main as cli

ROOT = Path(neuido.__file__).parents[1]
README = ROOT / "README.md"
if not README.is_file():
    pytest.skip("the README does not come with the installed package", allow_module_level=True)
TEXT = README.read_text()
CHEAP = ("--help", "--print_config", "--device cpu", "--trainer.max_steps", "doctor")
"""A command that has one of these is run as it stands; another is only read by the command line that it is for."""


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", TEXT, flags=re.MULTILINE | re.DOTALL)


def commands(program: str) -> list[str]:
    lines = (line.split(" #")[0].strip() for block in blocks("bash") for line in block.splitlines())
    return [line for line in lines if line.split()[:1] == [program]]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Where the commands run one after the other: they build on what the ones before have written."""
    return tmp_path_factory.mktemp("readme")


def test_there_are_commands():
    assert len(commands("neuido")) > 10
    assert sum(any(mark in command for mark in CHEAP) for command in commands("neuido")) >= 6
    assert len(blocks("python")) >= 5


@pytest.mark.parametrize("command", commands("neuido"))
def test_command(command, folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    monkeypatch.delenv("NEUIDO_DATA", raising=False)
    args = shlex.split(command)[1:]
    cheap = any(mark in command for mark in CHEAP)
    with pytest.raises(SystemExit) as stop:
        cli.main(args if cheap else [*args, "--print_config"])
    out, err = capsys.readouterr()
    assert stop.value.code == 0, err
    if not cheap:  # what the command line would run has the values of the README
        for value in re.findall(r"--[\w.]+ ([\w.e-]+)$", command):
            assert value in out


def test_python(folder, monkeypatch):
    """The snippets in their order, in one namespace, beside the YAML files that the README shows."""
    monkeypatch.chdir(folder)
    for block in blocks("yaml"):
        name = re.match(r"# (\S+\.yaml)\n", block)
        assert name is not None, "a YAML block starts with its file name"
        Path(name[1]).write_text(block)
    space: dict = {}
    for snippet in blocks("python"):
        if snippet.startswith("# needs data"):  # then what it imports must be there
            body = [node for node in ast.parse(snippet).body if isinstance(node, ast.ImportFrom)]
            assert body
            exec(compile(ast.Module(body, []), "README.md", "exec"), {})
            continue
        exec(compile(snippet, "README.md", "exec"), space)
        assert space["frames"].x.isfinite().all()
    assert space["young"].grad.abs().item() > 0
    assert space["heights"].diff().abs().min() > 0
    assert space["stiffness"].grad.abs().item() > 0
    assert space["frames"].x.shape[0] == 21
    assert space["moduli"].grad.abs().min() > 0
    assert space["images"].shape == (21, 2, 100, 100, 3)
    assert space["alphas"].max() > 0.5


@pytest.mark.parametrize("command", commands("python"))
def test_benchmark(command):
    script, *options = shlex.split(command)[1:]
    answer = subprocess.run([sys.executable, script, "--help"], capture_output=True, text=True, cwd=ROOT, check=True)
    for option in options:
        assert not option.startswith("--") or option in answer.stdout


def test_make_and_pip():
    targets = re.search(r"^\.PHONY:(.*)$", (ROOT / "Makefile").read_text(), flags=re.MULTILINE)[1].split()
    for command in commands("make"):
        assert command.split()[1] in targets
    constraints = (ROOT / "constraints.txt").read_text().splitlines()
    for command in commands("pip"):
        words = shlex.split(command)
        for word in words:
            if "==" in word:
                assert word in constraints
            if word.endswith(".txt"):
                assert (ROOT / word).is_file()


@pytest.mark.parametrize("name", ["README.md", "CONTRIBUTING.md", "CHANGELOG.md", "neuido/models/weights/README.md"])
def test_links(name):
    text = (ROOT / name).read_text()
    headings = {re.sub(r"[^\w -]", "", h.lower()).replace(" ", "-") for h in re.findall(r"^#+ (.+)$", text, flags=re.MULTILINE)}
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if target.startswith("#"):
            assert target[1:] in headings
        elif not target.startswith("http"):
            assert (ROOT / name).parent.joinpath(target).exists()
