"""The commands of the Lightning trainer (`fit`, `validate`, `test`, `predict`): a LightningCLI in subclass mode.

YAML gives `class_path` and `init_args` of the model and the data module.
"""

import contextlib
import functools
import importlib
import os
from argparse import ArgumentError
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import neuido
from neuido.commands.cli import interruption
from neuido.commands.cli.checkpoint_options import check_checkpoint, does_not_fit, numbers_of, stated_options, tell_differences
from neuido.commands.cli.config_files import expanded
from neuido.commands.cli.console import quiet_lightning
from neuido.commands.cli.mistakes import check_configurations
from neuido.commands.cli.plain_progress import needs_plain_lines, plain_progress
from neuido.commands.cli.signatures import MODULES
from neuido.commands.cli.trainer_help import HEAVY
from neuido.commands.cli.wrong_values import explained, placed, type_in_configuration
from neuido.data.files.output_folder import held_folder
from neuido.data.files.renamed_options import rename_in_arguments, rename_in_configuration
from neuido.data.files.sweep_run import own_folder, redirect
from neuido.data.files.writing import check_writable, made_folder
from neuido.errors import UserError, condensed

if TYPE_CHECKING:
    from lightning.pytorch import Trainer
    from lightning.pytorch.cli import LightningArgumentParser, LightningCLI

METRICS = 8
"""Number of metrics that a command shows in the end."""


def run_lightning(args: list[str]) -> "LightningCLI":
    """Run a command of the trainer; the model, the data module and the trainer are attributes of what it returns."""
    args = list(args)
    trust = "--trust" in args
    args = [word for word in args if word != "--trust"]
    check_configurations(args, trust=trust)
    quiet_lightning()
    try:
        return _run(args)
    except ArgumentError as error:
        raise UserError(explained(condensed(error), args, type_in_configuration(args))) from error
    except UserError as error:
        raise UserError(placed(str(error), args)) from error
    except Exception as error:
        if type(error).__module__.partition(".")[0] == "wandb":
            raise UserError(
                f"wandb: {str(error).splitlines()[0][:120]}; WANDB_MODE=offline needs no account (`wandb sync` sends the run later), "
                "`wandb login` logs in"
            ) from error
        raise


def _run(args: list[str]) -> "LightningCLI":
    words = rename_in_arguments(expanded(args), "model.method", MODULES)
    try:
        make = cast("Callable[..., LightningCLI]", _cli_class())  # it takes `given` as well
        return make(args=words, given=args, **_settings())
    except RuntimeError as error:
        if str(error).startswith("Error(s) in loading state_dict"):
            raise does_not_fit(error, args) from error
        raise


def trainer_parser() -> "LightningArgumentParser":
    """Return the parser of the trainer's commands, which are its subcommands."""
    quiet_lightning()

    class ParserAlone(_cli_class()):
        def parse_arguments(self, parser: "LightningArgumentParser", args: Any) -> None:
            raise _ParserIsMadeError(parser)

    try:
        ParserAlone(args=[], **_settings())
    except _ParserIsMadeError as made:
        return made.args[0]
    raise AssertionError("Lightning has read no arguments")


class _ParserIsMadeError(Exception):
    """Ends the construction of a LightningCLI once its parser is there."""


def _settings() -> dict[str, Any]:
    from lightning.pytorch import LightningDataModule, LightningModule

    parser = {"exit_on_error": False}  # raise argparse.ArgumentError instead of 100 lines of usage
    return {
        "model_class": LightningModule,
        "datamodule_class": LightningDataModule,
        "subclass_mode_model": True,
        "subclass_mode_data": True,
        "auto_configure_optimizers": False,
        "seed_everything_default": 0,
        "parser_kwargs": {"prog": "neuido", "version": neuido.__version__, **parser, **{name: dict(parser) for name in HEAVY}},
    }


@functools.cache
def _cli_class() -> type["LightningCLI"]:
    """Return the LightningCLI of neuido; the classes of neuido are imported, so that their names resolve without a path."""
    from lightning.pytorch.cli import LightningCLI, SaveConfigCallback

    for module in MODULES:
        importlib.import_module(module)
    _load_former_names()

    class BesideTheLog(SaveConfigCallback):
        def setup(self, trainer, pl_module, stage):  # without a log it would write into the current folder, and refuse to a second time
            if trainer.loggers:
                super().setup(trainer, pl_module, stage)

    class NeuidoCLI(LightningCLI):
        def __init__(self, given: Sequence[str] = (), **settings: Any):
            self.given = list(given)
            super().__init__(save_config_callback=BesideTheLog, **settings)

        def add_arguments_to_parser(self, parser: "LightningArgumentParser") -> None:
            parser.link_arguments("data.trajectory_count", "model.init_args.trajectory_count", apply_on="instantiate")

        def _parse_ckpt_path(self) -> None:  # Lightning reads the hyperparameters of the checkpoint here
            check_checkpoint(self.config[self.config.subcommand].get("ckpt_path"))
            options = self.config[self.config.subcommand]
            if options.get("ckpt_path") and Path(options["ckpt_path"]).is_file():
                numbers, stated = numbers_of(options["ckpt_path"], options.model.class_path), stated_options(self.given)
                tell_differences(options["ckpt_path"], numbers, options.model.init_args, stated)
                taken = {name: value for name, value in numbers.items() if name not in stated}
                model = {"class_path": options.model.class_path, "init_args": taken}
                self.config = self.parser.parse_object({self.config.subcommand: {"model": model}}, self.config)

        def instantiate_trainer(self, **options: Any) -> "Trainer":
            try:
                return super().instantiate_trainer(**options)
            except (ValueError, TypeError) as error:
                if isinstance(error, UserError):
                    raise
                raise UserError(f"trainer: {' '.join(str(error).split())}") from error

        def _run_subcommand(self, subcommand: str) -> None:
            with _held_results(self, subcommand):
                super()._run_subcommand(subcommand)
            if self.trainer.is_global_zero and interruption.received() is None and subcommand != "predict":  # which names each scene's
                print("\n".join(_summary(self, subcommand)))

        def before_instantiate_classes(self) -> None:
            # Lightning loads a remote checkpoint with pickle unless told otherwise; here that takes an explicit `--weights_only false`.
            options = self.config[self.config.subcommand]
            if options.get("weights_only") is None:
                options["weights_only"] = True
            folder = own_folder(os.environ)
            if folder:
                redirect(options, folder)
                kept = folder / interruption.STATE
                if self.subcommand == "fit" and options.get("ckpt_path") is None and kept.is_file():  # a run of a sweep is taken up again
                    options["ckpt_path"] = str(kept)
            self.trainer_defaults["callbacks"] = [interruption.stop_at_step(folder and folder / interruption.STATE)]
            if needs_plain_lines(options.trainer):
                self.trainer_defaults["callbacks"].append(plain_progress())

    return NeuidoCLI


def _results_folder(cli: "LightningCLI", command: str) -> Path | None:
    """Return the folder `out` of the model, if this command writes there."""
    return Path(cli.model.hparams["out"]) if command in getattr(cli.model, "commands_with_results", ()) else None


@contextlib.contextmanager
def _held_results(cli: "LightningCLI", command: str) -> Iterator[None]:
    """Hold the folder of the results while a command writes there, by the first process of several that train together."""
    folder = _results_folder(cli, command)
    if folder is None or not cli.trainer.is_global_zero:
        yield
        return
    check_writable(folder, "model.out")
    with made_folder(folder), held_folder(folder, option="model.out"):
        yield


def _summary(cli: "LightningCLI", command: str) -> list[str]:
    """Return the last metrics of a command, and where its results, log and checkpoint are."""
    trainer = cli.trainer
    metrics = [f"{name} {float(value):.4g}" for name, value in trainer.callback_metrics.items() if name.count("/") < 2]  # not of a scene
    more = f" and {len(metrics) - METRICS} more" if len(metrics) > METRICS else ""
    lines = [f"last metrics: {', '.join(metrics[:METRICS])}{more}"] if metrics else []
    saved = getattr(trainer.checkpoint_callback, "best_model_path", "") or getattr(trainer.checkpoint_callback, "last_model_path", "")
    weights, log = cli.model.hparams.get("save_to"), interruption.log_folder(trainer)
    places = {
        "tables and fits": _results_folder(cli, command),
        "weights": weights if command == "fit" and weights and Path(weights).exists() else None,
        "log": log if log and Path(log).exists() else None,
        "checkpoint": saved if command == "fit" and saved else None,
    }
    found = [(what, place) for what, place in places.items() if place]
    if not found:
        return [*lines, "no results are written: neither a logger nor a checkpoint is on"]
    (what, first), *others = found
    return [*lines, f"results in {first} ({what})" + "".join(f"; {what} in {place}" for what, place in others)]


@functools.cache  # once a process
def _load_former_names() -> None:
    """Let configuration files give options under their former names."""
    import yaml
    from jsonargparse import get_loader, set_loader

    load = get_loader("yaml")
    set_loader("yaml", lambda text: rename_in_configuration(load(text)), (yaml.YAMLError,))
