"""No file is written directly under its final name: a full disk or a signal would leave it cut."""

import ast
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "neuido"
WRITERS = {
    "write_text", "write_bytes", "savefig", "imwrite", "VideoWriter", "save", "savez", "savez_compressed", "savetxt", "tofile", "to_csv",
    "save_file", "copyfile", "copy2", "copytree", "dump", "to_excel",
}  # fmt: skip
MODULES_WRITING = {"np", "numpy", "torch", "json", "yaml", "cv2", "shutil", "safetensors", "pickle"}
"""What `save`, `dump` and the like are asked of; the same names of the project's own objects write by these."""
WHOLE = {"atomic_write", "whole_file", "BytesIO", "StringIO", "NamedTemporaryFile", "mkstemp"}
"""What gives a temporary path or memory to write to."""
EXCEPT = {  # why a file is written directly
    ("neuido.data.files.lock", "_note"): "a temporary name of its own, renamed",
    ("neuido.discrepancy.diagnosis_log", "__init__"): "a log that grows line by line",
    ("neuido.commands.sweep", "_execute"): "the output of a run while it runs",
    ("neuido.data.trajectories.generation", "_simulate"): "several files at once, under temporary names of `atomic_write`",
}


def called(node: ast.Call) -> tuple[str, str]:
    """Return the name of what is called, and of what it is an attribute of."""
    if isinstance(node.func, ast.Attribute):
        return node.func.attr, node.func.value.id if isinstance(node.func.value, ast.Name) else ""
    return (node.func.id if isinstance(node.func, ast.Name) else ""), ""


def names(node: ast.AST) -> set[str]:
    return {part.id for part in ast.walk(node) if isinstance(part, ast.Name)}


def safe_names(function: ast.AST) -> set[str]:
    """Return the names of a function that stand for temporary paths and for streams to memory or to such a path."""
    safe: set[str] = set()
    for _ in range(3):  # a stream of a path of a context
        for node in ast.walk(function):
            pairs: list[tuple[ast.AST | None, ast.AST]] = []
            if isinstance(node, ast.With):
                pairs = [(item.optional_vars, item.context_expr) for item in node.items]
            elif isinstance(node, ast.Assign):
                pairs = [(node.targets[0], node.value)]
            for target, value in pairs:
                made = {called(part)[0] for part in ast.walk(value) if isinstance(part, ast.Call)} & WHOLE
                opened = isinstance(value, ast.Call) and called(value)[0] in ("open", "VideoWriter") and names(value) & safe
                if target is not None and (made or opened):
                    safe |= names(target)
    return safe


def writes(node: ast.Call) -> bool:
    name, owner = called(node)
    if name == "open":
        modes = [part.value for part in [*node.args, *[k.value for k in node.keywords]] if isinstance(part, ast.Constant)]
        return any(isinstance(mode, str) and len(mode) <= 3 and set(mode) & set("wax+") for mode in modes)
    if name == "write" and isinstance(node.func, ast.Attribute) and isinstance(node.func.value, ast.Call):
        return called(node.func.value)[0] == "PlyData"
    if name in ("save", "dump", "copy2"):
        return owner in MODULES_WRITING and not (owner == "yaml" and len(node.args) < 2)
    return name in WRITERS


def functions(tree: ast.AST) -> Iterator[ast.AST]:
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node


def direct_writers(source: str) -> list[tuple[str, int, str]]:
    """Return function, line and call of each write that is not under a temporary name."""
    found = []
    for function in functions(ast.parse(source)):
        calls = [node for node in ast.walk(function) if isinstance(node, ast.Call) and writes(node)]
        safe = safe_names(function) if calls else set()
        for node in calls:
            if not names(node) & safe:
                imported = isinstance(node.func, ast.Name) and called(node)[0] in ("write_text", "write_bytes")  # those of `writing`
                if not imported:
                    found.append((function.name, node.lineno, ast.unparse(node)[:100]))
    return found


def test_direct_writers_are_seen():
    source = """
def direct(path):
    path.write_text("x"); open(path, "w"); path.open("ab"); np.savez(path); figure.savefig(path); cv2.imwrite(str(path), x)
    PlyData([1]).write(str(path)); json.dump(x, path); torch.save(x, path); shutil.copyfile(a, path); save_file(x, path)
def whole(path):
    with atomic_write(path) as hidden, hidden.open("wb") as stream:
        np.savez(stream); PlyData([1]).write(str(hidden)); hidden.write_text("x")
    write_text(path, "x"); open(path); path.open("rb"); np.save(io.BytesIO(), x) if 0 else None
"""
    found = direct_writers(source.replace("np.save(io.BytesIO(), x) if 0 else None", "memory = io.BytesIO(); np.save(memory, x)"))
    assert [function for function, *_ in found] == ["direct"] * 11


def test_files_get_their_names_when_they_are_whole():
    found = []
    for path in sorted(PACKAGE.rglob("*.py")):
        source, module = path.read_text(), path.relative_to(PACKAGE.parent).with_suffix("").as_posix().replace("/", ".")
        if any(f"{name}(" in source for name in (*WRITERS, "open", "write")):
            found += [(module, *each) for each in direct_writers(source) if (module, each[0]) not in EXCEPT]
    assert not found, f"written directly, use neuido.data.files.writing: {found}"


def test_exceptions_are_still_needed():
    for module, function in EXCEPT:
        source = (PACKAGE.parent / (module.replace(".", "/") + ".py")).read_text()
        assert function in [each[0] for each in direct_writers(source)], f"{module}.{function} is no exception any more"
