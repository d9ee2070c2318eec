"""The one error that a user can mend: raised with a single line that names what was wrong, the value, and the option to change."""

import argparse
import pickle
import re


class UserError(ValueError):
    """Bad input. The command line prints the message as one line and exits with status 2."""


def is_out_of_memory(error: BaseException) -> bool:
    """Whether a device had no memory: torch says so in three types of error, of which a failed capture of a CUDA graph is one, and Warp in
    another.
    """
    return isinstance(error, RuntimeError) and any(words in str(error) for words in ("out of memory", "Failed to allocate"))


def one_line(error: BaseException) -> str | None:
    """What a command prints of an error: one line, or None for an error that only a programmer can mend."""
    cause: BaseException | None = error
    while cause is not None:  # jsonargparse wraps what a constructor raises
        if isinstance(cause, UserError):
            return " ".join(str(cause).split())
        cause = cause.__cause__
    if isinstance(error, argparse.ArgumentError):
        return _condense(str(error))
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.strerror}: '{error.filename}'"
    if is_out_of_memory(error):
        return f"the device has no memory left ({str(error).splitlines()[0]}): end what else runs there, ask for less, or use the CPU"
    if isinstance(error, pickle.UnpicklingError):
        return "the checkpoint cannot be read weights-only: it is damaged, or holds objects that reading would execute"
    if isinstance(error, FileNotFoundError) or type(error).__name__ == "MisconfigurationException":
        return " ".join(str(error).split())
    return None


_NOISE = re.compile(  # the lines of jsonargparse's messages that tell a user nothing
    r"Does not validate|Subtypes:|Errors:|Given value type:|Given value: (Nest|Name|[{\[])|Expected a (<class 'None|path but)|$"
)


def _condense(message: str) -> str:
    """Keep of jsonargparse's indented message what names the key, the fault and the value."""
    lines = [line.strip().removeprefix("- ") for line in message.splitlines()]
    text = ": ".join(dict.fromkeys(line.rstrip(":") for line in lines if not _NOISE.match(line)))
    text = re.sub(r"Parser key \"([\w.]+)\"", r"--\1", text)
    text = re.sub(r"Problem with given class_path '(.+?)'", r"\1", text)
    text = re.sub(r"Expected a dot import path string: (\S+): Given value: .*", r"no class '\1' is known; give its import path", text)
    text = re.sub(r"Expected a <class '(\w+)'>", r"expected \1", text)
    text = re.sub(r"Expected a typing.Literal\[(.+?)\]", r"expected one of \1", text)
    text = re.sub(r"the following arguments are required: (\w+)", r"give --\1", text)
    return re.sub(r"(: Given|\. Got) value: ", ", got ", text)
