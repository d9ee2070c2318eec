"""The options of a class or a function, read from its source text: nothing is imported, so torch and Lightning need not be loaded.

The help of the trainer's commands and the check of their configurations use this. `tests/commands/test_signatures.py` compares it with the
parser of jsonargparse.
"""

import ast
import functools
import inspect
import re
from collections.abc import Iterable, Iterator
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any, NamedTuple

MODULES = (  # so that their class names resolve without a path
    *(f"neuido.models.stages.{name}" for name in ("pretrain", "pretrain_vae", "warmup", "align", "adapt", "made_scenes")),
    *(f"neuido.models.baselines.{name}" for name in ("known_law", "nclaw", "spring_gaus", "sparse_law", "stage_one_latents")),
    "neuido.models.fewshot.low_rank",
    "neuido.data.trajectories.trajectory_module",
    "neuido.data.clips",
    "neuido.data.scenes.filmed_scene_module",
    "neuido.discrepancy.applied_model",
)

BASES = {  # the key of a configuration that takes a class: the class that it must be derived from
    "model": "LightningModule",
    "data": "LightningDataModule",
    "method": "Method",
    "effects": "EffectSource",
}

TRAINER = "lightning.pytorch.trainer.trainer.Trainer"


class Option(NamedTuple):
    """An option of a class."""

    name: str
    type: str
    """As a user reads it: `int or None`."""
    default: str | None
    """As YAML has it; None where a value must be given."""
    text: str
    """From the docstring; empty where it says nothing."""
    choices: tuple[str, ...] = ()
    """The values that there are, as YAML has them; empty where they cannot be listed."""


class Signature(NamedTuple):
    """What a class takes."""

    path: str
    """The import path of the place where it is written."""
    summary: str
    """The first line of its docstring."""
    options: dict[str, Option]
    open: bool
    """Whether it takes options that its source does not name."""
    bases: tuple[str, ...]
    """The names of the classes that it is derived from, near ones first."""
    former: tuple[str, ...] = ()
    """Former names of options, which are still taken."""


@functools.cache
def signature(path: str) -> Signature | None:
    """Return what a class or a function takes, by its import path; None where its source is not found."""
    found = _definition(path)
    if found is None:
        return None
    module, node = found
    if isinstance(node, ast.FunctionDef):
        options, takes_more = _parameters(node, module, _docs(node), method=False)
        return Signature(f"{module}.{node.name}", _first_line(node), options, takes_more, ())
    docs, bases = _docs(node), _bases(module, node)
    construct = next((part for part in node.body if isinstance(part, ast.FunctionDef) and part.name == "__init__"), None)
    parents = [signature(base) for base in bases]
    names = [name for base, parent in zip(bases, parents) for name in (base.rpartition(".")[2], *(parent.bases if parent else ()))]
    options: dict[str, Option] = {}
    takes_more = construct is None and not _is_dataclass(node)
    if construct is not None:
        options, takes_more = _parameters(construct, module, docs | _docs(construct), method=True)
    elif _is_dataclass(node):
        options = _fields(node, module, docs)
    if takes_more:
        for parent in parents:
            if parent is not None:
                options = {**{key: value for key, value in parent.options.items() if key not in options}, **options}
        takes_more = any(parent is None or parent.open for parent in parents) or (construct is not None and not _passes_on(construct))
    return Signature(f"{module}.{node.name}", _first_line(node), options, takes_more, tuple(dict.fromkeys(names)), _former(node))


def _former(node: ast.ClassDef) -> tuple[str, ...]:
    """Return the names that `@renamed_options(old="new")` gives a class."""
    calls = [each for each in node.decorator_list if isinstance(each, ast.Call) and ast.unparse(each.func) == "renamed_options"]
    return tuple(keyword.arg for call in calls for keyword in call.keywords if keyword.arg)


def names_of(module: str) -> list[str]:
    """Return the names of classes, functions and imports at the top of a module; empty where its source is not found."""
    tree = _source(module)
    own = [node.name for node in tree.body if isinstance(node, ast.ClassDef | ast.FunctionDef)] if tree else []
    return [*own, *_imports(module)]


@functools.cache
def classes(key: str) -> dict[str, str]:
    """Return the classes of neuido that a key of a configuration takes, a key of `BASES`: name -> import path.

    A class whose docstring calls it a base class is left out.
    """
    found: dict[str, str] = {}
    for module in MODULES:
        tree = _source(module)
        for node in tree.body if tree else ():
            own = signature(f"{module}.{node.name}") if isinstance(node, ast.ClassDef) else None
            if own is not None and BASES[key] in own.bases and not own.summary.startswith("Base class"):
                found[own.path.rpartition(".")[2]] = own.path
    return found


def signature_of(key: str, name: str) -> Signature | None:
    """Return what a class takes that a key names by its name alone or its import path; None where its source is not found."""
    path = name if "." in name else classes(key).get(name) if key in BASES else None
    return signature(path) if path else None


def as_class(given: Any) -> Any:
    """Return what a configuration gives for a class, of which it may give the name alone, as a mapping with `class_path`."""
    return {"class_path": given} if isinstance(given, str) else given


@functools.cache
def _source(module: str) -> ast.Module | None:
    path = _file(module)
    try:
        return ast.parse(path.read_text(encoding="utf-8")) if path is not None else None
    except (OSError, SyntaxError, ValueError):
        return None


def _file(module: str) -> Path | None:
    """Return the source file of a module without importing it or its parents."""
    places: list[str] | None = None
    spec, name = None, ""
    for part in module.split("."):
        name = f"{name}.{part}" if name else part
        try:
            spec = PathFinder.find_spec(name, places)
        except (ImportError, ValueError, OSError):
            return None
        if spec is None:
            return None
        places = list(spec.submodule_search_locations or [])
    return Path(spec.origin) if spec is not None and spec.origin and spec.origin.endswith(".py") else None


def _definition(path: str, depth: int = 0) -> tuple[str, ast.ClassDef | ast.FunctionDef] | None:
    """Return the module and the syntax tree of a class or function; an import of it by another module is followed."""
    module, _, name = path.rpartition(".")
    tree = _source(module) if module and depth < 8 else None
    if tree is None:
        return None
    for node in tree.body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and node.name == name:
            return module, node
    origin = _imports(module).get(name)
    return _definition(origin, depth + 1) if origin else None


@functools.cache
def _imports(module: str) -> dict[str, str]:
    """Return the names that a module imports at its top: name -> import path."""
    tree, found = _source(module), {}
    path = _file(module)
    package = module if path is not None and path.name == "__init__.py" else module.rpartition(".")[0]
    for node in _statements(tree.body if tree else []):
        if isinstance(node, ast.ImportFrom):
            parts = package.split(".")
            base = ".".join(parts[: len(parts) - node.level + 1]) if node.level else ""
            source = ".".join(filter(None, (base, node.module)))
            found |= {alias.asname or alias.name: f"{source}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {alias.asname or alias.name: alias.name for alias in node.names}
    return found


def _statements(body: Iterable[ast.stmt]) -> Iterator[ast.stmt]:
    for node in body:
        if isinstance(node, ast.If):
            yield from _statements([*node.body, *node.orelse])
        elif isinstance(node, ast.Try):
            yield from _statements(node.body)
        else:
            yield node


def _bases(module: str, node: ast.ClassDef) -> list[str]:
    found = []
    for base in node.bases:
        base = base.value if isinstance(base, ast.Subscript) else base
        first, _, rest = ast.unparse(base).partition(".")
        origin = _imports(module).get(first, f"{module}.{first}")
        if first != "object":
            found.append(f"{origin}.{rest}" if rest else origin)
    return found


def _passes_on(construct: ast.FunctionDef) -> bool:
    """Return whether a constructor gives what it takes by `**` to the class that it is derived from, and to nothing else."""
    names = {construct.args.kwarg.arg} if construct.args.kwarg else set()
    uses = [node for node in ast.walk(construct) if isinstance(node, ast.Name) and node.id in names]
    calls = [node for node in ast.walk(construct) if isinstance(node, ast.Call) and ast.unparse(node.func) == "super().__init__"]
    return len(uses) == 1 and any(keyword.arg is None for call in calls for keyword in call.keywords)


def _is_dataclass(node: ast.ClassDef) -> bool:
    return any("dataclass" in ast.unparse(each) for each in node.decorator_list)


def _fields(node: ast.ClassDef, module: str, docs: dict[str, str]) -> dict[str, Option]:
    found = {}
    for part in node.body:
        if isinstance(part, ast.AnnAssign) and isinstance(part.target, ast.Name):
            name = part.target.id
            found[name] = Option(
                name, _type(part.annotation, module), None if part.value is None else _value(part.value), docs.get(name, "")
            )
    return found


def _parameters(node: ast.FunctionDef, module: str, docs: dict[str, str], *, method: bool) -> tuple[dict[str, Option], bool]:
    """Return the parameters of a function, and whether it takes others by `**`."""
    given = node.args
    named = [*given.posonlyargs, *given.args][int(method) :]
    defaults: list[ast.expr | None] = [None] * (len(named) - len(given.defaults)) + list(given.defaults)
    pairs = [*zip(named, defaults, strict=False), *zip(given.kwonlyargs, given.kw_defaults, strict=True)]
    options = {}
    for argument, default in pairs:
        value = None if default is None else _value(default)
        kind = argument.annotation
        options[argument.arg] = Option(argument.arg, _type(kind, module), value, docs.get(argument.arg, ""), _choices(kind, module))
    return options, given.kwarg is not None


def _value(node: ast.expr) -> str:
    """Return a default as YAML has it."""
    try:
        return yaml_word(ast.literal_eval(node))
    except ValueError:
        return ast.unparse(node)


def yaml_word(value: object) -> str:
    """Return a value as it stands in YAML, on one line."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(yaml_word, value))}]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {yaml_word(part)}" for key, part in value.items()) + "}"
    return str(value)


_NAMES = {"float": "number", "bool": "true or false", "str": "text", "_PATH": "path", "Path": "path", "PathLike": "path", "dict": "mapping"}


def _type(node: ast.expr | None, module: str) -> str:
    """Return an annotation as a user reads it: `Optional[Union[int, float]]` as `number or null`."""
    words = list(dict.fromkeys(_words(node, module)))
    if "float" in words and "int" in words:
        words.remove("int")  # a whole number is a number
    words = list(dict.fromkeys(_NAMES.get(word, word) for word in words))
    words.sort(key=lambda word: word == "null")
    return f"{', '.join(words[:-1])} or {words[-1]}" if len(words) > 1 else "".join(words)


def _words(node: ast.expr | None, module: str, depth: int = 0) -> Iterator[str]:
    if node is None or depth > 8:
        return
    if isinstance(node, ast.Constant) and isinstance(node.value, str):  # a type that is quoted
        yield from _words(ast.parse(node.value, mode="eval").body, module, depth + 1)
    elif isinstance(node, ast.Constant):
        yield "null" if node.value is None else str(node.value)
    elif isinstance(node, ast.BinOp):
        yield from (*_words(node.left, module, depth), *_words(node.right, module, depth))
    elif isinstance(node, ast.Subscript):
        head = ast.unparse(node.value).rpartition(".")[2]
        inner = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
        if head in ("Optional", "Union"):
            for part in inner:
                yield from _words(part, module, depth)
            yield from ["null"] * (head == "Optional")
        elif head == "Literal":
            yield from (yaml_word(ast.literal_eval(part)) for part in inner)
        elif head in ("list", "List", "Sequence", "Iterable", "tuple", "Tuple", "set"):
            yield f"list of {_type(inner[0], module)}"
        elif head in ("dict", "Dict", "Mapping"):
            yield "mapping"
        else:
            yield head
    else:
        name = ast.unparse(node)
        meant = _alias(module, name) if isinstance(node, ast.Name) and name not in _NAMES else None
        if meant is None:
            yield name.rpartition(".")[2]
        else:
            yield from _words(meant[1], meant[0], depth + 1)


def _alias(module: str, name: str, depth: int = 0) -> tuple[str, ast.expr] | None:
    """Return the module and the expression of a type that a module names, such as `Precision = Literal[16, 32]`; None for a class."""
    tree = _source(module) if depth < 8 else None
    for node in _statements(tree.body if tree else ()):
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            if any(isinstance(target, ast.Name) and target.id == name for target in targets):
                return (module, node.value) if isinstance(node.value, ast.Subscript | ast.BinOp | ast.Name) else None
    origin = _imports(module).get(name, "").rpartition(".")
    return _alias(origin[0], origin[2], depth + 1) if origin[0] else None


def _choices(node: ast.expr | None, module: str, depth: int = 0) -> tuple[str, ...]:
    """Return the values that an annotation allows, where it names all of them."""
    if isinstance(node, ast.Constant) and node.value is None:
        return ("null",)
    if isinstance(node, ast.BinOp):
        parts = [_choices(side, module, depth) for side in (node.left, node.right)]
        return (*parts[0], *parts[1]) if all(parts) else ()
    if isinstance(node, ast.Subscript):
        head = ast.unparse(node.value).rpartition(".")[2]
        inner = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
        if head == "Literal":
            return tuple(yaml_word(ast.literal_eval(part)) for part in inner)
        parts = [_choices(part, module, depth) for part in inner] if head in ("Optional", "Union") else [()]
        return (*(word for part in parts for word in part), *["null"] * (head == "Optional")) if all(parts) else ()
    if isinstance(node, ast.Name) and node.id == "bool":
        return ("true", "false")
    meant = _alias(module, node.id) if isinstance(node, ast.Name) and depth < 8 and node.id not in ("int", *_NAMES) else None
    return _choices(meant[1], meant[0], depth + 1) if meant else ()


def _first_line(node: ast.ClassDef | ast.FunctionDef) -> str:
    return (ast.get_docstring(node) or "").partition("\n")[0]


def _docs(node: ast.ClassDef | ast.FunctionDef) -> dict[str, str]:
    """Return what the `Args:` of a docstring say of each name."""
    text = inspect.cleandoc(ast.get_docstring(node) or "")
    lines = text.splitlines()
    start = next((i for i, line in enumerate(lines) if re.fullmatch(r"(Args|Arguments|Parameters):\s*", line.strip())), None)
    found: dict[str, list[str]] = {}
    if start is None:
        return {}
    own: list[str] = []
    depth = None
    for line in lines[start + 1 :]:
        indent = len(line) - len(line.lstrip())
        if not line.strip():
            continue
        if indent <= len(lines[start]) - len(lines[start].lstrip()):
            break
        depth = indent if depth is None else depth
        begun = re.match(r"\s*\*{0,2}(\w+(?:, \w+)*)(?: ?\([^)]*\))?:\s*(.*)", line) if indent == depth else None
        if begun:
            own = begun[1].split(", ")
            found |= {name: [begun[2]] for name in own}
        else:
            for name in own:
                found[name].append(line.strip())
    return {name: re.sub(r":\w+:`~?([^`]+)`", r"`\1`", " ".join(filter(None, parts))) for name, parts in found.items()}
