"""Commands that are plain functions, offered through jsonargparse."""

import importlib
import inspect
import itertools
import json
import re
from argparse import ArgumentError
from typing import get_origin

from neuido.commands.cli.config_files import expanded
from neuido.commands.cli.suggestions import suggest
from neuido.errors import UserError


def run_function(name: str, module: str, function: str, args: list[str]) -> int:
    """Run a function of a module as a command and return its exit status."""
    from jsonargparse import auto_cli

    component = getattr(importlib.import_module(module), function)
    first = next(iter(inspect.signature(component).parameters.values()))
    alone = list(itertools.takewhile(lambda word: not word.startswith("-"), args))  # the first parameter may stand alone
    if alone and get_origin(first.annotation) is list:
        args = [f"--{first.name}", json.dumps(alone), *args[len(alone) :]]
    elif alone:
        args = [f"--{first.name}", *args]
    try:
        status = auto_cli(component, args=expanded(args), as_positional=False, prog=f"neuido {name}", exit_on_error=False)
    except ArgumentError as error:
        explained = _explained(error, name, list(inspect.signature(component).parameters))
        if explained is error:
            raise
        raise explained from error
    return status if isinstance(status, int) else 0


def _explained(error: ArgumentError, command: str, known: list[str]) -> Exception:
    """Return an error that names the option that was meant, where the fault is the name of an option or a key; else the error itself."""
    found = re.search(r"unrecognized arguments: --([\w-]+)|Option '([\w-]+)' is not accepted", " ".join(str(error).split()))
    if found is None:
        return error
    wrong = found[1] or found[2]
    given = f"--{wrong}" if found[1] else f"the key '{wrong}'"
    return UserError(f"{given} is no option of neuido {command}{suggest(wrong, known) or ':'} `neuido {command} --help` lists them")
