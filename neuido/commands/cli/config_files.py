"""Configurations by name: a file here, or one that comes with neuido."""

from pathlib import Path

from neuido import configs_root
from neuido.errors import UserError


def find_config(name: str, option: str = "--config") -> str:
    """Return the path of a configuration: a file given by path, or one that comes with neuido, given by name."""
    if name.lstrip().startswith("{") or Path(name).is_file():  # jsonargparse accepts the content itself too
        return name
    relative = name.removeprefix("configs/").removesuffix(".yaml") + ".yaml"
    for own in (configs_root() / relative, configs_root() / "scenes" / relative):
        if own.is_file():
            return str(own)
    raise UserError(f"no configuration file '{name}', neither here nor in {configs_root()}: change {option}")


def find_configs(args: list[str]) -> list[str]:
    """Return the arguments with each `--config` resolved by `find_config`."""
    found = list(args)
    for i, (before, argument) in enumerate(zip(["", *args], args, strict=False)):
        if before in ("-c", "--config"):
            found[i] = find_config(argument)
        elif argument.startswith("--config="):
            found[i] = "--config=" + find_config(argument.removeprefix("--config="))
    return found
