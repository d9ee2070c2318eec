"""The folder of a run of a sweep: which one this process writes into, and how far the run of a folder has come."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

FORMAT = "neuido-run/1"
FOLDER = "NEUIDO_RUN"
"""The environment variable that names the folder of a run, into which everything of it goes."""


def read_status(folder: Path) -> dict[str, Any]:
    """Return the content of a run's `run.json`; empty where there is none."""
    try:
        content = json.loads((folder / "run.json").read_text())
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) and content.get("format") == FORMAT else {}


def note(folder: Path, state: Mapping[str, Any]) -> None:
    """Write `run.json` of a run."""
    from neuido.data.files.storage import write

    write(folder / "run.json", json.dumps(state, indent=1) + "\n")


def own_folder(environment: Mapping[str, str]) -> Path | None:
    """Return the folder of this process where it is a run of a sweep, of this command or of wandb's agent."""
    if environment.get(FOLDER):
        return Path(environment[FOLDER])
    if environment.get("WANDB_SWEEP_ID") and environment.get("WANDB_RUN_ID"):
        return Path("runs/sweeps", environment["WANDB_SWEEP_ID"], environment["WANDB_RUN_ID"])
    return None


def redirect(options: Any, folder: Path) -> None:
    """Let a trainer's configuration write into a run's own folder: logs, checkpoints, `save_to` and `out` of the model.

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
