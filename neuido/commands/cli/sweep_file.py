"""Sweep files of wandb (docs.wandb.ai/guides/sweeps): what they say, the runs that they stand for, and the command of each run."""

import itertools
import json
import math
import os
import random
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from neuido.data.files.yaml_files import checking
from neuido.errors import UserError
from neuido.physics.runtime.limits import check_limit, limit

KEYS = ("program", "command", "method", "metric", "parameters", "name", "description", "project", "entity", "run_cap", "early_terminate")
SPECIFICATION = ("value", "values", "distribution", "min", "max", "q", "mu", "sigma", "probabilities")
RUNS = "NEUIDO_MAX_YAML_NODES"
"""The limit of the runs that a file stands for, as of the values that it expands to."""
COMMAND = ("${env}", "${interpreter}", "${program}", "${args}")
"""Of a file that gives none, as wandb has it."""
MACRO, VARIABLE = re.compile(r"\$\{(\w+)\}"), re.compile(r"\$\{envvar:([A-Z0-9_]*)\}")

Draw = Callable[[random.Random, Mapping[str, Any]], Any]


def _uniform(rng: random.Random, s: Mapping[str, Any]) -> float:
    return rng.uniform(s["min"], s["max"])


def _log_uniform_values(rng: random.Random, s: Mapping[str, Any]) -> float:
    return math.exp(rng.uniform(math.log(s["min"]), math.log(s["max"])))


def _stepped(draw: Draw) -> Draw:
    def stepped(rng: random.Random, s: Mapping[str, Any]) -> float:
        q = s.get("q", 1)
        return round(draw(rng, s) / q) * q

    return stepped


DISTRIBUTIONS: dict[str, tuple[tuple[str, ...], Draw]] = {  # name: (what it needs, how it is drawn)
    "constant": (("value",), lambda rng, s: s["value"]),
    "categorical": (("values",), lambda rng, s: rng.choices(s["values"], s.get("probabilities"))[0]),
    "int_uniform": (("min", "max"), lambda rng, s: rng.randint(s["min"], s["max"])),
    "uniform": (("min", "max"), _uniform),
    "q_uniform": (("min", "max"), _stepped(_uniform)),
    "log_uniform": (("min", "max"), lambda rng, s: math.exp(_uniform(rng, s))),
    "log_uniform_values": (("min", "max"), _log_uniform_values),
    "q_log_uniform_values": (("min", "max"), _stepped(_log_uniform_values)),
    "normal": ((), lambda rng, s: rng.gauss(s.get("mu", 0.0), s.get("sigma", 1.0))),
    "log_normal": ((), lambda rng, s: math.exp(rng.gauss(s.get("mu", 0.0), s.get("sigma", 1.0)))),
}


class Metric(NamedTuple):
    """What a sweep is judged by."""

    name: str
    maximise: bool = False


class SweepFile(NamedTuple):
    """A sweep."""

    name: str
    """The file's, without its ending."""
    method: str
    """`grid` or `random`."""
    command: tuple[str, ...]
    program: str
    leaves: dict[tuple[str, ...], dict[str, Any]]
    """The specification of each parameter by its path; a parameter that is not nested has a path of one name."""
    metric: Metric | None
    run_cap: int | None
    early_terminate: bool
    """Whether the file asks wandb's server to stop runs early, which nobody does here."""


def read_sweep(path: str | os.PathLike) -> SweepFile:
    """Read a sweep file.

    Raises:
        UserError: What cannot be run without a server, an unknown key, or a value of the wrong kind.
    """
    from neuido.data.files.parsing import read_yaml

    path = Path(path)
    content = read_yaml(path, plain=True)
    with checking(path):
        return _parse(content, path.stem)


def _parse(content: Any, name: str) -> SweepFile:
    content = _mapping(content, "the file")
    for key in content:
        if key not in KEYS:
            raise UserError(f"unknown key {key!r}; a sweep has {', '.join(KEYS)}")
    method = content.get("method")
    if method not in ("grid", "random"):
        more = "; bayes needs wandb's server: use `wandb sweep`" if method == "bayes" else ""
        raise UserError(f"method = {method!r}: choose grid or random{more}")
    program = content.get("program")
    command = content.get("command", list(COMMAND))
    if not isinstance(command, list) or not command or not all(isinstance(part, str | int | float) for part in command):
        raise UserError(f"command = {command!r}: it must be a list of words")
    command = tuple(str(part) for part in command)
    known = _macros({}, "")
    for part in command:
        macro = MACRO.fullmatch(part)
        if macro and macro[1] not in known:
            raise UserError(f"command has the unknown macro {part}; there are {', '.join(f'${{{key}}}' for key in known)}")
    if program is None and "${program}" in command:
        raise UserError("program is missing, and the command names it")
    run_cap = content.get("run_cap")
    if run_cap is not None and (not isinstance(run_cap, int) or run_cap < 1):
        raise UserError(f"run_cap = {run_cap!r}: it must be a whole number of at least 1")
    leaves = dict(_leaves(_mapping(content.get("parameters"), "parameters"), (), method))
    return SweepFile(
        name, method, command, str(program or ""), leaves, _metric(content.get("metric")), run_cap, "early_terminate" in content
    )


def _metric(given: Any) -> Metric | None:
    if given is None:
        return None
    given = _mapping(given, "metric")
    goal = given.get("goal", "minimize")
    if "name" not in given or goal not in ("minimize", "maximize"):
        raise UserError(f"metric = {given}: it needs a name, and minimize or maximize as its goal")
    return Metric(str(given["name"]), goal == "maximize")


def _leaves(parameters: dict[str, Any], path: tuple[str, ...], method: str) -> Iterator[tuple[tuple[str, ...], dict[str, Any]]]:
    for key, given in parameters.items():
        own = (*path, str(key))
        given = _mapping(given, f"parameter {'.'.join(own)}")
        if "parameters" in given:
            yield from _leaves(_mapping(given["parameters"], f"parameters of {'.'.join(own)}"), own, method)
        else:
            yield own, _checked(given, ".".join(own), method)


def _checked(given: dict[str, Any], name: str, method: str) -> dict[str, Any]:
    """Return a parameter with its distribution; where none is given, infer it from the keys as wandb does."""
    for key in given:
        if key not in SPECIFICATION:
            raise UserError(f"parameter {name} has the unknown key {key!r}; there are {', '.join(SPECIFICATION)}, parameters")
    whole = all(isinstance(given.get(key), int) for key in ("min", "max"))
    told = "constant" if "value" in given else "categorical" if "values" in given else "int_uniform" if whole else "uniform"
    distribution = given.get("distribution", told)
    if distribution not in DISTRIBUTIONS:
        raise UserError(f"parameter {name}: distribution = {distribution!r}; known are {', '.join(DISTRIBUTIONS)}")
    for key in DISTRIBUTIONS[distribution][0]:
        if key not in given:
            raise UserError(f"parameter {name} lacks {key} ({distribution}): give value, values, or min and max")
    _check_numbers(given, name, distribution)
    if distribution == "categorical" and (not isinstance(given["values"], list) or not given["values"]):
        raise UserError(f"parameter {name}: values = {given['values']!r} must be a list of at least one")
    odds = given.get("probabilities")
    if odds is not None and (not isinstance(odds, list) or len(odds) != len(given.get("values", []))):
        raise UserError(f"parameter {name}: probabilities = {odds!r} must have one number for each of values")
    if method == "grid" and distribution not in ("constant", "categorical", "int_uniform"):
        raise UserError(f"parameter {name}: a grid needs value, values or whole min and max, not {distribution}")
    return {**given, "distribution": distribution}


def _check_numbers(given: dict[str, Any], name: str, distribution: str) -> None:
    for key in ("min", "max", "q", "mu", "sigma"):
        value = given.get(key, 1)
        if isinstance(value, bool) or not isinstance(value, int | float):  # YAML reads 1e-4 as a word: it wants 1.0e-4
            raise UserError(f"parameter {name}: {key} = {value!r} must be a number")
    low, high = given.get("min", 1), given.get("max", 1)
    if "min" in given and "max" in given and low > high:
        raise UserError(f"parameter {name}: min = {low} is above max = {high}")
    if "log_uniform_values" in distribution and low <= 0:
        raise UserError(f"parameter {name}: min = {low} must be positive ({distribution})")
    if given.get("q", 1) <= 0:
        raise UserError(f"parameter {name}: q = {given['q']} must be positive")


def _mapping(given: Any, what: str) -> dict[str, Any]:
    if not isinstance(given, dict) or not given:
        raise UserError(f"{what} must be a mapping with at least one key, got {given!r}")
    return given


class Run(NamedTuple):
    """One run of a sweep."""

    name: str
    """The name of its folder, from its parameters."""
    parameters: dict[str, Any]
    """Values by dotted name, as a table has them."""
    arguments: dict[str, Any]
    """Values by name, nested as the file is: what the command line gets."""


def runs_of(sweep: SweepFile, *, count: int | None = None, seed: int = 0) -> list[Run]:
    """List the runs of a sweep, in an order that does not depend on the machine or the shard.

    Args:
        sweep: The file.
        count: How many: of a random sweep all, of a grid the first ones; `run_cap` of the file where absent.
        seed: Of a random sweep; each run depends on it and its number alone.

    Raises:
        UserError: A random sweep without a count.
    """
    count = sweep.run_cap if count is None else count
    paths = list(sweep.leaves)
    if sweep.method == "grid":
        most = min(limit(RUNS) + 1, count or limit(RUNS) + 1)  # the first runs of a grid take no more of the values of one parameter
        choices = [_choices(sweep.leaves[path], most) for path in paths]
        check_limit(min(math.prod(map(len, choices)), most), RUNS, "the grid of the sweep has too many runs")
        values = list(itertools.islice(itertools.product(*choices), count))
    elif count is None:
        raise UserError("a random sweep has no end: give --count, or run_cap in the file")
    else:
        check_limit(count, RUNS, f"the sweep has {count} runs")
        values = [_drawn(sweep, random.Random(f"{seed} {i}")) for i in range(count)]
    runs: list[Run] = []
    for i, row in enumerate(values):
        point = dict(zip(paths, row, strict=True))
        name = _name(point, sweep)
        name = f"{i:03d}-{name}" if sweep.method == "random" or any(run.name == name for run in runs) else name
        runs.append(Run(name, {".".join(path): value for path, value in point.items()}, _nested(point)))
    return runs


def _choices(specification: Mapping[str, Any], most: int) -> Sequence[Any]:
    if specification["distribution"] == "constant":
        return [specification["value"]]
    if specification["distribution"] == "categorical":
        return specification["values"]
    return range(specification["min"], min(specification["max"] + 1, specification["min"] + most))


def _drawn(sweep: SweepFile, rng: random.Random) -> list[Any]:
    return [DISTRIBUTIONS[own["distribution"]][1](rng, own) for own in sweep.leaves.values()]


def _nested(point: Mapping[tuple[str, ...], Any]) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for path, value in point.items():
        place = out
        for name in path[:-1]:
            place = place.setdefault(name, {})
        place[path[-1]] = value
    return out


def _name(point: Mapping[tuple[str, ...], Any], sweep: SweepFile) -> str:
    """Name a run by the values that vary, in characters that a folder and wandb accept."""
    varied = {path: v for path, v in point.items() if sweep.leaves[path]["distribution"] != "constant"} or point
    last = [".".join(path).rpartition(".")[2] for path in varied]
    words = []
    for path, short, value in zip(varied, last, varied.values(), strict=True):
        key = short if last.count(short) == 1 else ".".join(path)
        text = f"{value:.4g}" if isinstance(value, float) else str(value)
        words.append(f"{key}-{Path(text).stem if text.endswith(('.yaml', '.safetensors')) else text}")
    clean = re.sub(r"[^A-Za-z0-9_.+-]+", "-", "-".join(words)).strip("-.")
    return clean if len(clean) <= 100 else f"{clean[:80]}-{random.Random(clean).getrandbits(32):08x}"


def command_of(sweep: SweepFile, run: Run, environment: Mapping[str, str]) -> list[str]:
    """Build the command line of a run: the file's words with wandb's macros replaced as wandb's agent replaces them.

    Raises:
        UserError: A variable of the environment that is not set.
    """
    macros, words = _macros(run.arguments, sweep.program), []
    for part in sweep.command:
        macro = MACRO.fullmatch(part)
        if macro:
            words += macros[macro[1]]
            continue
        for variable in VARIABLE.findall(part):
            if variable not in environment:
                raise UserError(f"the command names the environment variable {variable}, which is not set")
        words.append(VARIABLE.sub(lambda found: environment[found[1]], part))
    return words


def _macros(arguments: Mapping[str, Any], program: str) -> dict[str, list[str]]:
    plain = {name: f"{name}={value}" for name, value in arguments.items()}
    said = [f"--{name}" if value is True else f"--{plain[name]}" for name, value in arguments.items() if value is not False]
    return {
        "env": ["/usr/bin/env"],
        "interpreter": [sys.executable],
        "program": [program],
        "args": [f"--{text}" for text in plain.values()],
        "args_no_equals": [word for name, value in arguments.items() for word in (f"--{name}", str(value))],
        "args_no_hyphens": list(plain.values()),
        "args_no_boolean_flags": said,
        "args_json": [json.dumps(arguments)],
        "args_append_hydra": [f"+{text}" for text in plain.values()],
        "args_override_hydra": [f"++{text}" for text in plain.values()],
    }
