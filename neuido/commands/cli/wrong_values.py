"""The line about a value of a wrong type: where it stands, its key, and what it must be."""

import re
from collections.abc import Callable, Mapping

from neuido.commands.cli.config_files import config_paths
from neuido.commands.cli.signatures import TRAINER, as_class, signature, signature_of
from neuido.commands.cli.trainer_help import given_content
from neuido.data.files.yaml_files import Keys, places


def explained(message: str, args: list[str], type_of: Callable[[str], tuple[str, Keys]]) -> str:
    """Return the line about a value that the parser refuses.

    Args:
        message: The parser's message, condensed to one line.
        args: The options of the command line; configurations are paths of files.
        type_of: Gives the type of an option as a user reads it, and the keys under which a configuration has it.
    """
    if found := re.search(r"Subcommand '(\w+)' does not accept option '([\w.]+)'", message):
        return f"{found[2]} is no option of neuido {found[1]}; `neuido {found[1]} --help` lists them"
    keys = re.findall(r"(?:^|: )--([\w.]+)(?=:)", message)
    if not keys or "xpected" not in message:
        return message
    name = ".".join(keys)
    own, full = type_of(name)
    told = re.search(r"expected (one of '[^']*'(?:, '[^']*')*|\w+(?=, got|$))", message)
    simple = told and message.count("xpected") == 1 and (told[1].startswith("one of ") or " or " not in own)
    wanted = told[1] if told and simple else own
    got = re.search(r", got (.*)$", message)
    place = value_place(full, args)
    if not wanted:
        return f"{place}{message}"
    return f"{place}--{name}: expected {wanted}" + (f", got {got[1]}" if got else "")


def type_in_configuration(args: list[str]) -> Callable[[str], tuple[str, Keys]]:
    """Return what `explained` needs for a command of the trainer."""
    content = given_content(args)

    def type_of(name: str) -> tuple[str, Keys]:
        first, *rest = name.split(".")
        if first == "trainer" and rest:
            found = signature(TRAINER)
            option = found.options.get(rest[0]) if found else None
            return (option.type if option else ""), (first, *rest)
        keys: list[str | int] = [first]
        key, given, text = first, content.get(first), ""
        for part in (part for part in rest if part != "init_args"):
            given = as_class(given)
            class_path = str(given.get("class_path", "")) if isinstance(given, Mapping) else ""
            found = signature_of(key, class_path)
            option = found.options.get(part) if found else None
            text = option.type if option else ""
            keys += ["init_args", part]
            below = given.get("init_args") if isinstance(given, Mapping) else None
            key, given = part, below.get(part) if isinstance(below, Mapping) else None
        return text, tuple(keys)

    return type_of


def value_place(keys: Keys, args: list[str]) -> str:
    """Return `FILE:LINE: ` of the configuration that a key's value comes from; empty where the command line gives it."""
    plain = ".".join(str(key) for key in keys if key != "init_args")
    for word in args:
        if word.startswith("--") and word[2:].partition("=")[0].replace(".init_args", "") == plain:
            return ""
    for given in reversed(config_paths(args)):
        found = places(given)
        if keys in found:
            return f"{found[keys]}: "
    return ""


def placed(message: str, args: list[str]) -> str:
    """Return an error about an option, which its message opens with, with the file and line that the option comes from."""
    opening = re.match(r"(?:--)?([A-Za-z_]\w*(?:\.\w+)*)(?:\[\d+\])?(?=( = |: | must | has | holds | lacks | needs ))", message)
    if opening is None:
        return message
    plain = tuple(part for part in opening[1].split(".") if part != "init_args")
    for given in reversed(config_paths(args)):
        for keys in places(given):
            if tuple(key for key in keys if key != "init_args") == plain:
                return f"{value_place(keys, args)}{message}"
    return message
