"""What is wrong with the configuration of a trainer's command: unknown keys, options and classes, with file, line and what was meant.

The check reads source text (`signatures`), so that a mistake is answered before torch is imported.
"""

import re
from collections.abc import Iterable, Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

from neuido.commands.cli.config_files import config_paths, is_content
from neuido.commands.cli.signatures import BASES, TRAINER, Signature, as_class, classes, names_of, signature, signature_of
from neuido.commands.cli.trainer_help import BY_COMMAND, COMMON, LINKED, given_content
from neuido.data.files.yaml_files import BASE, Keys, chain, dotted, key_lines, merged, read_yaml, shown
from neuido.errors import UserError, suggest

INNER = ("class_path", "init_args", "dict_kwargs")
TRUSTED = ("neuido", "lightning", "pytorch_lightning", "torch.optim", "torchmetrics")
"""The packages whose classes a configuration file may name."""
PACKAGES = {  # where the trainer finds a class by its name alone
    "callbacks": "lightning.pytorch.callbacks",
    "logger": "lightning.pytorch.loggers",
    "strategy": "lightning.pytorch.strategies",
    "accelerator": "lightning.pytorch.accelerators",
    "profiler": "lightning.pytorch.profilers",
    "plugins": "lightning.pytorch.plugins",
}


NAMED = ("callbacks", "logger")
"""Those of them whose text is the name of a class; the others have names of their own, such as `ddp`."""


class _File(NamedTuple):
    """A configuration file with what decides the classes of its options."""

    path: Path
    content: Mapping[str, Any]
    context: Mapping[str, Any]

    def place(self, keys: Keys) -> str:
        return _place(self.path, keys)


def _place(path: Path, keys: Keys) -> str:
    """Return file and line of a key, or of the nearest one above it that has a line."""
    lines = key_lines(path)
    while keys and keys not in lines:
        keys = keys[:-1]
    return f"{shown(path)}:{lines[keys]}" if keys else shown(path)


def check_configurations(args: list[str], *, trust: bool = False) -> None:
    """Check the configurations and the options of a command line of the trainer.

    Args:
        args: The command and its options; configurations are paths of files.
        trust: Whether configurations may name classes outside `TRUSTED`.

    Raises:
        UserError: The first mistake, in one line.
    """
    command, everything = args[0], given_content(args)
    for given in config_paths(args):
        context: dict[str, Any] = {}
        for file in chain(given):
            own = {key: value for key, value in read_yaml(file).items() if key != BASE}
            context = merged(context, own)
            if not trust:
                check_trust(file, own)
            _check_file(_File(file, own, merged(everything, context)), command)
    _check_words(args, everything, trust=trust)
    if not any(word.partition("=")[0] == "--print_config" for word in args):
        _check_needs(args, everything)
        _check_loggers(args, everything)


def _top(command: str) -> list[str]:
    return [name.removeprefix("--") for name in (*COMMON, *BY_COMMAND[command]) if name not in ("--config", "--print_config", "--trust")]


def _check_file(file: _File, command: str) -> None:
    known = ["model", "data", "trainer", *_top(command)]
    others = ("verbose", "return_predictions")  # of another command, as a file that serves several may have
    for key, value in file.content.items():
        if key not in known and key not in others:
            raise UserError(
                f"{file.place((key,))}: the key '{key}' is not known{suggest(str(key), known) or ';'} there are {', '.join(known)}"
            )
        if key == "trainer":
            _check_trainer(file, value)
        elif key in BASES and value is not None:
            if isinstance(value, str) and value.endswith((".yaml", ".yml")):
                raise UserError(f"{file.place((key,))}: {key} = {value} is a file: give `base: {value}`, or its content")
            _check_class(file, (key,), key, value, file.context.get(key))


def _check_trainer(file: _File, given: Any) -> None:
    if not isinstance(given, Mapping):
        raise UserError(f"{file.place(('trainer',))}: trainer must be a mapping of options to values, got {given!r}")
    found = signature(TRAINER)
    for key, value in given.items():
        if found is not None and key not in found.options:
            raise UserError(
                f"{file.place(('trainer', key))}: trainer.{key} is no option of the trainer"
                f"{suggest(str(key), found.options) or ';'} `neuido fit --help` lists them"
            )
        before = (file.context.get("trainer") or {}).get(key)
        for keys, part in (
            [(("trainer", key, i), part) for i, part in enumerate(value)] if isinstance(value, list) else [(("trainer", key), value)]
        ):
            if isinstance(part, str) and key in NAMED:
                resolve(key, part, file.place(keys), dotted(keys))
            elif isinstance(part, Mapping) and set(part) & set(INNER):
                _check_class(file, keys, key, part, before if len(keys) == 2 else part)


def _check_class(file: _File, keys: Keys, key: str, given: Any, context: Any) -> None:
    """Check what a file says of a key that takes a class."""
    where = dotted(keys)
    given = as_class(given)
    if not isinstance(given, Mapping):
        raise UserError(f"{file.place(keys)}: {where} = {given!r} must be a class: class_path with its name, and init_args")
    context = as_class(context) if isinstance(context, str | Mapping) else {}
    if "class_path" in given or "class_path" in context:
        for part in given:
            if part not in INNER:
                raise UserError(
                    f"{file.place((*keys, part))}: the key '{part}' of {where} is not known{suggest(str(part), INNER) or ';'} "
                    "a class has class_path and init_args"
                )
    name = given.get("class_path", context.get("class_path"))
    if name is None:
        return
    found = resolve(key, str(name), file.place((*keys, "class_path")), f"{where}.class_path")
    options = given.get("init_args")
    if options is None or found is None:
        return
    if not isinstance(options, Mapping):
        raise UserError(f"{file.place((*keys, 'init_args'))}: {where}.init_args must be a mapping of options to values, got {options!r}")
    before = context.get("init_args") or {}
    for option, value in options.items():
        own = (*keys, "init_args", option)
        if option not in found.options and option not in found.former and not found.open:
            raise UserError(f"{file.place(own)}: {dotted(own)} is no option of {_short(name)}{_hint(option, found, key)}")
        below = option if option in BASES else ""
        if below and value is not None:
            _check_class(file, own, below, value, before.get(option) if isinstance(before, Mapping) else None)
        elif isinstance(value, Mapping) and "class_path" in value:
            _check_class(file, own, str(option), value, value)


def check_trust(path: Path, content: Any, keys: Keys = ()) -> None:
    """Refuse each class of a configuration file that lies outside `TRUSTED`, at any depth.

    Raises:
        UserError: Such a class, with file and line.
    """
    if isinstance(content, list):
        for i, part in enumerate(content):
            if isinstance(part, str) and _is_import(str(keys[-1]) if keys else "", part):
                _check_name(path, str(keys[-1]), part, (*keys, i))
            check_trust(path, part, (*keys, i))
    if not isinstance(content, Mapping):
        return
    for key, value in content.items():
        if key == "class_path" and isinstance(value, str):
            _check_name(path, str(keys[-1]) if keys else "", value, (*keys, key))
        elif isinstance(value, str) and _is_import(str(key), value):
            _check_name(path, str(key), value, (*keys, key))
        check_trust(path, value, (*keys, key))


def _is_import(key: str, value: str) -> bool:
    """Return whether a text is read as the import path of a class or a function, and not as text."""
    dotted_path = re.fullmatch(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)+", value) is not None
    dotted_path = dotted_path and not value.endswith((".yaml", ".yml"))
    return dotted_path and (key in BASES or key in PACKAGES or key.startswith(("on_", "fn", "func")) or key.endswith(("_fn", "_func")))


def _check_name(path: Path, key: str, name: str, keys: Keys) -> None:
    found = signature_of(key, name)
    inside = "." not in name or any(name.startswith(f"{package}.") for package in TRUSTED)
    if not inside or (found is not None and not any(found.path.startswith(f"{package}.") for package in (*TRUSTED, "torch"))):
        raise UserError(
            f"{_place(path, keys)}: {dotted(keys)} = {name} is of neither neuido, lightning, torch.optim nor torchmetrics: reading it "
            "runs its module; give --trust if you trust this file"
        )


def resolve(key: str, name: str, place: str, where: str) -> Signature | None:
    """Return what a class takes; None where only its import can say it.

    Raises:
        UserError: No class of that name, of those whose source is found.
    """
    if "." not in name:
        known = classes(key) if key in BASES else dict.fromkeys(names_of(PACKAGES[key])) if key in PACKAGES else {}
        path = classes(key).get(name) if key in BASES else f"{PACKAGES[key]}.{name}" if name in known else None
        if path is None and known:
            more = f" there are {', '.join(known)};" if key in BASES and not suggest(name, known) else ""
            close = suggest(name, known) or ";"
            own = "one of your own needs its import path"
            raise UserError(f"{place}: {_is(where, name)}: no class of that name{close}{more} {own}")
        return signature(path) if path else None
    found = signature(name)
    module, _, last = name.rpartition(".")
    own = names_of(module) if found is None else []
    if own and last not in own:
        raise UserError(f"{place}: {_is(where, name)}: {module} has no class {last}{suggest(last, own)}")
    return found


def _is(where: str, name: str) -> str:
    return f"{where} = {name}" if where else name


def _hint(option: Any, found: Signature, key: str) -> str:
    """Return the end of an error about an unknown option: what was meant, and where all of them are listed."""
    close = suggest(str(option), found.options) or ";"
    if key in BASES:
        return f"{close} `neuido fit --{_flag(key)}.help {_short(found.path)}` lists them"
    return f"{close} it takes {', '.join(found.options)}"


def _flag(key: str) -> str:
    """Return the option of the command line that takes a class."""
    return f"model.{key}" if key in ("method", "effects") else key


def _short(name: Any) -> str:
    return str(name).rpartition(".")[2]


# the command line


def _check_words(args: list[str], content: Mapping[str, Any], *, trust: bool) -> None:
    """Check the names of the options of a command line, and of the classes that they give."""
    known = ["c", "config", "print_config", "h", "help", "model", "data", "trainer", *_top(args[0])]
    for name, value in given_options(args):
        first, *rest = name.removesuffix("+").split(".")
        if name.endswith(".help"):
            continue
        if first not in known:
            raise UserError(f"--{name} is no option of neuido {args[0]}{_meant(first, rest, known)} `neuido {args[0]} --help` lists them")
        if first == "trainer" and rest and (found := signature(TRAINER)) and rest[0] not in found.options:
            hint = _meant(rest[0], rest[1:], found.options, "--trainer.")
            raise UserError(f"--{name} is no option of the trainer{hint} `neuido fit --help` lists them")
        if value is None and first not in ("h", "help", "print_config"):
            raise UserError(f"--{name} needs a value")
        if first in ("trainer", "model", "data") and value and not trust and Path(value).is_file():
            if not _takes_text(rest, first, content.get(first)):
                check_trust(Path(value), read_yaml(Path(value)))
        if first == "trainer" and rest and rest[0] in NAMED and value and rest[1:] in ([], ["class_path"]):
            if re.fullmatch(r"[A-Za-z_][\w.]*", value) and value not in ("true", "false", "null"):
                resolve(rest[0], value, f"--{name}", "")
        if first in BASES:
            _check_word(name, rest, first, content.get(first), value or "")


def _takes_text(rest: list[str], key: str, given: Any) -> bool:
    """Return whether `--model.method.init_from` and the like is text or a path: a file named there is no configuration."""
    rest = rest[1:] if rest[:1] == ["init_args"] else rest
    given = as_class(given)
    class_path = str(given.get("class_path")) if isinstance(given, Mapping) else ""
    found = signature(TRAINER) if key == "trainer" else signature_of(key, class_path)
    if not rest or found is None:
        return False
    if rest[0] in BASES:
        return _takes_text(rest[1:], rest[0], (given.get("init_args") or {}).get(rest[0]))
    return len(rest) == 1 and rest[0] in found.options and found.options[rest[0]].type.removesuffix(" or null") in ("text", "path")


def given_options(args: list[str]) -> Iterator[tuple[str, str | None]]:
    """Yield the name and the value of each option of a command line.

    Raises:
        UserError: A word that belongs to no option.
    """
    waiting = ""
    for word in args[1:]:
        if word.startswith("--") or word in ("-c", "-h"):
            if waiting:
                yield waiting, None
            name, equals, value = word.lstrip("-").partition("=")
            waiting = "" if equals else name
            if equals:
                yield name, value
            continue
        if not waiting:
            raise UserError(f"{word!r} belongs to no option: options of neuido {args[0]} begin with --")
        yield waiting, word
        waiting = ""
    if waiting:
        yield waiting, None


def _meant(word: str, rest: list[str], known: Iterable[str], prefix: str = "--") -> str:
    return suggest(word, known, before=prefix, after="".join(f".{part}" for part in rest)) or ";"


def _check_word(name: str, rest: list[str], key: str, given: Any, value: str) -> None:
    """Check `--model.method.rank`, whose class the configurations or the command line give."""
    if not rest or rest == ["class_path"]:
        if value and not is_content(value) and not Path(value).is_file() and value != "null":
            resolve(key, value, f"--{name}", "")
        return
    rest = rest[1:] if rest[0] == "init_args" else rest
    given = as_class(given)
    if not rest or rest[0] == "dict_kwargs" or not isinstance(given, Mapping) or "class_path" not in given:
        return
    class_path = str(given["class_path"])
    found = signature_of(key, class_path)
    if found is None:
        return
    if rest[0] not in found.options and rest[0] not in found.former and not found.open:
        before = name[: len(name) - len(".".join(rest))]
        hint = _meant(rest[0], rest[1:], found.options, f"--{before}")
        where = f"--{_flag(key)}.help {_short(class_path)}"
        raise UserError(f"--{name}: {rest[0]} is no option of {_short(class_path)}{hint} `neuido fit {where}` lists them")
    if rest[0] in BASES:
        _check_word(name, rest[1:], rest[0], (given.get("init_args") or {}).get(rest[0]), value)


def _check_needs(args: list[str], content: Mapping[str, Any]) -> None:
    """Refuse a command line that lacks the model, the data, or an option without a default."""
    words = {word[2:].partition("=")[0] for word in args if word.startswith("--")}
    lacking = [key for key in ("model", "data") if not content.get(key) and not any(w == key or w.startswith(f"{key}.") for w in words)]
    if lacking:
        what = " and ".join({"model": "model", "data": "data module"}[key] for key in lacking)
        given = " and ".join(f"--{key} CLASS" for key in lacking)
        raise UserError(f"neuido {args[0]} needs a {what}: give --config FILE, such as quickstart, or {given}")
    for keys, key, given in _slots(content):
        class_path = str(given.get("class_path"))
        found = signature_of(key, class_path)
        options = given.get("init_args") or {}
        for option in found.options.values() if found is not None and not found.open else ():
            dotted_name = f"{keys}.{option.name}"
            told = any(
                re.fullmatch(rf"{re.escape(keys)}(\.init_args)?\.{option.name}([.+].*)?", w.replace(".init_args", "")) for w in words
            )
            if (
                option.default is None
                and option.name not in LINKED
                and not told
                and (not isinstance(options, Mapping) or options.get(option.name) is None)
            ):
                raise UserError(f"{_short(class_path)} needs {dotted_name}: {option.text} Give it in a configuration or by --{dotted_name}")
    model, data = content.get("model"), content.get("data")
    if isinstance(model, Mapping) and isinstance(data, Mapping):
        _check_pair(str(model.get("class_path")), str(data.get("class_path")))


def _check_loggers(args: list[str], content: Mapping[str, Any]) -> None:
    """Refuse a logger whose package is not installed."""
    given = (content.get("trainer") or {}).get("logger")
    parts = given if isinstance(given, list) else [given]
    names = [str(part.get("class_path") if isinstance(part, Mapping) else part) for part in parts]
    names = [value or "" for name, value in given_options(args) if name in ("trainer.logger", "trainer.logger.class_path")] or names
    if any(_short(name) == "TensorBoardLogger" for name in names) and not any(find_spec(p) for p in ("tensorboard", "tensorboardX")):
        raise UserError("trainer.logger = TensorBoardLogger needs the extra `tensorboard`: pip install 'neuido[tensorboard]'")


def _slots(content: Mapping[str, Any]) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    for key in ("model", "data"):
        given = as_class(content.get(key))
        if isinstance(given, Mapping) and "class_path" in given:
            yield key, key, given
            options = given.get("init_args") or {}
            method = options.get("method") if isinstance(options, Mapping) else None
            if isinstance(method, Mapping) and "class_path" in method:
                yield f"{key}.method", "method", method


def _check_pair(model: str, data: str) -> None:
    """Refuse a model of Stage I without a data module that counts its trajectories."""
    wanted, given = (signature_of(key, name) for key, name in (("model", model), ("data", data)))
    if wanted is None or given is None or not set(LINKED) & set(wanted.options) or given.open:
        return
    if not given.path.startswith("neuido.") or given.path == classes("data").get("TrajectoryDataModule"):
        return
    raise UserError(
        f"model = {_short(model)} learns from trajectories, and data = {_short(data)} has none: give --data TrajectoryDataModule"
    )
