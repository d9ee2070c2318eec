"""YAML files that build on others (`base: FILE` takes what another file says, and the keys beside it win), and the line of each key."""

import contextlib
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from neuido.data.files.parsing import naming, read_text, read_yaml
from neuido.errors import UserError
from neuido.installation import configs_root

Keys = tuple[str | int, ...]
"""Names of keys and numbers of list entries, outermost first."""


def key_lines(path: str | os.PathLike) -> dict[Keys, int]:
    """Return the line of each key and list entry of a YAML file, from 1 on; empty where the file cannot be read."""
    try:
        root = yaml.compose(read_text(path), Loader=yaml.SafeLoader)
    except (UserError, yaml.YAMLError, ValueError, RecursionError):
        return {}
    return dict(_lines(root, (), set())) if root is not None else {}


def _lines(node: yaml.Node, keys: Keys, above: set[int]) -> Iterator[tuple[Keys, int]]:
    if id(node) in above or len(above) > 30 or node.start_mark is None:  # an alias of what holds it
        return
    above = above | {id(node)}
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            if isinstance(key, yaml.ScalarNode):
                yield (*keys, key.value), key.start_mark.line + 1
                yield from _lines(value, (*keys, key.value), above)
    elif isinstance(node, yaml.SequenceNode):
        for i, value in enumerate(node.value):
            yield (*keys, i), value.start_mark.line + 1
            yield from _lines(value, (*keys, i), above)


def dotted(keys: Keys) -> str:
    """Return keys as errors write them: `scene.colliders[0].normal`."""
    return "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in keys).removeprefix(".")


def split(key: str) -> Keys:
    """Return the keys of a dotted name, such as `scene.colliders[0].normal`."""
    return tuple(int(number) if number else name for name, number in re.findall(r"([^.\[\]]+)(?=[.\[]|$)|\[(\d+)\]", key))


def located(path: str | os.PathLike, error: Exception) -> UserError:
    """Return an error about a YAML file that names the file, and the line of the key that its message speaks of where one is found.

    Args:
        path: The file.
        error: Its message names a key by its dotted name (`scene.gravity must be ...`), or an unknown key by its own and that of its
            place (`unknown key 'gravty' in scene`).
    """
    message = str(error)
    if message.startswith(f"{path}:"):
        return UserError(message)
    line = line_of(message, key_lines(path))
    return UserError(f"{path}:{line}: {message}" if line else f"{path}: {message}")


@contextlib.contextmanager
def checking(path: str | os.PathLike) -> Iterator[None]:
    """Name the file and the line in each error about the content of a YAML file, whatever its type."""
    with naming(path, "holds a value that cannot be used"):
        try:
            yield
        except UserError as error:
            raise located(path, error) from error


def line_of(message: str, lines: dict[Keys, int]) -> int | None:
    """Return the line of the key that a message speaks of."""
    unknown = re.search(r"unknown key '?\"?([\w.\[\]-]+)'?\"?(?: in ([\w.\[\]]+))?", message)
    if unknown:
        place = split(unknown[2]) if unknown[2] and unknown[2] != "the" else ()
        found = lines.get((*place, *split(unknown[1])))
        return found or lines.get((*place, unknown[1])) or lines.get(place)
    best: tuple[int, int] | None = None
    for name in re.findall(r"[A-Za-z_]\w*(?:\.\w+|\[\d+\])*", message):
        keys = split(name)
        while keys and keys not in lines:
            keys = keys[:-1] if len(keys) > 1 else ()
        if keys and (best is None or len(keys) > best[0]):
            best = len(keys), lines[keys]
    return best[1] if best else None


def shown(path: str | os.PathLike) -> str:
    """Return the path of a file as errors show it: relative to the current folder where it lies below."""
    try:
        return Path(path).resolve().relative_to(Path.cwd()).as_posix()
    except (ValueError, OSError):
        return str(path)


BASE = "base"


class Place(NamedTuple):
    """File and line of a key."""

    file: Path
    line: int

    def __str__(self) -> str:
        return f"{shown(self.file)}:{self.line}"


def shipped(name: str) -> Path | None:
    """Return a configuration that comes with neuido by its name; None where there is none of that name."""
    relative = name.removeprefix("configs/").removesuffix(".yaml") + ".yaml"
    return next((own for own in (configs_root() / relative, configs_root() / "scenes" / relative) if own.is_file()), None)


def read_configuration(path: str | os.PathLike) -> dict[str, Any]:
    """Return the content of a configuration with its bases merged in.

    `base` is a path relative to the file, the name of a configuration that comes with neuido, or a list of these; of several the later
    wins, and the file itself over all. Mappings are merged key by key; lists and values are replaced. Where another `class_path` is
    given, the `init_args` of the base go with its class.

    Raises:
        UserError: A file that is missing or no YAML, or a base that leads back to the file.
    """
    content: dict[str, Any] = {}
    for file in chain(path):
        content = merged(content, {key: value for key, value in read_yaml(file).items() if key != BASE})
    return content


def chain(path: str | os.PathLike) -> list[Path]:
    """Return the files that a configuration consists of, the one that wins last.

    Raises:
        UserError: As `read_configuration`.
    """
    return _chain(Path(path), ())


def _chain(path: Path, above: tuple[Path, ...]) -> list[Path]:
    own = path.resolve()
    if own in above:
        names = " -> ".join(shown(file) for file in (*above[above.index(own) :], own))
        raise UserError(f"{BASE} leads in a circle: {names}")
    content = read_yaml(path)
    if BASE not in content:
        return [path]
    given = content[BASE]
    names = [given] if isinstance(given, str) else given
    line = f"{shown(path)}:{key_lines(path).get((BASE,), 1)}"
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise UserError(f"{line}: {BASE} = {given!r}: it must be the path or the name of a configuration, or a list of them")
    files: list[Path] = []
    for name in names:
        beside = path.parent / name
        base = beside if beside.is_file() else shipped(name)
        if base is None:
            raise UserError(f"{line}: {BASE} = {name!r}: no such file beside it, and no configuration of that name comes with neuido")
        files += _chain(base, (*above, own))
    return [*files, path]


def merged(base: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """Return two configurations as one, in which the second wins; a class takes its options with it."""
    if "class_path" in own and "class_path" in base and _name(own["class_path"]) != _name(base["class_path"]):
        return dict(own)
    content = dict(base)
    for key, value in own.items():
        before = content.get(key)
        content[key] = merged(before, value) if isinstance(before, Mapping) and isinstance(value, Mapping) else value
    return content


def _name(class_path: Any) -> str:
    return str(class_path).rpartition(".")[2]


def places(path: str | os.PathLike) -> dict[Keys, Place]:
    """Return where each key of a configuration stands, in the file itself or a base of it."""
    return {keys: Place(file, line) for file in chain(path) for keys, line in key_lines(file).items()}
