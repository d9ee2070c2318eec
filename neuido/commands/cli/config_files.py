"""Configurations by name: a file here, or one that comes with neuido; what a file builds on (`base`) is merged in."""

from pathlib import Path
from typing import Any

from neuido.data.files.yaml_files import chain, read_configuration, shipped
from neuido.errors import UserError
from neuido.installation import configs_root

OPTIONS = ("-c", "--config")


def find_config(name: str, option: str = "--config") -> str:
    """Return the path of a configuration: a file given by path, or one that comes with neuido, given by name."""
    if is_content(name) or Path(name).is_file():
        return name
    own = shipped(name)
    if own is None:
        raise UserError(f"no configuration file '{name}', neither here nor in {configs_root()}: change {option}")
    return str(own)


def find_configs(args: list[str]) -> list[str]:
    """Return the arguments with each `--config` resolved by `find_config`."""
    found = list(args)
    for i, given in given_configs(args):
        found[i] = in_place(args[i], find_config(given))
    return found


def given_configs(args: list[str]) -> list[tuple[int, str]]:
    """Return what each `--config` of a command line names, with the place of the argument that holds it."""
    found = []
    for i, (before, argument) in enumerate(zip(["", *args], args, strict=False)):
        if before in OPTIONS:
            found.append((i, argument))
        elif argument.startswith("--config="):
            found.append((i, argument.removeprefix("--config=")))
    return found


def config_paths(args: list[str]) -> list[str]:
    """Return the files that the `--config` of a command line name."""
    return [given for _, given in given_configs(args) if not is_content(given)]


def is_content(given: str) -> bool:
    """Return whether a word is the content of a configuration, which jsonargparse accepts in the place of a file."""
    return given.lstrip().startswith("{")


def in_place(argument: str, given: str) -> str:
    """Return an argument that holds a configuration (`--config=FILE`, or the word after `--config`) with another one in its place."""
    return f"--config={given}" if argument.startswith("--config=") else given


def expanded(args: list[str]) -> list[str]:
    """Replace each `--config` file that has a key `base` by its merged content; return the arguments."""
    found = list(args)
    for i, given in given_configs(args):
        if not is_content(given) and _is_yaml(given) and len(chain(given)) > 1:
            found[i] = in_place(args[i], inline(read_configuration(given)))
    return found


def _is_yaml(name: str) -> bool:
    return Path(name).is_file() and Path(name).suffix in (".yaml", ".yml", "")


def inline(content: dict[str, Any]) -> str:
    """Return a configuration as one line of YAML."""
    import yaml

    return yaml.safe_dump(content, default_flow_style=True, width=1 << 30, sort_keys=False, allow_unicode=True).strip()
