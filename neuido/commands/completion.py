"""Completion of commands and options in a shell: `neuido --print_completion bash`. It loads neither torch nor Lightning."""

import argparse
import importlib
from collections.abc import Iterator, Mapping

from neuido.commands.cli.functions import options_of
from neuido.commands.cli.signatures import TRAINER, Option, classes, signature
from neuido.commands.cli.trainer_help import BY_COMMAND, COMMON, HEAVY
from neuido.errors import UserError, suggest

SHELLS = ("bash", "zsh", "fish", "tcsh")
FILES = ("config", "ckpt_path", "model", "adapter", "lpips_backbone", "script", "scene", "file")
FOLDERS = ("out", "folder", "root", "data_root", "save_dir", "experiment", "runs")


def completion(shell: str, light: Mapping[str, tuple[str, str, str]]) -> str:
    """Return a script that completes the commands of neuido and their options in a shell.

    Args:
        shell: One of `SHELLS`.
        light: The commands that are functions: name -> (module, function, one line).

    Raises:
        UserError: A shell that is not known, or the extra `completion` is missing.
    """
    if shell not in SHELLS:
        raise UserError(f"--print_completion {shell}: not a known shell{suggest(shell, SHELLS) or ';'} choose from {', '.join(SHELLS)}")
    try:
        import shtab
    except ImportError as error:
        raise UserError("--print_completion needs the extra `completion`: pip install 'neuido[completion]'") from error
    parser = argparse.ArgumentParser(prog="neuido", description="The commands of neuido.")
    parser.add_argument("--version", action="store_true", help="print the version")
    parser.add_argument("--print_completion", choices=SHELLS, help="print a script that completes commands and options in a shell")
    commands = parser.add_subparsers(metavar="COMMAND")
    for name, line in HEAVY.items():
        _add(commands.add_parser(name, help=line, description=line), _of_trainer(name))
    for name, (module, function, line) in light.items():
        _add(commands.add_parser(name, help=line, description=line), _of_function(module, function))
    return shtab.complete(parser, shell=shell)


def _add(parser: argparse.ArgumentParser, options: Iterator[Option]) -> None:
    import shtab

    seen = set()
    for option in options:
        if option.name in seen:
            continue
        seen.add(option.name)
        action = parser.add_argument(f"--{option.name}", help=_plain(option.text), choices=option.choices or None)
        last = option.name.rpartition(".")[2]
        if not option.choices and (last in FILES or last.endswith(("_from", "_file"))):
            action.complete = shtab.FILE  # type: ignore[attr-defined]
        elif not option.choices and last in FOLDERS:
            action.complete = shtab.DIRECTORY  # type: ignore[attr-defined]
    words = parser.add_argument("words", nargs="*")
    words.complete = shtab.FILE  # type: ignore[attr-defined]


def _plain(text: str) -> str:
    """Return the first sentence of a text, without what a shell or argparse would read as its own."""
    first = text.partition(". ")[0].rstrip(".")
    return "".join(c for c in first if c not in "%`$\"'\\[]{}()|:;<>&!*").strip()[:90]


def _of_trainer(command: str) -> Iterator[Option]:
    for name, (_, text) in {**COMMON, **BY_COMMAND[command]}.items():
        yield Option(name.removeprefix("--"), "", None, text)
    for prefix, key in (("model", "model"), ("model.method", "method"), ("model.effects", "effects"), ("data", "data")):
        yield Option(prefix, "", None, f"the class of {prefix}", tuple(classes(key)))
        yield Option(f"{prefix}.help", "", None, "show the options of a class", tuple(classes(key)))
        for path in classes(key).values():
            found = signature(path)
            for option in found.options.values() if found else ():
                yield option._replace(name=f"{prefix}.{option.name}")
    found = signature(TRAINER)
    for option in found.options.values() if found else ():
        yield option._replace(name=f"trainer.{option.name}")


def _of_function(module: str, function: str) -> Iterator[Option]:
    yield Option("config", "", None, "YAML with the options, or the name of one that comes with neuido")
    yield Option("print_config", "", None, "write all options with their values as YAML, and end")
    found = signature(f"{module}.{function}")
    for name, inner in options_of(getattr(importlib.import_module(module), function)).items():
        own = found.options.get(name) if found else None
        yield own or Option(name, "", None, "")
        for below in inner:
            yield Option(f"{name}.{below}", "", None, "")
