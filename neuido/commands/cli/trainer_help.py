"""The help of the trainer's commands, from the source text of the classes: it loads neither torch nor Lightning.

`neuido fit --help` lists the classes and the options of the trainer; with `--config FILE` it shows the options of that file's model, method
and data by group, with the values of the file. A test compares every name, default and class with the parser of jsonargparse.
"""

import textwrap
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from neuido.commands.cli.config_files import given_configs, is_content
from neuido.commands.cli.signatures import TRAINER, Option, Signature, as_class, classes, signature, signature_of, yaml_word
from neuido.data.files.yaml_files import merged, read_configuration
from neuido.errors import UserError, suggest

WIDTH, COLUMN = 120, 34
HEAVY = {
    "fit": "Train a model.",
    "validate": "Run one validation epoch.",
    "test": "Run one test epoch.",
    "predict": "Run inference.",
}

COMMON = {  # of every command: option -> (what it takes, what it does)
    "--config": ("FILE", "YAML with the options below, or the name of one that comes with neuido; of several the later wins (-c)"),
    "--print_config": ("", "write all options with their values as YAML, and end"),
    "--seed_everything": ("INT or true", "seed of all random numbers; true: another one each time (default: 0)"),
    "--ckpt_path": ("FILE", "checkpoint to go on from, or to test"),
    "--weights_only": ("true or false", "false: read the checkpoint with pickle, which may run what it holds (default: true)"),
    "--trust": ("", "let configuration files name classes outside neuido, lightning, torch.optim and torchmetrics"),
}
BY_COMMAND = {  # beside these: what Lightning gives one command
    "fit": {},
    "validate": {"--verbose": ("true or false", "print the results (default: true)")},
    "test": {"--verbose": ("true or false", "print the results (default: true)")},
    "predict": {"--return_predictions": ("true or false", "keep what was predicted in memory")},
}
SLOTS = {"model": ("method", "effects"), "data": ()}
"""The keys that take a class: those at the top, and those among the options of their class."""


def wants_help(args: list[str]) -> bool:
    """Return whether a command line of the trainer asks for help that this module gives."""
    return _asked(args) is not None


def _asked(args: list[str]) -> tuple[str, str] | None:
    """Return the key whose help is asked for, `""` for the command's own, and the class that is named."""
    for i, word in enumerate(args[1:], 1):
        if word in ("-h", "--help"):
            return "", ""
        name, _, value = word.partition("=")
        if name in ("--model.help", "--data.help", "--model.method.help", "--model.init_args.method.help", "--model.effects.help"):
            after = args[i + 1] if i + 1 < len(args) and not args[i + 1].startswith("-") else ""
            return name.removesuffix(".help").rpartition(".")[2].removeprefix("--"), value or after
        if name == "--trainer.help":
            return "trainer", ""
    return None


def help_text(args: list[str]) -> str:
    """Return the help that a command line of the trainer asks for.

    Raises:
        UserError: A class that is not known, or a configuration that cannot be read.
    """
    command = args[0]
    key, name = _asked(args) or ("", "")
    if key == "trainer":
        return "\n".join(_trainer({}))
    if key:
        return _help_of_class(key, name, command)
    content = given_content(args)
    lines = [f"usage: neuido {command} --config FILE [--config FILE ...] [--OPTION VALUE ...]", "", HEAVY[command], ""]
    lines += ["common options:", *_rows((name, *words) for name, words in {**COMMON, **BY_COMMAND[command]}.items()), ""]
    chosen = [key for key in SLOTS if isinstance(content.get(key), Mapping) and "class_path" in content[key]]
    for key in SLOTS:
        lines += _group(key, content[key]) if key in chosen else _choices(key)
    lines += [*_trainer(content.get("trainer") or {}), ""]
    if not chosen:
        lines += [
            f"`neuido {command} --config FILE --help` shows the options of that file's model, method and data with their values;",
            f"`neuido {command} --model.help CLASS` those of a class. A later --config wins over an earlier one, an option over both.",
        ]
    else:
        lines += ["Values are those of the configuration; what it leaves out has the default."]
    return "\n".join(lines)


def given_content(args: list[str]) -> dict[str, Any]:
    """Return what the configurations and the classes of a command line say together."""
    content: dict[str, Any] = {}
    for _, given in given_configs(args):
        own = _inline(given) if is_content(given) else read_configuration(given)
        content = merged(content, own)
    for i, word in enumerate(args):
        name, equals, value = word.partition("=")
        value = value if equals else args[i + 1] if i + 1 < len(args) else ""
        path = {"--model": ("model",), "--data": ("data",), "--model.method": ("model", "method")}.get(name.removesuffix(".class_path"))
        if path is None or is_content(value) or "/" in value:
            continue
        own = {"class_path": value}
        content = merged(content, {"model": {"init_args": {"method": own}}} if len(path) == 2 else {path[0]: own})
    return content


def _inline(text: str) -> dict[str, Any]:
    import yaml

    try:
        content = yaml.safe_load(text)
    except yaml.YAMLError:
        return {}
    return content if isinstance(content, dict) else {}


def _choices(key: str) -> list[str]:
    """Return the lines that name the classes of a key, and those of the keys that their options take."""
    lines = [f"{key} (--{key} CLASS; --{key}.help CLASS shows its options):", *_classes(key), ""]
    if key == "model":
        lines += ["methods of AdaptModule (--model.method CLASS; --model.method.help CLASS shows its options):", *_classes("method"), ""]
    return lines


def _classes(key: str) -> list[str]:
    return list(_rows((name, "", found.summary) for name, path in classes(key).items() if (found := signature(path))))


def _group(key: str, given: Mapping[str, Any], prefix: str = "") -> list[str]:
    """Return the lines of a class that a configuration names: its options, with the values of the configuration."""
    name = str(given["class_path"])
    options = f"{prefix}.{key}" if prefix else key
    found = signature_of(key, name)
    if found is None:
        return [f"{options}: {name}, a class that is not part of neuido; its options are known when it is imported", ""]
    values = given.get("init_args") or {}
    lines = [f"{options}: {found.path.rpartition('.')[2]}. {found.summary}", *_options(found, f"--{options}", values, key), ""]
    for slot in SLOTS.get(key, ()) if not prefix else ():
        below = as_class(values.get(slot))
        if isinstance(below, Mapping) and "class_path" in below:
            lines += _group(slot, below, options)
    return lines


def _help_of_class(key: str, name: str, command: str) -> str:
    where = f"model.{key}" if key in SLOTS["model"] else key
    if not name:
        return "\n".join([f"classes that --{where} takes (--{where}.help CLASS shows the options of one):", *_classes(key)])
    found = signature_of(key, name)
    if found is None:
        raise UserError(f"--{where}.help {name}: no such class{suggest(name, classes(key)) or ';'} there are {', '.join(classes(key))}")
    return "\n".join([f"{found.path}", "", found.summary, "", f"options of `neuido {command}`:", *_options(found, f"--{where}", {}, key)])


LINKED = ("trajectory_count",)
"""Options that the command itself fills in, from the data."""


def _options(found: Signature, prefix: str, values: Mapping[str, Any], key: str) -> Iterator[str]:
    shown = (option for option in found.options.values() if not (key == "model" and option.name in LINKED))
    return _rows((f"{prefix}.{option.name}", "", _described(option, values)) for option in shown)


def _described(option: Option, values: Mapping[str, Any]) -> str:
    text = option.text if not option.text or option.text.endswith((".", "?")) else f"{option.text}."
    parts = [option.type] if option.type else []
    if option.name in values:
        given = values[option.name]
        word = str(given["class_path"]) if isinstance(given, Mapping) and "class_path" in given else yaml_word(given)
        parts.append(f"here: {textwrap.shorten(word, 60, placeholder=' ...')}")
    parts.append("must be given" if option.default is None else f"default: {option.default!s}" if option.default else "default: ''")
    return f"{text} ({'; '.join(parts)})".strip()


def _trainer(values: Mapping[str, Any]) -> Iterator[str]:
    yield "trainer:"
    found = signature(TRAINER)
    if found is None:
        yield "  Lightning's source is not found; its documentation lists the options"
        return
    rows = []
    for option in found.options.values():
        first = _plain(option.text).split(". ")[0].rstrip(".")
        rows.append((f"--trainer.{option.name}", "", _described(option._replace(text=first), values)))
    yield from _rows(rows)


def _plain(text: str) -> str:
    return text.replace("``", "").partition(" Default:")[0]


def _rows(rows: Iterable[tuple[str, str, str]]) -> Iterator[str]:
    """Yield lines of a table: option and what it takes, and what it does, wrapped."""
    for name, takes, text in rows:
        head = f"  {name} {takes}".rstrip()
        body = textwrap.wrap(_plain(text) if takes else text, WIDTH - COLUMN) or [""]
        if len(head) < COLUMN - 1:
            yield f"{head:<{COLUMN}}{body[0]}"
        else:
            yield head
            body = ["", *body]
        yield from (f"{'':<{COLUMN}}{line}" for line in body[1:])
