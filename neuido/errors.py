"""`UserError`, for mistakes that a user can fix, and the conversion of any error to one line for the terminal.

The message of a `UserError` is one line: what is wrong, the value, and the option to change.
"""

import argparse
import difflib
import errno
import pickle
import re
from collections.abc import Iterable

LONGEST = 300
"""Largest number of characters of an error's line; a longer line loses its middle."""


class UserError(ValueError):
    """Bad input. The message is one printable line of at most `LONGEST` characters; the command line prints it and exits with status 2."""

    def __init__(self, message: str = "") -> None:
        super().__init__(shortened(message))


class PlausibilityWarning(UserWarning):
    """Measured data that are odd and may be right. The message is one line; the command line prints it."""


def suggest(word: str, known: Iterable[str], *, before: str = "", after: str = "") -> str:
    """Return `, did you mean '…'?` for the known word closest to one that is not known, or nothing where none is close.

    Args:
        word: The word that is not known.
        known: Those that are.
        before: What stands before the word where it is given, such as `--trainer.`.
        after: What stands after it.
    """
    close = difflib.get_close_matches(word, [str(each) for each in known], n=1, cutoff=0.6)
    return f", did you mean '{before}{close[0]}{after}'?" if close else ""


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether an error means that a device ran out of memory.

    torch reports it by three types of error, one of them a failed capture of a CUDA graph, and Warp by another.
    """
    return isinstance(error, RuntimeError) and any(words in str(error) for words in ("out of memory", "Failed to allocate"))


_NO_MEMORY = re.compile(r"can't allocate memory|bad_alloc|bad allocation|Unable to allocate|not enough memory", re.IGNORECASE)
_NOT_WRITTEN = re.compile(r"No space left on device|os error 28|PytorchStreamWriter failed|file write failed|\d+ requested and \d+ written")


def one_line(error: BaseException) -> str | None:
    """Return the line of at most `LONGEST` characters that a command prints; None for an error that only a programmer can fix."""
    line = _line_of(error)
    return None if line is None else shortened(line)


def shortened(text: str) -> str:
    """Return a text as one printable line without control characters, of at most `LONGEST` characters."""
    if len(text) > 100 * LONGEST:  # a value that fills memory would be looked at letter by letter
        text = text[: 50 * LONGEST] + text[-50 * LONGEST :]
    text = " ".join(text.split())
    text = "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 103]} ... {text[-98:]}"


def _line_of(error: BaseException) -> str | None:
    cause: BaseException | None = error
    seen: list[BaseException] = []
    while cause is not None and cause not in seen:  # jsonargparse wraps what a constructor raises; causes may form a circle
        if isinstance(cause, UserError):
            return str(cause)
        seen.append(cause)
        cause = cause.__cause__
    if isinstance(error, argparse.ArgumentError) or str(error).startswith("Does not validate against any of the Union subtypes"):
        return condensed(error)
    if isinstance(error, ValueError) and "embedded null" in str(error):
        return "a path holds a null character, which no name of a file may have: check the names in the options and files that were given"
    if isinstance(error, UnicodeEncodeError):
        return (
            f"a text that was given holds characters that cannot be written as {error.encoding}: {error.object[error.start : error.end]!r}"
        )
    if isinstance(error, OSError) and error.strerror is not None:
        own = [f"'{name}'" for name in (error.filename, error.filename2) if name is not None]
        what = f"{error.strerror}: {', '.join(own)}" if own else error.strerror
        full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        return f"{what}: what was being written is not there under its name; free some space, or give another out" if full else what
    if is_out_of_memory(error):
        return f"the device has no memory left ({str(error).splitlines()[0]}): end what else runs there, ask for less, or use the CPU"
    if isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and _NO_MEMORY.search(str(error))):
        detail = f" ({str(error).splitlines()[0][:120]})" if str(error) else ""
        return f"there is not enough memory{detail}: end what else runs here, or ask for less (fewer particles, cells, views or draws)"
    if _NOT_WRITTEN.search(str(error)):
        return "No space left on device: what was being written is not there under its name; free some space, or give another out"
    if isinstance(error, RuntimeError) and _LOST_PEER.search(str(error)):
        return "another process of this training has ended, and says why where it ran; --ckpt_path goes on from the last checkpoint"
    if isinstance(error, pickle.UnpicklingError):
        return "the checkpoint cannot be read weights-only: it is damaged, or holds objects that reading would execute"
    if isinstance(error, OSError) or type(error).__name__ == "MisconfigurationException":
        return str(error)
    return None


_LOST_PEER = re.compile(r"gloo.*(Connection closed|reset by peer|Broken pipe)|NCCL.*(remote process|peer)", re.DOTALL)

_NOISE = re.compile(  # lines of jsonargparse's messages without information for a user
    r"Does not validate|Subtypes:|Errors:|Given value type:|Given value: (Nest|Name|[{\[])|Expected a (<class 'None|path but)|$"
)


def condensed(error: Exception) -> str:
    """Return jsonargparse's indented message as one line: the key, the fault and the value."""
    lines = [line.strip().removeprefix("- ") for line in str(error).splitlines()]
    text = ": ".join(dict.fromkeys(line.rstrip(":") for line in lines if not _NOISE.match(line)))
    text = re.sub(r"Parser key \"([\w.]+)\"", r"--\1", text)
    text = re.sub(r"Problem with given class_path '(.+?)'", r"\1", text)
    text = re.sub(r"Expected a dot import path string: (\S+): Given value: .*", r"no class '\1' is known; give its import path", text)
    text = re.sub(r"Expected a <class '(\w+)'>", r"expected \1", text)
    text = re.sub(r"Expected a typing.Literal\[(.+?)\]", r"expected one of \1", text)
    text = re.sub(r"the following arguments are required: (\w+)", r"give --\1", text)
    return re.sub(r"(: Given|\. Got) value: ", ", got ", text)
