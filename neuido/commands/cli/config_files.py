"""Configurations by name: a file here, or one that comes with neuido; what a file builds on (`base`) is merged in."""

from pathlib import Path
from typing import Any

from neuido import configs_root
from neuido.data.files.yaml_files import chain, read_configuration, shipped
from neuido.errors import UserError

OPTIONS = ("-c", "--config")


def find_config(name: str, option: str = "--config") -> str:
    """Return the path of a configuration: a file given by path, or one that comes with neuido, given by name."""
    if name.lstrip().startswith("{") or Path(name).is_file():  # jsonargparse accepts the content itself too
        return name
    own = shipped(name)
    if own is None:
        raise UserError(f"no configuration file '{name}', neither here nor in {configs_root()}: change {option}")
    return str(own)


def find_configs(args: list[str]) -> list[str]:
    """Return the arguments with each `--config` resolved by `find_config`."""
    found = list(args)
    for i, given in given_configs(args):
        file = find_config(given)
        found[i] = f"--config={file}" if args[i].startswith("--config=") else file
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


def expanded(args: list[str]) -> list[str]:
    """Replace each `--config` file that has a key `base` by its merged content; return the arguments."""
    found = list(args)
    for i, given in given_configs(args):
        if not given.lstrip().startswith("{") and _is_yaml(given) and len(chain(given)) > 1:
            content = inline(read_configuration(given))
            found[i] = f"--config={content}" if args[i].startswith("--config=") else content
    return found


def _is_yaml(name: str) -> bool:
    return Path(name).is_file() and Path(name).suffix in (".yaml", ".yml", "")


def inline(content: dict[str, Any]) -> str:
    """Return a configuration as one line of YAML."""
    import yaml

    return yaml.safe_dump(content, default_flow_style=True, width=1 << 30, sort_keys=False, allow_unicode=True).strip()
