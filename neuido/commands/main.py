"""The `neuido` command, in two tiers.

Light commands are plain functions, imported by name and offered through jsonargparse: their `--help` costs no import of torch. The
commands of the Lightning trainer (`fit`, `validate`, `test`, `predict`) build a LightningCLI in subclass mode: YAML gives `class_path` and
`init_args` of the model and the data module.

Whatever the user can mend ends in one line on stderr and exit status 2. A fault of neuido itself is one line too, which names the file of
its traceback, and exit status 70. `NEUIDO_TRACEBACK=1` shows the traceback instead.
"""

import contextlib
import io
import os
import signal
import sys
import tempfile
import traceback
from collections.abc import Sequence
from typing import Any

import neuido
from neuido.commands.cli import interruption
from neuido.commands.cli.config_files import find_configs
from neuido.commands.cli.console import print_oddities
from neuido.commands.cli.functions import refuse_abbreviations, run_function
from neuido.commands.cli.trainer import run_lightning
from neuido.commands.cli.trainer_help import HEAVY, help_text, wants_help
from neuido.commands.simulation.former_options import current_command
from neuido.errors import UserError, one_line, shortened, suggest

LIGHT = {  # name: (module, function, one line for the list); the module must import torch only inside its functions
    "simulate": ("neuido.commands.simulation.simulate", "simulate", "Run a scene file and write its motion."),
    "trajectories": ("neuido.commands.simulation.trajectories", "trajectories", "Simulate the training data of Stage I."),
    "scenes": ("neuido.commands.simulation.scenes", "scenes", "Simulate bodies and film them from several views, with the truth beside."),
    "undeclared": ("neuido.commands.simulation.undeclared", "undeclared", "Make a folder to diagnose, with a sealed answer."),
    "replay": ("neuido.commands.simulation.replay", "replay", "Simulate the recordings of an experiment under a model."),
    "reconstruct": ("neuido.commands.reconstruct", "reconstruct", "Gaussians and particles of a filmed body's first frame."),
    "import": ("neuido.commands.import_data", "import_data", "Turn tables of a testing machine or a tracker into a folder to diagnose."),
    "check": ("neuido.commands.check", "check", "Say whether measured data are plausible."),
    "diagnose": ("neuido.commands.diagnose", "diagnose", "Find the effect that a model lacks, from measured motion."),
    "sweep": ("neuido.commands.sweep", "sweep", "Run a wandb sweep file without a server, offline, into one CSV."),
    "report": ("neuido.commands.report", "report", "One page of several runs: tables, curves, videos side by side."),
    "latents": ("neuido.commands.latents", "latents", "How the latents of Stage I lie, and what lies between two of them."),
    "demo": ("neuido.commands.demo.demo", "demo", "Learn laws from bodies and from video, and find an effect that a model lacks."),
    "view": ("neuido.commands.viewing.view", "view_path", "Open a motion, a recording or a diagnosis in the browser, or run a scene live."),
    "render": ("neuido.commands.viewing.render", "render_path", "Draw a motion to a video or pictures, without a display."),
    "film": ("neuido.commands.film", "film", "Film simulated bodies of many materials, for the video encoder."),
    "export": ("neuido.commands.output.export", "export_path", "Write a motion or a law for other programs: USD, glTF, VTK, C, ..."),
    "doctor": ("neuido.commands.doctor", "doctor", "Print versions and devices, and run a small rollout on each device."),
}


FAULT = 70
"""Exit status of a fault of neuido itself; EX_SOFTWARE of sysexits.h."""


def main(args: Sequence[str] | None = None) -> None:
    """Run the command line.

    Exits with 0 (done), 1 (a check failed), 2 (the user can mend it), 70 (a fault of neuido), or 128 + n (interrupted by signal n).

    Args:
        args: Arguments without the program's name; those of the process where absent.
    """
    status: Any = FAULT
    try:
        with interruption.watched():  # inside of the `try`, since a signal may come while it opens
            status = _run(list(sys.argv[1:] if args is None else args))
    except KeyboardInterrupt:
        status = 128 + (interruption.received() or signal.SIGINT)
    except BrokenPipeError:  # as of `neuido ... | head`
        _discard_output()
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


def _run(args: list[str]) -> int:
    """Run a command and write what it printed; a character that the terminal's encoding lacks is shown as a question mark."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    try:
        status = _dispatch(args)
    except SystemExit:  # of --help and --print_config
        _flush()
        raise
    _flush()
    return status


def _flush() -> None:
    """Write what was printed; where that fails, as on a full disk, nothing is left for the interpreter to try again at its end."""
    try:
        sys.stdout.flush()
    except OSError as error:
        _discard_output()
        if isinstance(error, BrokenPipeError):
            raise
        raise UserError(f"stdout cannot be written: {error.strerror}; results in files are whole") from error


def _discard_output() -> None:
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _fault(error: Exception) -> str:
    """Return one line for an unexpected error, and write its traceback to a file."""
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
    if name.partition("=")[0] == "--print_completion":
        from neuido.commands.completion import completion

        print(completion(name.partition("=")[2] or "".join(args[1:2]), LIGHT))
        return 0
    if name not in LIGHT and name not in HEAVY:
        known = [*HEAVY, *LIGHT]
        raise UserError(f"unknown command '{name}'{suggest(name, known) or ':'} The commands are {', '.join(known)}")
    args = find_configs(args)
    if name in HEAVY and wants_help(args):
        print(help_text(args))
        return 0
    os.environ.setdefault("JSONARGPARSE_DEPRECATION_WARNINGS", "off")  # lightning's own calls, lightning issue 21900
    refuse_abbreviations()
    if name in LIGHT:
        name, options = current_command(name, args[1:])
        module, function, _ = LIGHT[name]
        print_oddities()
        return run_function(name, module, function, options)
    run_lightning(args)
    return 0


def _help() -> str:
    table = HEAVY | {name: text for name, (*_, text) in LIGHT.items()}
    commands = "\n".join(f"  {name:<14}{text}" for name, text in table.items())
    return (
        "usage: neuido [--help] [--version] [--print_completion SHELL] COMMAND [--config FILE] [OPTIONS]\n\n"
        f"{(neuido.__doc__ or 'neuido').splitlines()[0]}\n\n"
        f"commands:\n{commands}\n\n`neuido COMMAND --help` lists the options of a command; `--print_config` writes them as YAML."
    )


def _fail(line: str, status: int) -> None:
    try:
        sys.stdout.flush()
    except (OSError, ValueError):  # what was printed before the error cannot be written either
        _discard_output()
    with contextlib.suppress(OSError):  # of a stderr that is closed
        print(f"neuido: {shortened(line)}", file=sys.stderr, flush=True)
    sys.exit(status)
