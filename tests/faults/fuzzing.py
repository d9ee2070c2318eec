"""What a reader may do with a damaged file: return a result, or raise a `UserError` of one line that names the file. Nothing else.

`python -m tests.faults.fuzzing NAME [NUMBER]` repeats one input of a reader with its traceback, or all of them with a count of each fault.
"""

import collections
import contextlib
import gc
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from neuido.errors import LONGEST, UserError
from tests.faults.mutations import mutated

SECONDS, BYTES = 60.0, 4 << 30
"""The most that an input may take which is refused in the end."""


class Reader(NamedTuple):
    """A reader of the package, and a sample that it takes."""

    name: str
    make: Callable[[Path], object]
    """Writes the sample into a new folder."""
    files: str
    """Pattern of the files that are damaged, relative to the folder."""
    read: Callable[[Path], object]
    """Of the folder."""
    count: int = 10_000
    """Inputs of the slow tier: fewer where one costs milliseconds."""
    quick: int = 16
    """Inputs of the fast tier."""


class Fault(NamedTuple):
    """An input with a forbidden outcome."""

    number: int
    kind: str
    """Of the mutation."""
    what: str


class Hang(BaseException):
    """An input took longer than it may."""


_written: list[str] | None = None
_allowed = ""


def _watch(event: str, args: tuple) -> None:
    """Note what is written, removed or started outside of the folder that is allowed."""
    if _written is None:
        return
    if event == "open":
        path, _, flags = args
        if not isinstance(path, str | bytes) or not flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND):
            return
        paths = [path]
    elif event in ("os.mkdir", "os.remove", "os.rmdir", "os.truncate", "os.chmod"):
        paths = [] if event in ("os.remove", "os.rmdir", "os.mkdir") and args[-1] not in (-1, None) else [args[0]]  # below an open folder
    elif event in ("os.rename", "os.link", "os.symlink"):
        paths = list(args[:2])
    elif event in ("subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "socket.connect", "pickle.find_class"):
        _written.append(f"{event} {args[:2]}")
        return
    else:
        return
    for path in paths:
        path = os.fsdecode(path) if isinstance(path, str | bytes | os.PathLike) else ""
        if path and path != os.devnull and not os.path.abspath(path).startswith(_allowed) and "__pycache__" not in path:
            _written.append(f"{event} {path}")


@contextlib.contextmanager
def watched(folder: Path) -> Iterator[list[str]]:
    """Give a list of what is written outside of a folder, of processes that are started and connections that are made."""
    global _written, _allowed
    if not getattr(sys, "_neuido_watch", False):
        sys.addaudithook(_watch)  # for good: a hook cannot be removed
        sys._neuido_watch = True  # type: ignore[attr-defined]
    found: list[str] = []
    before = tempfile.tempdir
    tempfile.tempdir = str(folder)
    _written, _allowed = found, str(folder)
    try:
        yield found
    finally:
        _written, tempfile.tempdir = None, before


@contextlib.contextmanager
def limited(seconds: float = SECONDS, size: int = BYTES) -> Iterator[None]:
    """Raise `Hang` after some seconds, and MemoryError where the process grows by more than so many bytes."""

    def stop(*_: Any) -> None:
        raise Hang

    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    before = signal.signal(signal.SIGALRM, stop)
    resource.setrlimit(resource.RLIMIT_AS, (now + size, hard))
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        signal.signal(signal.SIGALRM, before)


def fault_of(read: Callable[[Path], object], folder: Path, names: list[str]) -> str | None:
    """Read a folder, and return what is wrong with the outcome.

    Args:
        read: The reader.
        folder: The sample with a damaged file.
        names: Names of which an error must hold one.
    """
    with watched(folder) as written:
        try:
            read(folder)
            said = None
        except UserError as error:
            said = str(error)
        except Hang:
            return "hangs"
        except (Exception, SystemExit, KeyboardInterrupt) as error:
            place = traceback.extract_tb(error.__traceback__)
            own = next((f for f in reversed(place) if "/neuido/" in f.filename), place[-1])
            return f"{type(error).__name__} at {own.filename.rpartition('neuido/')[2]}:{own.lineno}: {str(error)[:120]}"
    if written:
        return f"writes outside or acts: {written[:3]}"
    if said is None:
        return None
    if "\n" in said or not said.isprintable():
        return f"error of several lines or with control characters: {said[:200]!r}"
    if len(said) > LONGEST:
        return f"error of {len(said)} characters: {said[:150]!r}"
    if "more memory than there is" in said or "not enough memory" in said:
        return f"takes the memory and is refused: {said[:150]}"
    if not any(name in said for name in names):
        return f"error without the name of a file: {said[:250]!r}"
    return None


SWAPS = ("missing", "empty", "folder", "dangling link", "circular link", "pipe", "device", "outside link")


def swap(file: Path, how: str) -> None:
    """Put something else in the place of a file."""
    content = file.read_bytes()
    file.unlink()
    if how == "empty":
        file.touch()
    elif how == "folder":
        file.mkdir()
    elif how == "dangling link":
        file.symlink_to(file.with_name("nowhere"))
    elif how == "circular link":
        file.symlink_to(file)
    elif how == "pipe":
        os.mkfifo(file)
    elif how == "device":
        file.symlink_to("/dev/zero")
    elif how == "outside link":
        outside = file.parent.parent / "outside"
        outside.write_bytes(content)
        file.symlink_to(outside)


def make_sample(reader: Reader, folder: Path) -> list[Path]:
    """Write a reader's sample into a new folder, and return its files that are damaged, relative to it."""
    folder.mkdir()
    reader.make(folder)
    files = sorted(path.relative_to(folder) for path in folder.glob(reader.files) if path.is_file())
    assert files, f"{reader.name}: no file of its sample is {reader.files}"
    return files


def damage(reader: Reader, folder: Path, files: list[Path], number: int) -> tuple[Path, str]:
    """Damage a file of a whole sample as the number says, and return which one and how."""
    rng = random.Random(f"{reader.name} {number}")
    path = files[rng.randrange(len(files))]
    if number < len(SWAPS):
        swap(folder / path, SWAPS[number])
        return path, SWAPS[number]
    kind, new = mutated((folder / path).read_bytes(), path.suffix, rng)
    (folder / path).write_bytes(new)
    return path, kind


def fuzz(reader: Reader, folder: Path, numbers: Iterable[int], *, stop: float | None = None) -> tuple[list[Fault], int, float]:
    """Read damaged versions of a reader's sample.

    Args:
        reader: The reader.
        folder: An empty folder.
        numbers: Of the inputs; each depends on the reader's name and its number alone.
        stop: When to end, as of `time.monotonic`.

    Returns:
        The faults, how many inputs were tried, and the longest time of a processor for one [s].
    """
    sample, work = folder / "sample", folder / "work"
    files = make_sample(reader, sample)
    stems = {path.stem for path in sample.rglob("*") if len(path.stem) > 2}  # a digit stands in any error
    names = sorted({path.name for path in sample.rglob("*") if path.suffix} | stems | {"work"})
    content = {path: (sample / path).read_bytes() for path in files}
    faults, longest, tried = [], 0.0, 0
    shutil.copytree(sample, work)
    gc.collect()  # what was left to be collected removes its folders now, not while it is watched
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        reader.read(work)  # as it is it is taken; what is imported late is imported now
        for number in numbers:
            if stop is not None and time.monotonic() > stop:
                break
            path, kind = damage(reader, work, files, number)
            start = time.process_time()
            with limited():
                what = fault_of(reader.read, work, names)
            longest = max(longest, time.process_time() - start)
            tried += 1
            if what is not None:
                faults.append(Fault(number, f"{path}: {kind}", what))
            target = work / path
            if target.is_dir() and not target.is_symlink():
                target.rmdir()
            elif target.is_symlink() or target.exists():
                target.unlink()
            target.write_bytes(content[path])
    shutil.rmtree(work)
    shutil.rmtree(sample)
    return faults, tried, longest


def summary(faults: list[Fault]) -> str:
    """Return the faults by what they are, with the number of one input each."""
    groups: dict[str, list[Fault]] = collections.defaultdict(list)
    for fault in faults:
        key = fault.what.partition(": ")[0] if " at " in fault.what[:60] else fault.what[:70]
        groups[key].append(fault)
    return "\n".join(f"{len(own):5d} x #{own[0].number} ({own[0].kind}) {own[0].what}" for own in groups.values())


def main(args: list[str]) -> None:
    """Repeat one input, or all of a reader."""
    from tests.faults.readers import READERS

    if len(args) > 1 and ":" not in args[1]:
        reader, number = READERS[args[0]], int(args[1])
        sample = Path(tempfile.mkdtemp()) / "sample"
        print(sample, *damage(reader, sample, make_sample(reader, sample), number))
        print(reader.read(sample))
        return
    chosen = [READERS[name] for name in (args[0].split(",") if args and args[0] != "all" else READERS)]
    first, last = (int(n) for n in args[1].split(":")) if len(args) > 1 else (0, 300)
    for reader in chosen:
        folder = Path(tempfile.mkdtemp(dir="/dev/shm" if Path("/dev/shm").is_dir() else None))
        start = time.process_time()
        faults, tried, longest = fuzz(reader, folder, range(first, last))
        each = 1e3 * (time.process_time() - start) / max(tried, 1)
        print(f"{reader.name}: {tried} inputs, {len(faults)} faults, {each:.2f} ms each, longest {longest:.2f} s", flush=True)
        if faults:
            print(summary(faults), flush=True)
        shutil.rmtree(folder)


if __name__ == "__main__":
    main(sys.argv[1:])
