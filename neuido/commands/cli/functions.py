"""Commands that are plain functions, offered through jsonargparse."""

import dataclasses
import importlib
import inspect
import itertools
import json
import re
from argparse import ArgumentError
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, get_args, get_origin

from neuido.commands.cli.config_files import config_paths, expanded, given_configs, in_place, inline, is_content
from neuido.commands.cli.signatures import signature
from neuido.commands.cli.wrong_values import explained, placed
from neuido.data.files.renamed_options import rename
from neuido.data.files.yaml_files import Keys, places, read_configuration
from neuido.errors import UserError, condensed, suggest

ALWAYS = ("config", "print_config", "help", "c", "h")


def refuse_abbreviations() -> None:
    """Let every parser of jsonargparse take only whole names of options, the parsers of Lightning's commands included."""
    from jsonargparse import ArgumentParser

    ArgumentParser._get_option_tuples = lambda self, option_string: []  # argparse asks it for the options that begin with a word


def run_function(name: str, module: str, function: str, args: list[str]) -> int:
    """Run a function of a module as a command and return its exit status."""
    from jsonargparse import auto_cli

    component = getattr(importlib.import_module(module), function)
    first = next(iter(inspect.signature(component).parameters.values()))
    alone = list(itertools.takewhile(lambda word: not word.startswith("-"), args))  # the first parameter may stand alone
    if alone and list in (get_origin(first.annotation), *map(get_origin, get_args(first.annotation))):
        args = [f"--{first.name}", json.dumps(alone), *args[len(alone) :]]
    elif alone:
        args = [f"--{first.name}", *args]
    args = _under_new_names(name, component, args)
    _check(name, component, args)
    try:
        status = auto_cli(component, args=expanded(args), as_positional=False, prog=f"neuido {name}", exit_on_error=False)
    except ArgumentError as error:
        raise UserError(_told(error, name, f"{module}.{function}", args)) from error
    except UserError as error:
        raise UserError(placed(str(error), args)) from error
    return status if isinstance(status, int) else 0


def _under_new_names(command: str, component: Callable[..., Any], args: list[str]) -> list[str]:
    """Return the arguments with the options that the function renamed under their new names, with a warning for each."""
    names: dict[str, str] = getattr(component, "former_names", {})
    out = list(args)
    for i, word in enumerate(args):
        option, equals, value = word.removeprefix("--").partition("=")
        if word.startswith("--") and option in names:
            out[i] = f"--{next(iter(rename({option: value}, names, command)))}{equals}{value}"
    for i, given in given_configs(args):
        if names and not is_content(given) and Path(given).is_file():
            content = read_configuration(given)
            if names.keys() & content.keys():
                out[i] = in_place(args[i], inline(rename(content, names, command)))
    return out


def options_of(component: Callable[..., Any]) -> dict[str, dict[str, Any]]:
    """Return the options of a function, each with those below it: the fields of an argument that is a dataclass."""
    found = {}
    for name, parameter in inspect.signature(component).parameters.items():
        inner = parameter.annotation
        found[name] = {field.name: {} for field in dataclasses.fields(inner)} if dataclasses.is_dataclass(inner) else {}
    return found


def _check(command: str, component: Callable[..., Any], args: list[str]) -> None:
    """Refuse a key or an option that a command does not have, with what was meant."""
    known = options_of(component)
    for given in config_paths(args):
        if not Path(given).is_file():
            continue
        for key, value in read_configuration(given).items():
            if key not in known:
                raise _unknown(f"{_place(given, (key,))}the key '{key}'", key, known, command)
            if known[key] and not isinstance(value, dict):
                raise UserError(f"{_place(given, (key,))}{key} must be a mapping of {', '.join(known[key])}, got {value!r}")
            for below in value if known[key] else ():
                if below not in known[key]:
                    raise _unknown(f"{_place(given, (key, below))}the key '{key}.{below}'", below, known[key], command, f"{key}.")
    for word in args:
        if not re.match(r"--\w", word):
            continue
        first, *rest = word[2:].partition("=")[0].removesuffix("+").split(".")
        if first not in known and first not in ALWAYS:
            raise _unknown(f"--{first}", first, known, command)
        if rest and known.get(first) and rest[0] not in known[first]:
            raise _unknown(f"--{first}.{rest[0]}", rest[0], known[first], command, f"{first}.")


def _unknown(given: str, word: str, known: Iterable[str], command: str, prefix: str = "") -> UserError:
    close = suggest(str(word), known, before=prefix)
    return UserError(f"{given} is no option of neuido {command}{close or ':'} `neuido {command} --help` lists them")


def _place(given: str, keys: Keys) -> str:
    found = places(given).get(keys)
    return f"{found}: " if found else ""


def _told(error: ArgumentError, command: str, path: str, args: list[str]) -> str:
    """Return the line about a value, an option or a word that the parser refuses."""
    message = condensed(error)
    if found := re.search(r"unrecognized arguments: (.*)", message):
        return f"{found[1]!r} belongs to no option: options of neuido {command} begin with --"
    if found := re.search(r"argument (\S+): expected one argument", message):
        return f"{found[1].rpartition('/')[2]} needs a value"
    if found := re.fullmatch(r"give --([\w., ]+)", message):
        return f"neuido {command} needs {', '.join(f'--{name}' for name in found[1].split(', '))}"

    def type_of(name: str) -> tuple[str, Keys]:
        own = signature(path)
        option = own.options.get(name) if own else None
        return option.type if option else "", tuple(name.split("."))

    return explained(message, args, type_of)
