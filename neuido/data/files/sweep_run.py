"""Folder and status of one run of a sweep."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from neuido.errors import UserError

FORMAT = "neuido-run/1"
FOLDER = "NEUIDO_RUN"
"""Environment variable with the folder that receives all files of a run."""
RUN_FILES = ("run.json", "log.txt", "wandb")
"""What a run has in its folder before its command writes there: status, output, and the logger's files."""


def read_status(folder: Path) -> dict[str, Any]:
    """Read `run.json` of a run; return an empty dictionary if it is missing or malformed."""
    from neuido.data.files.parsing import read_json

    try:
        content = read_json(folder / "run.json")
    except UserError:
        return {}
    whole = isinstance(content, dict) and content.get("format") == FORMAT and isinstance(content.get("parameters", {}), dict)
    return content if whole else {}


def write_status(folder: Path, state: Mapping[str, Any]) -> None:
    """Write the status of a run to `run.json` in its folder."""
    from neuido.data.files.writing import write_json

    write_json(folder / "run.json", state)


def own_folder(environment: Mapping[str, str]) -> Path | None:
    """Return the run folder of this process if `neuido sweep` or wandb's agent started it as a run of a sweep; None otherwise."""
    if environment.get(FOLDER):
        return Path(environment[FOLDER])
    if environment.get("WANDB_SWEEP_ID") and environment.get("WANDB_RUN_ID"):
        return Path("runs/sweeps", environment["WANDB_SWEEP_ID"], environment["WANDB_RUN_ID"])
    return None


def redirect(options: Any, folder: Path) -> None:
    """Redirect all output of a `neuido fit` configuration to the folder of a run: logs, checkpoints, and `save_to` and `out` of the model.

    Args:
        options: The parsed configuration of a subcommand, changed in place.
        folder: The folder of the run.
    """
    trainer = options["trainer"]
    trainer["default_root_dir"] = str(folder)
    loggers = trainer.get("logger")
    for logger in loggers if isinstance(loggers, list) else [loggers]:
        arguments = getattr(logger, "init_args", None)
        if arguments is not None and "save_dir" in arguments:
            arguments["save_dir"] = str(folder)
    arguments = options["model"]["init_args"]
    for name in ("save_to", "out"):
        if name in arguments and arguments[name] is not None:
            arguments[name] = str(folder / Path(arguments[name]).name)
