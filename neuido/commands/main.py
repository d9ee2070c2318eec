"""The `neuido` command, in two tiers.

Light commands are plain functions, imported by name and offered through jsonargparse: their `--help` costs no import of torch. The
commands of the Lightning trainer (`fit`, `validate`, `test`, `predict`) build a LightningCLI in subclass mode: YAML gives `class_path` and
`init_args` of the model and the data module.

Whatever the user can mend ends in one line on stderr and exit status 2. A fault of neuido itself is one line too, which names the file of
its traceback, and exit status 70. `NEUIDO_TRACEBACK=1` shows the traceback instead.
"""

import contextlib
import importlib
import inspect
import itertools
import json
import os
import signal
import sys
import tempfile
import traceback
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_origin

import neuido
from neuido.commands import interruption
from neuido.commands.config_files import find_config
from neuido.commands.console import quiet_lightning
from neuido.data.files.sweep_run import own_folder, redirect
from neuido.errors import UserError, one_line, shortened

if TYPE_CHECKING:
    from lightning.pytorch.cli import LightningArgumentParser, LightningCLI

LIGHT = {  # name: (module, function, one line for the list); the module must import torch only inside its functions
    "simulate": ("neuido.commands.simulate", "simulate", "Generate the trajectories of Stage I, or filmed scenes."),
    "reconstruct": ("neuido.commands.reconstruct", "reconstruct", "Gaussians and particles of a filmed body's first frame."),
    "diagnose": ("neuido.commands.diagnose", "diagnose", "Find the effect that a model lacks, from measured motion."),
    "sweep": ("neuido.commands.sweep", "sweep", "Run a wandb sweep file without a server, offline, into one CSV."),
    "report": ("neuido.commands.report", "report", "One page of several runs: tables, curves, videos side by side."),
    "latents": ("neuido.commands.latents", "latents", "How the latents of Stage I lie, and what lies between two of them."),
    "demo": ("neuido.commands.demo.demo", "demo", "Learn laws from bodies and from video, and find an effect that a model lacks."),
    "film": ("neuido.commands.film", "film", "Film simulated bodies of many materials, for the video encoder."),
    "doctor": ("neuido.commands.doctor", "doctor", "Print versions and devices, and run a small rollout on each device."),
}
HEAVY = {
    "fit": "Train a model.",
    "validate": "Run one validation epoch.",
    "test": "Run one test epoch.",
    "predict": "Run inference.",
}

MODULES = (  # so that their class names resolve without a path
    *(f"neuido.models.stages.{name}" for name in ("pretrain", "pretrain_vae", "warmup", "align", "adapt")),
    *(f"neuido.models.baselines.{name}" for name in ("known_law", "nclaw", "spring_gaus", "sparse_law", "stage_one_latents")),
    "neuido.models.fewshot.low_rank",
    "neuido.data.trajectories.trajectory_module",
    "neuido.data.scenes.clips",
    "neuido.data.scenes.filmed_scene_module",
    "neuido.discrepancy.diagnosed",
)


FAULT = 70
"""Exit status of a fault of neuido itself; EX_SOFTWARE of sysexits.h."""


def main(args: Sequence[str] | None = None) -> None:
    """Run the command line.

    Exits with 0 (done), 1 (a check failed), 2 (the user can mend it), 70 (a fault of neuido), or 128 + n (interrupted by signal n).

    Args:
        args: Arguments without the program's name; those of the process where absent.
    """
    status: Any = FAULT
    with interruption.watched():
        try:
            status = _dispatch(list(sys.argv[1:] if args is None else args))
            sys.stdout.flush()
        except KeyboardInterrupt:
            status = 128 + (interruption.received() or signal.SIGINT)
        except BrokenPipeError:  # as of `neuido ... | head`
            with contextlib.suppress(OSError, ValueError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            status = 128 + signal.SIGPIPE
        except SystemExit as stop:
            status = stop.code
            if not interruption.received():
                raise
        except Exception as error:
            if os.environ.get("NEUIDO_TRACEBACK"):
                raise
            line = one_line(error)
            _fail(*(_fault(error), FAULT) if line is None else (line, 2))
        number = interruption.received()
    if number or status == 128 + signal.SIGINT:
        number = number or signal.SIGINT
        _fail("interrupted" + (f" by {signal.Signals(number).name}" if number != signal.SIGINT else ""), 128 + number)
    sys.exit(status)


def _fault(error: Exception) -> str:
    """The line of an error that nobody foresaw; its traceback goes to a file."""
    text = "".join(traceback.format_exception(error))
    words = f"{sys.argv[0]} {' '.join(sys.argv[1:])}\nneuido {neuido.__version__}, Python {sys.version}\n"
    try:
        with tempfile.NamedTemporaryFile("w", prefix="neuido-", suffix=".log", delete=False, errors="backslashreplace") as file:
            file.write(words + text)
        where = f"the traceback is in {file.name}, which belongs in a report of this fault"
    except OSError:
        where = "NEUIDO_TRACEBACK=1 shows the traceback"
    return f"a fault of neuido itself: {shortened(f'{type(error).__name__}: {error}')[:160]}; {where}"


def _dispatch(args: list[str]) -> int:
    name = args[0] if args else "--help"
    if name in ("-h", "--help"):
        print(_help())
        return 0
    if name == "--version":
        print(f"neuido {neuido.__version__}")
        return 0
    if name not in LIGHT and name not in HEAVY:
        raise UserError(f"unknown command '{name}': use one of {', '.join([*HEAVY, *LIGHT])}")
    args = _find_configs(args)
    os.environ.setdefault("JSONARGPARSE_DEPRECATION_WARNINGS", "off")  # lightning's own calls, lightning issue 21900
    if name in LIGHT:
        return _run_light(name, args[1:])
    run_lightning(args)
    return 0


def _run_light(name: str, args: list[str]) -> int:
    from jsonargparse import auto_cli

    module, function, _ = LIGHT[name]
    component = getattr(importlib.import_module(module), function)
    first = next(iter(inspect.signature(component).parameters.values()))
    alone = list(itertools.takewhile(lambda word: not word.startswith("-"), args))  # the first parameter may stand alone
    if alone and get_origin(first.annotation) is list:
        args = [f"--{first.name}", json.dumps(alone), *args[len(alone) :]]
    elif alone:
        args = [f"--{first.name}", *args]
    status = auto_cli(component, args=args, as_positional=False, prog=f"neuido {name}", exit_on_error=False)
    return status if isinstance(status, int) else 0


def run_lightning(args: list[str]) -> "LightningCLI":
    """Run a command of the trainer; the model, the data module and the trainer are attributes of what it returns."""
    quiet_lightning()
    from lightning.pytorch import LightningDataModule, LightningModule
    from lightning.pytorch.cli import LightningCLI, SaveConfigCallback

    for module in MODULES:
        importlib.import_module(module)

    class NeuidoCLI(LightningCLI):
        def add_arguments_to_parser(self, parser: "LightningArgumentParser") -> None:
            parser.link_arguments("data.trajectory_count", "model.init_args.trajectory_count", apply_on="instantiate")

        def _parse_ckpt_path(self) -> None:  # Lightning reads the hyperparameters of the checkpoint here
            _check_checkpoint(self.config[self.config.subcommand].get("ckpt_path"))
            super()._parse_ckpt_path()

        def before_instantiate_classes(self) -> None:
            # Lightning loads a remote checkpoint with pickle unless told otherwise; here that takes an explicit `--weights_only false`.
            options = self.config[self.subcommand]
            if options.get("weights_only") is None:
                options["weights_only"] = True
            folder = own_folder(os.environ)
            if folder:
                redirect(options, folder)
                kept = folder / interruption.STATE
                if self.subcommand == "fit" and options.get("ckpt_path") is None and kept.is_file():  # a run of a sweep is taken up again
                    options["ckpt_path"] = str(kept)
            self.trainer_defaults["callbacks"] = [interruption.stop_at_step(folder and folder / interruption.STATE)]

    class BesideTheLog(SaveConfigCallback):
        def setup(self, trainer, pl_module, stage):  # without a log it would write into the current folder, and refuse to a second time
            if trainer.loggers:
                super().setup(trainer, pl_module, stage)

    parser = {"exit_on_error": False}  # raise argparse.ArgumentError instead of 100 lines of usage
    return NeuidoCLI(
        LightningModule,
        LightningDataModule,
        subclass_mode_model=True,
        subclass_mode_data=True,
        auto_configure_optimizers=False,
        seed_everything_default=0,
        save_config_callback=BesideTheLog,
        parser_kwargs={"prog": "neuido", "version": neuido.__version__, **parser, **{name: dict(parser) for name in HEAVY}},
        args=args,
    )


def _check_checkpoint(given: str | None) -> None:
    if given is None or given in ("best", "last", "hpc") or given.startswith("registry") or "://" in given:
        return
    if not Path(given).exists():
        raise UserError(f"ckpt_path = {given}: there is no such file")
    if Path(given).is_file() and not zipfile.is_zipfile(given):
        raise UserError(f"ckpt_path = {given} is not a checkpoint, or is cut short")


def _find_configs(args: list[str]) -> list[str]:
    found = list(args)
    for i, (before, argument) in enumerate(zip(["", *args], args, strict=False)):
        if before in ("-c", "--config"):
            found[i] = find_config(argument)
        elif argument.startswith("--config="):
            found[i] = "--config=" + find_config(argument.removeprefix("--config="))
    return found


def _help() -> str:
    table = HEAVY | {name: text for name, (*_, text) in LIGHT.items()}
    commands = "\n".join(f"  {name:<13}{text}" for name, text in table.items())
    return (
        f"usage: neuido [--help] [--version] COMMAND [--config FILE] [OPTIONS]\n\n{neuido.__doc__.splitlines()[0]}\n\n"
        f"commands:\n{commands}\n\n`neuido COMMAND --help` lists the options of a command; `--print_config` writes them as YAML."
    )


def _fail(line: str, status: int) -> None:
    print(f"neuido: {shortened(line)}", file=sys.stderr)
    sys.exit(status)
