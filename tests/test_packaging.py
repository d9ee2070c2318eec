"""Wheel and sdist: what they hold, and that the wheel works without the checkout."""

import ast
import os
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

import neuido

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def imported_names(of: set[str]) -> set[str]:
    """What the files import that name one of these packages."""
    found = set()
    word = re.compile(rf"\b({'|'.join(of)})\b")  # a file that names none is not parsed
    for text in (path.read_text() for path in (ROOT / "neuido").rglob("*.py")):
        for node in ast.walk(ast.parse(text)) if word.search(text) else ():
            if isinstance(node, ast.Import):
                found |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                found.add(node.module.split(".")[0])
            elif isinstance(node, ast.Call) and getattr(node.func, "id", "") == "import_extra" and isinstance(node.args[0], ast.Constant):
                found.add(node.args[0].value)
    return found


def test_extras_are_imported_by_code():
    names = {
        re.split(r"[<>=!\[]", part)[0].replace("-", "_")
        for extra in ("video", "colmap", "gpu", "import", "mesh")
        for part in PROJECT["optional-dependencies"][extra]
    }
    assert names <= imported_names(names)


def test_extras_that_messages_name_are_there():
    text = "\n".join(path.read_text() for path in (ROOT / "neuido").rglob("*.py"))
    assert set(re.findall(r"neuido\[(\w+)\]", text)) <= set(PROJECT["optional-dependencies"])


def test_versions_agree():
    assert PROJECT["version"] == neuido.__version__
    versions = {c.rpartition(" ")[2] for c in PROJECT["classifiers"] if re.search(r"Python :: 3\.\d+$", c)}
    assert versions == {"3.11", "3.12", "3.13"}


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> dict[str, Path]:
    """The wheel, built from the sdist as an installer does, and the sdist; without a network."""
    pytest.importorskip("hatchling")
    folder = tmp_path_factory.mktemp("dist")
    source = folder / "source"
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "sdist", "-d", str(folder)], cwd=ROOT, check=True, capture_output=True
    )
    (sdist,) = folder.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        archive.extractall(source, filter="data")
    (tree,) = source.iterdir()
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)], cwd=tree, check=True, capture_output=True
    )
    (wheel,) = folder.glob("*.whl")
    return {"sdist": sdist, "wheel": wheel}


@pytest.mark.slow
def test_contents(built):
    with zipfile.ZipFile(built["wheel"]) as archive:
        wheel = {entry.filename: entry.file_size for entry in archive.infolist()}
    with tarfile.open(built["sdist"]) as archive:
        sdist = {name.partition("/")[2]: member.size for name, member in zip(archive.getnames(), archive.getmembers())}
    for names in (wheel, sdist):
        assert not [name for name in names if name.startswith(("research", "docs", "shared")) or "__pycache__" in name]
        assert "neuido/py.typed" in names
        assert {path.relative_to(ROOT).as_posix() for path in (ROOT / "neuido").rglob("*.pyi")} <= set(names)
        assert max(names.values()) < 10e6
        assert any(name.endswith("stage1.safetensors") for name in names)
    assert all(name.startswith(("neuido/", "neuido-")) for name in wheel)
    assert {"neuido/configs/diagnose.yaml", "neuido/configs/scenes/six.yaml"} <= set(wheel)
    assert {"configs/diagnose.yaml", "benchmarks/rollout.py", "README.md", "LICENSE", "pyproject.toml"} <= set(sdist)
    assert sum(size for name, size in sdist.items() if name.startswith("tests/")) < 10e6


@pytest.mark.slow
def test_wheel_alone_imports_and_runs(built, tmp_path):
    """An environment whose only neuido is the wheel's; the libraries are those of this one."""
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(tmp_path / "venv")], check=True)
    python = tmp_path / "venv" / "bin" / "python"
    (packages,) = (tmp_path / "venv" / "lib").glob("python3.*/site-packages")
    with zipfile.ZipFile(built["wheel"]) as archive:
        archive.extractall(packages)
    libraries = [path for path in sys.path if path.endswith("site-packages")]
    (packages / "libraries.pth").write_text("\n".join(libraries) + "\n")
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "NEUIDO_DATA")} | {"OMP_NUM_THREADS": "1"}

    def run(*arguments: str) -> str:
        done = subprocess.run([str(python), *arguments], capture_output=True, text=True, cwd=tmp_path, env=environment, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout

    code = (
        "import neuido; print(neuido.__file__); print(neuido.configs_root());"
        "assert (neuido.configs_root() / 'diagnose.yaml').is_file(); assert len(neuido.Operator.load().latents) > 1;"
        "print(neuido.Encoder.load('pretrained-small').training)"
    )
    where, configs, _ = run("-c", code).splitlines()
    assert Path(where).is_relative_to(packages)
    assert Path(configs) == packages / "neuido" / "configs"
    assert run("-m", "neuido", "--version").strip() == f"neuido {neuido.__version__}"
    assert "--minutes" in run("-m", "neuido", "diagnose", "--help")
    assert "solver: both" in run("-m", "neuido", "diagnose", "--config", "diagnose", "--folder", "a", "--out", "b", "--print_config")


def test_every_dependency_is_listed_with_its_licence():
    rows = re.findall(r"^\| ([\w-]+) \| (.+) \| (.+) \|$", (ROOT / "docs" / "reference" / "dependencies.md").read_text(), re.MULTILINE)
    listed = {name for name, what, licence in rows if what.strip() and licence.strip()}
    needed = {re.split(r"[^\w-]", each)[0] for each in PROJECT["dependencies"]}
    assert listed - {"package", "---"} == needed


def test_every_package_of_an_extra_is_listed_with_its_extra():
    text = (ROOT / "docs" / "reference" / "dependencies.md").read_text()
    for extra, packages in PROJECT["optional-dependencies"].items():
        rows = [line for line in text.splitlines() if f"`{extra}`" in line]
        for name in (re.split(r"[^\w-]", each)[0] for each in packages):
            known = name in ("neuido", *(re.split(r"[^\w-]", each)[0] for each in PROJECT["dependencies"]))
            assert (
                known
                or any(re.search(rf"\b{re.escape(name)}\b", row) for row in rows)
                or (extra in ("dev", "docs") and f"| {name} (" in text)
            ), (extra, name)
