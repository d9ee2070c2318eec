"""The options that a checkpoint brings along: numbers alone, and only where the user states nothing else."""

import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from neuido.commands.cli.mistakes import given_options
from neuido.commands.cli.trainer_help import LINKED, given_content
from neuido.commands.cli.wrong_values import value_place
from neuido.data.files.parsing import is_zip
from neuido.errors import UserError


def numbers_of(checkpoint: str, class_path: str) -> dict[str, Any]:
    """Return the hyperparameters of a checkpoint that are numbers. What could be a path, a module or a class comes from the user alone.

    Raises:
        UserError: The checkpoint is of another class.
    """
    import torch

    try:
        found = torch.load(checkpoint, weights_only=True, map_location="cpu")
    except Exception as error:  # torch names no one type for a file that is malformed or not safe
        raise UserError(
            f"ckpt_path = {checkpoint} cannot be read weights-only: it is damaged, or holds objects that reading would execute"
        ) from error
    found = found.get("hyper_parameters") if isinstance(found, dict) else None
    if not isinstance(found, dict):
        return {}
    name = found.get("_class_path", class_path)
    if str(name).rpartition(".")[2] != class_path.rpartition(".")[2]:
        raise UserError(f"ckpt_path = {checkpoint} is a checkpoint of {str(name)[:80]!r}, and the model is {class_path}")
    return {key: value for key, value in found.items() if isinstance(key, str) and isinstance(value, int | float) and key not in LINKED}


def stated_options(args: list[str]) -> dict[str, str]:
    """Return the options of the model that configurations or the command line state, with the place of each."""
    model = given_content(args).get("model")
    options = model.get("init_args") if isinstance(model, Mapping) else None
    found = {str(name): value_place(("model", "init_args", name), args).removesuffix(": ") for name in options or ()}
    words = (re.match(r"--model\.(?:init_args\.)?(\w+)(?=[=.+]|$)", word) for word in args)
    return found | {word[1]: f"--model.{word[1]}" for word in words if word}


def tell_differences(checkpoint: str, numbers: Mapping[str, Any], options: Any, stated: Mapping[str, str]) -> None:
    """Say in one line on stderr where a checkpoint and what the user states disagree: the user's is taken."""
    own = {name: options.get(name) for name in numbers if name in stated}
    differing = [f"{name} = {own[name]} ({stated[name]}), not {numbers[name]}" for name in own if own[name] != numbers[name]]
    if differing:
        print(f"neuido: not as in ckpt_path = {checkpoint}: {'; '.join(differing)}", file=sys.stderr)


def does_not_fit(error: RuntimeError, args: list[str]) -> UserError:
    """Return the error of a checkpoint whose arrays have other shapes than those of the model."""
    lines = [line.strip() for line in str(error).splitlines()[1:] if line.strip()]
    given = next((value for name, value in given_options(args) if name == "ckpt_path"), "")
    first = lines[0].removesuffix(".") if lines else str(error)
    return UserError(
        f"ckpt_path = {given} does not fit the model: {first}; give the model's options as the checkpoint has them, or leave them out, "
        "so that those of the checkpoint are taken"
    )


def check_checkpoint(given: str | None) -> None:
    if given is None or given in ("best", "last", "hpc") or given.startswith("registry") or "://" in given:
        return
    if not Path(given).exists():
        raise UserError(f"ckpt_path = {given}: there is no such file")
    if not Path(given).is_dir() and not is_zip(given):
        raise UserError(f"ckpt_path = {given} is not a checkpoint, or is cut short")
