"""Options of earlier versions: what `neuido simulate` did beside scene files, which commands of their own do now.

A configuration file of those versions is taken as it is: its content reaches the command with the keys that this has today.
"""

import inspect
import json
import sys
from collections.abc import Callable
from dataclasses import asdict, fields
from typing import Any

import yaml

from neuido.commands.cli.config_files import given_configs, in_place, inline, is_content
from neuido.data.trajectories.options import Throw, make_trajectories
from neuido.errors import UserError
from neuido.installation import configs_root

THROW = tuple(field.name for field in fields(Throw))
COMMON = ("out", "device", "progress")
KNOWN = {  # command: its options, of those that `neuido simulate` had
    "trajectories": (*COMMON, "families", "instances", "held_out", "seed", "setup", *THROW, "shard", "shards", "batch"),
    "scenes": (*COMMON, "scenes", "film", "data_root"),
    "undeclared": (*COMMON, "undeclared", "case"),
    "replay": (*COMMON, "experiment", "model"),
}
SCENE_FILES = ("scene", "out", "law", "steps", "every", "data_root", "device", "progress")
"""Options of `neuido simulate` as it is."""
RENAMED: dict[str, Callable[[str], str]] = {
    "trajectories": lambda name: f"setup.{name}" if name in THROW else name,
    "scenes": lambda name: name,
    "undeclared": lambda name: "seed" if name == "undeclared" else name.removeprefix("case."),
    "replay": lambda name: "folder" if name == "experiment" else name,
}
"""Name of a former option -> its name today, by command."""


def current_command(name: str, args: list[str]) -> tuple[str, list[str]]:
    """Return the command and the arguments of today for those that are given; what is new in them is said in one line on stderr.

    Args:
        name: A command.
        args: Its arguments; configurations are files.

    Raises:
        UserError: Options of two former jobs of `neuido simulate` at once.
    """
    if name == "trajectories" and any(part in THROW for part in _given(args)):
        print("neuido: the options of the cube, its throw and the box are now called --setup.length, --setup.dt, ...", file=sys.stderr)
        return name, _renamed(args, name)
    if name != "simulate" or is_scene(args):
        return name, args
    given = {part.partition(".")[0] for part in _given(args)}
    former = {option for options in KNOWN.values() for option in options} - set(SCENE_FILES)
    if "scene" in given or not given & former:
        return name, args
    job = _job(given)
    print(f"neuido: `neuido simulate` for {JOBS[job]} is now called `neuido {job}`", file=sys.stderr)
    return job, _renamed(args, job)


JOBS = {
    "trajectories": "the trajectories of Stage I",
    "scenes": "filmed scenes",
    "undeclared": "a case with an undeclared effect",
    "replay": "the recordings of an experiment",
}


def is_scene(words: list[str]) -> bool:
    """Return whether the words after `neuido simulate` start with a scene, and not with the folder that earlier versions took there."""
    if not words or words[0].startswith("-"):
        return False
    given_out = any(word == "--out" or word.startswith("--out=") for word in words)
    return given_out or words[0].endswith((".yaml", ".yml")) or (configs_root() / "scenes" / f"{words[0]}.yaml").is_file()


def _job(given: set[str]) -> str:
    """Return the command that does what `neuido simulate` did with these options."""
    if "experiment" in given and given & {"scenes", "undeclared"}:
        raise UserError(f"experiment and {'scenes' if 'scenes' in given else 'undeclared'} are both given: leave one of the two out")
    if {"undeclared", "scenes"} <= given:
        raise UserError("undeclared and scenes are both given: leave one of the two out")
    if "model" in given and "experiment" not in given:
        raise UserError("model is for the recordings of an experiment: give experiment too")
    if "experiment" in given:
        return "replay"
    return next((name for name in ("undeclared", "scenes") if name in given), "trajectories")


def _given(args: list[str]) -> set[str]:
    """Return the names of options on a command line and in its configurations; an empty key of a configuration is none."""
    names = {word[2:].partition("=")[0] for word in args if word.startswith("--")}
    for _, content in _configurations(args):
        names |= {str(key) for key, value in content.items() if value is not None}
    return names


def _configurations(args: list[str]) -> list[tuple[int, dict[str, Any]]]:
    """Return place and content of each configuration on a command line; one that cannot be read is left to its parser."""
    from neuido.data.files.yaml_files import read_configuration

    found = []
    for i, given in given_configs(args):
        try:
            content = yaml.safe_load(given) if is_content(given) else read_configuration(given)
        except (UserError, OSError, yaml.YAMLError):
            continue
        if isinstance(content, dict):
            found.append((i, content))
    return found


def _renamed(args: list[str], command: str) -> list[str]:
    """Return arguments under the names of today; of a configuration only what is for the command."""
    out = [_word(word, RENAMED[command]) for word in args]
    others = {option for options in KNOWN.values() for option in options} - set(KNOWN[command])
    for i, content in _configurations(args):
        own: dict[str, Any] = {}
        for key, value in content.items():
            if value is None or (key in others and _unused(key, value)):
                continue
            if command == "undeclared" and key == "case":
                own |= value
            elif command == "trajectories" and key in THROW:
                own.setdefault("setup", {})[key] = value
            elif command == "trajectories" and key == "setup":
                own["setup"] = own.get("setup", {}) | value
            else:
                own[RENAMED[command](str(key))] = value
        out[i] = in_place(args[i], inline(own))
    return out


def _unused(key: str, value: Any) -> bool:
    """Return whether an option of another job may be left out: those of trajectories only where they have their default."""
    defaults = {name: p.default for name, p in inspect.signature(make_trajectories).parameters.items()} | asdict(Throw())
    return key not in defaults or json.dumps(value) == json.dumps(defaults[key])


def _word(word: str, rename: Callable[[str], str]) -> str:
    name, equals, value = word.removeprefix("--").partition("=")
    return f"--{rename(name)}{equals}{value}" if word.startswith("--") and name != "config" else word
