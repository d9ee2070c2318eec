"""What the README says can be done can be done: its commands run, its snippets run, its links hold."""

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


def blocks(language: str) -> list[str]:
    """Return the fenced blocks of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", TEXT, flags=re.MULTILINE | re.DOTALL)


def commands(program: str) -> list[str]:
    """Return the lines of the bash blocks that call a program."""
    lines = (line.split(" #")[0].strip() for block in blocks("bash") for line in block.splitlines())
    return [line for line in lines if line.split()[:1] == [program]]


def named_files() -> dict[str, str]:
    """Return the files that the README shows, by the name in their first line."""
    shown = [*blocks("yaml"), *blocks("text")]
    named = [(re.match(r"# (\S+)\n", block), block) for block in shown]
    return {match[1]: block if match[1].endswith(".yaml") else block.split("\n", 1)[1] for match, block in named if match}


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Return a folder with the files that the README shows."""
    folder = tmp_path_factory.mktemp("readme")
    for name, content in named_files().items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(content)
    return folder


def test_shape():
    lines = TEXT.splitlines()
    assert len(lines) <= 200
    pictures = [i for i, line in enumerate(lines) if line.startswith("![")]
    assert pictures[0] < 15
    assert not re.search(r"\b(?=[0-9a-f]*[a-f])(?=[0-9a-f]*\d)[0-9a-f]{7}\b|\bseed\b", TEXT), "a commit hash or a seed"
    assert "make test" in TEXT
    assert named_files().keys() == {"rubber/tensile.csv", "rubber/test.yaml"}
    assert len(commands("neuido")) >= 3
    assert len(blocks("python")) >= 1


@pytest.mark.parametrize("name", re.findall(r"!\[[^\]]*\]\(([^)]+)\)", TEXT))
def test_pictures_are_small(name):
    assert 0 < (ROOT / name).stat().st_size <= 1.5 * 2**20


@pytest.mark.slow
@pytest.mark.parametrize("command", commands("neuido"))
def test_command(command, folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    monkeypatch.delenv("NEUIDO_DATA", raising=False)
    with pytest.raises(SystemExit) as stop:
        cli.main(shlex.split(command)[1:])
    assert stop.value.code == 0, capsys.readouterr().err
    if "diagnose rubber" in command:
        found = neuido.Diagnosis.read(folder / "runs" / "rubber")
        assert found.answer in ("effect", "class")
        assert found.error.after < found.error.before
        assert (folder / "runs" / "rubber" / "report.html").is_file()
    if "predict" in command:
        young = float(re.search(r"E = ([\d.]+) kPa", capsys.readouterr().out)[1])
        assert 15 <= young <= 60, "the README says a factor of two of 30 kPa"
    if "demo" in command:
        assert neuido.Diagnosis.read(folder / "runs" / "demo" / "loop" / "diagnosis").effects[0].name == "drag_linear"


def test_snippet(folder, monkeypatch):
    monkeypatch.chdir(folder)
    for snippet in blocks("python"):
        space: dict = {}
        exec(compile(snippet, "README.md", "exec"), space)
        assert tuple(space["frames"].x.shape) == (21, 512, 3)
        assert space["young"].grad.abs().item() > 0


def test_make_and_pip():
    targets = re.search(r"^\.PHONY:(.*)$", (ROOT / "Makefile").read_text(), flags=re.MULTILINE)[1].split()
    for command in commands("make"):
        assert command.split()[1] in targets
    constraints = (ROOT / "constraints.txt").read_text().splitlines()
    for command in [*commands("pip"), *commands("uv")]:
        for word in shlex.split(command):
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
            assert (ROOT / name).parent.joinpath(target.split("#")[0]).exists(), target


def test_the_interpreter_runs_the_package():
    answer = subprocess.run([sys.executable, "-m", "neuido", "--version"], capture_output=True, text=True, cwd=ROOT, check=True)
    assert neuido.__version__ in answer.stdout
