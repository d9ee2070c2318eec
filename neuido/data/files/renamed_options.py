"""Renamed options: constructors, functions, configuration files and command lines accept an old name and warn with the new one."""

import functools
import re
import warnings
from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypeVar

from neuido.errors import UserError

C = TypeVar("C", bound=type)
F = TypeVar("F", bound=Callable[..., Any])

RENAMED: dict[str, dict[str, str]] = {}
"""New name of an option, by import path of its class and old name."""


def renamed_options(**names: str) -> Callable[[C], C]:
    """Let the constructor of a class accept options under their old names too: `@renamed_options(old="new")`.

    The signature of the class, and so the help of the command line, shows the new names only.

    Args:
        names: New name of each option, by old name.
    """

    def decorate(owner: C) -> C:
        RENAMED[f"{owner.__module__}.{owner.__qualname__}"] = names
        construct = owner.__init__

        @functools.wraps(construct)
        def wrapper(self: Any, *args: Any, **options: Any) -> None:
            construct(self, *args, **rename(options, names, owner.__name__))

        owner.__init__ = wrapper
        return owner

    return decorate


def renamed_arguments(**names: str) -> Callable[[F], F]:
    """Let a function accept keyword arguments under their old names too: `@renamed_arguments(old="new")`.

    The signature of the function, and so the help of its command, shows the new names only.

    Args:
        names: New name of each argument, by old name.
    """

    def decorate(function: F) -> F:
        @functools.wraps(function)
        def wrapper(*args: Any, **options: Any) -> Any:
            return function(*args, **rename(options, names, function.__name__))

        wrapper.former_names = names  # type: ignore[attr-defined]
        return wrapper  # type: ignore[return-value]

    return decorate


def rename(options: Mapping[str, Any], names: Mapping[str, str], where: str) -> dict[str, Any]:
    """Rename options given under old names, with a warning for each.

    Args:
        options: Values by name.
        names: New name of each option, by old name.
        where: Prefix of an option in messages, such as the name of its class.

    Raises:
        UserError: An option is given under both names.
    """
    found = dict(options)
    for old in names.keys() & options.keys():
        new = names[old]
        if new in options:
            raise UserError(f"{where}.{old} is the former name of {where}.{new}, and both are given: remove {where}.{old}")
        warnings.warn(f"{where}.{old} is now called {where}.{new}", FutureWarning, stacklevel=3)
        found[new] = found.pop(old)
    return found


def rename_in_configuration(content: Any) -> Any:
    """Rename the options in each `init_args` of a configuration whose `class_path` names a class with renamed options."""
    if isinstance(content, list):
        return [rename_in_configuration(part) for part in content]
    if not isinstance(content, dict):
        return content
    content = {key: rename_in_configuration(part) for key, part in content.items()}
    path, options = content.get("class_path"), content.get("init_args")
    if isinstance(path, str) and isinstance(options, dict):
        for known, names in RENAMED.items():
            if path == known or path == known.rpartition(".")[2]:
                content["init_args"] = rename(options, names, path.rpartition(".")[2])
    return content


def rename_in_arguments(args: Iterable[str], prefix: str, modules: Iterable[str]) -> list[str]:
    """Rename the options of one argument's class on a command line, such as `--model.method.old 3`.

    Args:
        args: Arguments of the command line.
        prefix: The argument that takes the class, such as `model.method`.
        modules: Modules of the classes that it may be. The command line need not name the class; a configuration file may.
    """
    names = {old: new for path, own in RENAMED.items() if path.rpartition(".")[0] in modules for old, new in own.items()}
    pattern = re.compile(rf"--({re.escape(prefix)}(?:\.init_args)?)\.({'|'.join(names) or '(?!)'})(?==|$)")

    def replace(found: re.Match) -> str:
        where, old = found.groups()
        warnings.warn(f"--{where}.{old} is now called --{where}.{names[old]}", FutureWarning, stacklevel=3)
        return f"--{where}.{names[old]}"

    return [pattern.sub(replace, argument) if argument.startswith("--") else argument for argument in args]
