"""The documentation: its snippets run, its commands are known to the command line, its links hold, its schemas agree with the readers."""

import ast
import contextlib
import copy
import functools
import importlib.util
import io
import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

import neuido
from neuido import UserError
from neuido.commands import main as cli

ROOT = Path(neuido.__file__).parents[1]
DOCS = ROOT / "docs"
if not DOCS.is_dir():
    pytest.skip("the documentation does not come with the installed package", allow_module_level=True)
PAGES = sorted(p for p in DOCS.rglob("*.md") if not {"_build", "generated", "gallery"} & set(p.relative_to(DOCS).parts))
QUICK = {"Box", "Plane", "Scene", "Walls", "AttachedMass", "UserError", "configs_root", "shapes", "read_tracks", "load_scene"}
RUN = ("neuido doctor", "neuido trajectories --out runs/small", "neuido fit --config configs/quickstart.yaml --data.root runs/small")
"""Commands that run at the size at which they stand, in the slow tier; the others are read by the command line that they are for."""


def name_of(page: Path) -> str:
    return str(page.relative_to(DOCS))


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), flags=re.MULTILINE | re.DOTALL)


def commands() -> list[tuple[str, str]]:
    """Return page and command of each line of a page that calls neuido."""
    found = []
    for page in PAGES:
        text = page.read_text()
        shown = [*blocks(page, "bash"), *re.findall(r"^(?: {4}\S.*\n)+", text, flags=re.MULTILINE)]
        lines = (line.split(" #")[0].strip() for block in shown for line in block.splitlines())
        found += [(name_of(page), line.removeprefix("srun ")) for line in lines if re.match(r"(srun )?neuido ", line)]
    return found


def skip_without_viewer(code: str) -> None:
    if re.search(r"neuido\.(show|view)\(|frames\.show\(", code):
        pytest.importorskip("viser", reason="viser is not installed: pip install neuido[viewer]")


def run_page(page: Path, folder: Path) -> str:
    """Run the snippets of a page in their order, beside the YAML files that it shows."""
    for block in blocks(page, "yaml"):
        match = re.match(r"# (\S+\.yaml)\n", block)
        assert match, "a YAML block starts with its file name"
        (folder / match[1]).write_text(block)
    code = "\n".join(block for block in blocks(page, "python") if not block.startswith("# needs data"))
    skip_without_viewer(code)
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "MPLBACKEND": "agg"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=folder, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("page", [p for p in PAGES if blocks(p, "python")], ids=name_of)
def test_snippets(page, tmp_path):
    run_page(page, tmp_path)


@pytest.mark.parametrize("page", [p for p in PAGES if blocks(p, "python")], ids=name_of)
def test_imports_of_snippets(page):
    for block in blocks(page, "python"):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and node.module.split(".")[0] == "neuido":
                module = importlib.import_module(node.module)
                for alias in node.names:
                    assert hasattr(module, alias.name), f"{node.module} has no {alias.name}"


def api_examples() -> dict[str, str]:
    spec = importlib.util.spec_from_file_location("api_examples", DOCS / "_ext" / "api_examples.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.EXAMPLES


def test_every_public_name_has_an_example():
    assert set(api_examples()) >= set(neuido.__all__) - {"__version__"}


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[] if n in QUICK else [pytest.mark.slow]) for n in sorted(set(api_examples()) & set(neuido.__all__))]
)
def test_api_example(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    skip_without_viewer(api_examples()[name])
    exec(compile(api_examples()[name], f"example of {name}", "exec"), {})


@pytest.fixture(scope="module")
def help_of() -> Callable[[str], str]:
    """Return the help of a light command, printed once for all pages."""

    @functools.cache
    def printed(name: str) -> str:
        with pytest.raises(SystemExit), contextlib.redirect_stdout(io.StringIO()) as out:
            cli.main([name, "--help"])
        return out.getvalue()

    return printed


@pytest.mark.parametrize(("page", "command"), commands())
def test_command_is_known(page, command, help_of):
    name, *args = shlex.split(command)[1:]
    assert name in cli.LIGHT or name in cli.HEAVY, f"{page}: {command}"
    configs = [args[i + 1] for i, word in enumerate(args[:-1]) if word == "--config"]
    for config in configs:
        assert (ROOT / config).is_file() or list((ROOT / "configs").rglob(f"{config}*")), f"{page}: {config}"
    if name in cli.LIGHT:
        known = help_of(name)
        for word in args:
            if word.startswith("--"):
                assert word in known, f"{page}: {command}"


@pytest.mark.slow
def test_commands_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shown = [command for _, command in commands() if command.startswith(RUN)]
    assert len(shown) >= 3
    for command in dict.fromkeys(shown):
        with pytest.raises(SystemExit) as stop:
            cli.main(shlex.split(command)[1:])
        assert stop.value.code == 0, f"{command}: {capsys.readouterr().err}"


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", re.sub(r"`[^`]*`", "", page.read_text())):
        if target.startswith(("http", "#")) or "generated/" in target or "gallery/" in target:
            continue  # pages that are made are checked by the build, whose warnings are errors
        assert (page.parent / target.split("#")[0]).exists(), target


# formats


def schema(name: str) -> dict:
    return json.loads((DOCS / "formats" / "schemas" / f"neuido-{name}-1.schema.json").read_text())


def valid(name: str, content: dict) -> bool:
    return jsonschema().Draft202012Validator(schema(name)).is_valid(json.loads(json.dumps(content)))


def jsonschema():
    return pytest.importorskip("jsonschema")


def test_schemas_are_those_of_the_readers():
    spec = importlib.util.spec_from_file_location("make_schemas", DOCS / "formats" / "make_schemas.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    for name, made in module.schemas().items():
        assert json.loads((DOCS / "formats" / "schemas" / name).read_text()) == made, "run python docs/formats/make_schemas.py"


READERS = {
    "material-test": (neuido.read_material_tests, "test.yaml"),
    "plane": (neuido.read_plane_experiment, "plane.yaml"),
    "track": (neuido.read_tracks, "track.yaml"),
    "scene": (neuido.load_scene, "scene.yaml"),
}


def example_of(name: str) -> dict:
    """Return the YAML block of a format's page."""
    (block,) = blocks(DOCS / "formats" / f"{name}.md", "yaml")
    return yaml.safe_load(block.replace("1.0e+6", "1000000.0").replace("2.0e+6", "2000000.0"))


def write_folder(name: str, content: dict, folder: Path) -> Path:
    """Write a folder of a format with the tables that its example names."""
    (folder / "uniaxial.csv").write_text("Stretch,Stress\n" + "".join(f"{1 + 0.1 * i},{0.1 * i}\n" for i in range(20)))
    (folder / "golf_1.csv").write_text("t_s,height_m\n" + "".join(f"{0.1 * i},{1.0 + 0.1 * i}\n" for i in range(9)))
    nodes = [(0, 0, "left", "bottom"), (1, 0, "right", "bottom"), (1, 1, "right", "top"), (0, 1, "left", "top"), (0.5, 0.5, "", "")]
    (folder / "nodes.csv").write_text("x,y,boundary_x,boundary_y\n" + "".join(f"{x},{y},{a},{b}\n" for x, y, a, b in nodes))
    (folder / "elements.csv").write_text("node1,node2,node3\n" + "".join(f"{i},{(i + 1) % 4},4\n" for i in range(4)))
    for i in (1, 2):
        (folder / f"step_{i}.csv").write_text("ux,uy\n" + "".join(f"{0.01 * i * x},{0.01 * i * y}\n" for x, y, *_ in nodes))
    (folder / "forces.csv").write_text("right_x,top_y\n80,80\n160,160\n")
    file = folder / READERS[name][1]
    file.write_text(yaml.safe_dump(content))
    return file


def accepted(name: str, content: dict, folder: Path) -> bool:
    try:
        READERS[name][0](write_folder(name, content, folder))
    except UserError:
        return False
    return True


def places(content, path=()):
    """Yield the path of every mapping key of a content."""
    if isinstance(content, dict):
        for key, value in content.items():
            yield (*path, key)
            yield from places(value, (*path, key))
    elif isinstance(content, list) and content and isinstance(content[0], dict):
        yield from places(content[0], (*path, 0))


def changed(content: dict, path: tuple, value) -> dict:
    """Return a copy with another value at a path, or without it where the value is None."""
    copied = copy.deepcopy(content)
    inner = copied
    for key in path[:-1]:
        inner = inner[key]
    if value is None:
        del inner[path[-1]]
    else:
        inner[path[-1]] = value
    return copied


@pytest.mark.parametrize("name", READERS)
def test_schema_and_reader_agree(name, tmp_path):
    content = example_of(name)
    assert valid(name, content)
    assert accepted(name, content, tmp_path)
    tried = 0
    for path in places(content):
        if (
            path[0] in ("body", "bodies") or path[-1] in ("columns", "time", "free", "forces") or "scale" in path
        ):  # shapes, names and units are the reader's own
            continue
        for value in (None, {"no": "such thing"}):
            other = changed(content, path, value)
            assert valid(name, other) == accepted(name, other, tmp_path), (path, value)
            tried += 1
    unknown = changed(content, ("surprise",), 1)
    assert not valid(name, unknown)
    assert not accepted(name, unknown, tmp_path)
    assert tried > 10


def test_experiment_example_is_valid_and_mistakes_are_not():
    content = example_of("experiment")
    assert valid("experiment", content)
    for path in places(content):
        if path[0] in ("scene", "discretisation") and path[-1] not in ("colliders", "friction"):
            assert not valid("experiment", changed(content, path, None)), path
    assert not valid("experiment", changed(content, ("model", "elasticity", "law"), "no such law"))
