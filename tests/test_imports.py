"""The package imports in one direction, and little at its start."""

import ast
import functools
import json
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "neuido"
MODULES = sorted(path.relative_to(PACKAGE.parent).with_suffix("").as_posix().replace("/", ".") for path in PACKAGE.rglob("*.py"))

ROOT = ("neuido",)
"""Frames are exported and shown by the public names, which the face of the package imports at their use."""
GROUND = ("neuido.types", "neuido.errors", "neuido.installation")
LIGHTNING = ("neuido.models.stages", "neuido.commands", "neuido.data.trajectories", "neuido.data.scenes", "neuido.data.clips",
             "neuido.models.reconstruct")  # fmt: skip
"""The rooms whose modules may import Lightning: the training modules, the data modules and the commands."""
ROOMS = {  # room: the parts of neuido that it may import, itself included
    "neuido.types": (),
    "neuido.errors": (),
    "neuido.installation": (),
    "neuido.physics": (*GROUND, "neuido.physics"),
    "neuido.data": (*GROUND, "neuido.physics", "neuido.data"),
    "neuido.models": (*GROUND, "neuido.physics", "neuido.data", "neuido.models"),
    "neuido.discrepancy": (*GROUND, "neuido.physics", "neuido.data", "neuido.models", "neuido.discrepancy"),
    "neuido.viewer": (*GROUND, "neuido.physics", "neuido.data", "neuido.models", "neuido.viewer"),
    "neuido.export": (*GROUND, "neuido.physics", "neuido.data", "neuido.models", "neuido.export"),
}
PHYSICS_MAY = {"torch", "numpy", "warp", "neuido", "lazy_loader"} | set(sys.stdlib_module_names)


def within(name: str, parts: tuple[str, ...]) -> bool:
    return any(name == part or name.startswith(part + ".") for part in parts)


def imports(source: str, module: str = "neuido.test") -> set[str]:
    """Every module that a source imports, at its top, inside a function or by its written name; `from a import b` counts as a.b."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                base = ".".join([*module.split(".")[: -node.level], *filter(None, [node.module])])
            found |= {f"{base}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith("import_module") and isinstance(node.args[0], ast.Constant):
            found.add(node.args[0].value)
    return found


@functools.cache
def imports_of(module: str) -> set[str]:
    path = PACKAGE.parent / (module.replace(".", "/") + ".py")
    return imports(path.read_text(), module)


def test_reader_sees_every_form_of_import():
    source = "import a.b\nfrom c import d\ndef f():\n    from ..e import g\n    return importlib.import_module('h.i')\n"
    assert imports(source, "neuido.x.y") == {"a.b", "c.d", "neuido.e.g", "h.i"}


@pytest.mark.parametrize("module", MODULES)
def test_direction(module):
    for room, allowed in ROOMS.items():
        if within(module, (room,)):
            own = {name for name in imports_of(module) if within(name, ("neuido",)) and name not in ROOT}
            wrong = {name for name in own if not within(name, allowed)}
            assert not wrong, f"{module} imports {sorted(wrong)}; {room} may import {allowed} alone"


DIRECT_SOLVER = "neuido.physics.plane.plane_specimen"
"""It solves sparse linear systems directly, which neither torch nor NumPy does on a CPU; scipy is a dependency of the package anyway."""
SPEAK_WANDB = (
    "neuido.commands.main",
    "neuido.commands.sweep",
    "neuido.commands.cli.sweep_file",
    "neuido.data.files.sweep_run",
    "neuido.commands.cli.trainer",
)
"""They speak the language of its files and its environment, and import nothing of it."""


@pytest.mark.parametrize("module", MODULES)
def test_third_parties(module):
    names = {name.split(".")[0] for name in imports_of(module)}
    if within(module, ("neuido.physics",)):
        may = PHYSICS_MAY | ({"scipy"} if module == DIRECT_SOLVER else set())
        assert names <= may, f"{module} imports {sorted(names - may)}"
    if within(module, ("neuido.physics", "neuido.data", "neuido.models")) and not within(module, LIGHTNING):
        assert not names & {"lightning", "pytorch_lightning"}, f"{module} imports Lightning; only {LIGHTNING} may"
    if module != "neuido.models.fewshot.low_rank":
        assert "peft" not in names, f"{module} imports peft"
    assert "wandb" not in names, f"{module} imports wandb"
    assert "pytorch_lightning" not in names, f"{module} imports pytorch_lightning; the package is lightning"
    if module not in SPEAK_WANDB:
        assert "wandb" not in (PACKAGE.parent / (module.replace(".", "/") + ".py")).read_text().lower(), f"{module} names wandb"


LIGHT = ("", ".__main__", ".errors", ".data.trajectories.options", ".data.scenes.film_options", ".data.undeclared", ".data.files.html_page",
         ".data.files.results", ".data.files.sweep_run", ".data.files.score_tables", ".commands.diagnose",
         *(f".commands.{name}" for name in ("main", "doctor", "reconstruct", "film", "sweep", "report",
                                            "latents", "demo.demo", "output.export",
                                            *(f"simulation.{n}" for n in ("simulate", "trajectories", "scenes", "undeclared", "replay",
                                                                          "former_options")), "cli.config_files",
                                            "cli.trainer", "cli.trainer_help", "cli.signatures", "cli.functions")))  # fmt: skip


@pytest.fixture(scope="module")
def loaded() -> dict[str, list[str]]:
    """What each light module loads, in a fork each of a fresh process that has imported nothing of the package."""
    code = """
import importlib, json, os, sys

for module in sys.argv[1:]:
    if not os.fork():
        importlib.import_module(module)
        print(json.dumps([module, sorted({"torch", "lightning", "warp", "jsonargparse"} & set(sys.modules))]), flush=True)
        os._exit(0)
    os.wait()
"""
    modules = [f"neuido{name}" for name in LIGHT]
    answer = subprocess.run([sys.executable, "-c", code, *modules], capture_output=True, text=True, cwd=PACKAGE.parent, check=True)
    assert not answer.stderr
    return dict(map(json.loads, answer.stdout.splitlines()))


@pytest.mark.parametrize("module", [f"neuido{name}" for name in LIGHT])
def test_light_modules_load_neither_torch_nor_lightning(loaded, module):
    assert loaded[module] == []


# The drawn structure. An `__init__.py` is a face: it defines nothing and imports nothing of the package; its stub names what it hands on.

FLOORS, FOLDER_FLOORS, FILES, LINES, FACE_LINES = 9, 12, 14, 450, 40
COMMANDS = {path.stem for path in (PACKAGE / "commands").glob("*.py")}


def drawn() -> dict[str, set[str]]:
    """Return what each file imports of the package, type-only imports included."""
    graph = {}
    for module in MODULES:
        if not module.endswith("__init__"):
            names = imports_of(module)
            graph[module] = {other for name in names for other in (name, name.rpartition(".")[0]) if other in MODULES and other != module}
    return graph


def circles(graph: dict[str, set[str]]) -> list[set[str]]:
    """Return the groups of nodes that reach one another."""
    reached = {}
    for start in graph:
        seen, waiting = set(), list(graph[start])
        while waiting:
            node = waiting.pop()
            if node not in seen:
                seen.add(node)
                waiting += graph.get(node, ())
        reached[start] = seen
    groups = {frozenset(other for other in reached[node] if node in reached.get(other, ())) for node in graph if node in reached[node]}
    return [set(group) for group in groups]


def by_folder(graph: dict[str, set[str]], whole: tuple[str, ...] = ("neuido.commands",)) -> dict[str, set[str]]:
    """Return the same between folders; a file of a room's top stands for itself, but for those that count as a `whole`."""

    def folder(module: str) -> str:
        own = next((room for room in whole if within(module, (room,))), None)
        return own or (module if module.count(".") < 3 else module.rpartition(".")[0])

    out: dict[str, set[str]] = {}
    for module, others in graph.items():
        out.setdefault(folder(module), set()).update(folder(other) for other in others if folder(other) != folder(module))
    return out


@pytest.mark.parametrize("module", [module for module in MODULES if module.endswith("__init__")])
def test_faces_are_thin(module):
    path = PACKAGE.parent / (module.replace(".", "/") + ".py")
    rest = ast.parse(path.read_text()).body[1:]  # after the docstring
    assert len(path.read_text().splitlines()) < FACE_LINES
    lazy = ["import lazy_loader", "__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)"]
    assert [ast.unparse(node).replace("(__getattr__, __dir__, __all__)", "__getattr__, __dir__, __all__") for node in rest] in ([], lazy)
    stub = path.with_suffix(".pyi")
    assert stub.is_file() == bool(rest)
    if rest:  # a room hands on what lies in it, which keeps the direction; the package itself hands on the names of all rooms
        assert {node.level for node in ast.walk(ast.parse(stub.read_text())) if isinstance(node, ast.ImportFrom)} == {1}


def test_circles_are_seen():
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": {"a"}}) == [{"b", "c"}]
    assert circles({"a": {"b"}, "b": set()}) == []


def test_no_circle_of_files():
    assert circles(drawn()) == []


def test_no_circle_of_folders():
    assert circles(by_folder(drawn())) == []


def floors(graph: dict[str, set[str]]) -> int:
    """Return the length of the longest way down, in nodes."""
    heights: dict[str, int] = {}

    def height(node: str) -> int:
        if node not in heights:
            heights[node] = 1 + max((height(other) for other in graph.get(node, ())), default=0)
        return heights[node]

    return max(map(height, graph))


def test_few_floors():
    graph, rooms = by_folder(drawn()), {}
    for node, others in graph.items():
        own = ".".join(node.split(".")[:2])
        rooms.setdefault(own, set()).update(room for other in others if (room := ".".join(other.split(".")[:2])) != own)
    assert circles(rooms) == []
    assert floors(rooms) <= FLOORS
    assert floors(by_folder(drawn(), ("neuido.commands", "neuido.discrepancy", "neuido.viewer"))) <= FOLDER_FLOORS


def test_folders_and_files_are_small():
    for folder in {path.parent for path in PACKAGE.rglob("*.py")}:
        assert len(list(folder.glob("*.py"))) <= FILES, folder
    for module in MODULES:
        lines = len((PACKAGE.parent / (module.replace(".", "/") + ".py")).read_text().splitlines())
        assert lines <= LINES, f"{module} has {lines} lines"


def test_no_stem_twice_but_a_commands():
    stems: dict[str, list[str]] = {}
    for module in MODULES:
        stem = module.rpartition(".")[2]
        if stem not in ("__init__", "__main__"):
            stems.setdefault(stem, []).append(module)
    assert {stem: own for stem, own in stems.items() if len(own) > 1 and stem not in COMMANDS} == {}
