"""Surroundings in which a command may find itself: hostile folders to write, full disks, few rights, little memory, closed streams."""

import io
import os
import random
import resource
import signal
import sys
from collections.abc import Callable
from pathlib import Path

from tests.faults.mutations import NUMBERS, WORDS

Out = Callable[[Path, Path, list[str]], list[str]]


def _renamed(words: list[str], name: str) -> list[str]:
    """Return the words with another `out`."""
    if "--out" not in words:
        return words
    at = words.index("--out") + 1
    return [*words[:at], words[at].replace("out", name, 1), *words[at + 1 :]]


def _file(box: Path, beside: Path, words: list[str]) -> list[str]:
    (box / "out").write_text("kept")
    return words


def _below_a_file(box: Path, beside: Path, words: list[str]) -> list[str]:
    (box / "out").write_text("kept")
    return _renamed(words, "out/below")


def _used(box: Path, beside: Path, words: list[str]) -> list[str]:
    (box / "out").mkdir()
    (box / "out" / "mine.txt").write_text("kept")
    return words


def _link(box: Path, beside: Path, words: list[str]) -> list[str]:
    (box / "out").symlink_to(beside)
    return words


def _dangling(box: Path, beside: Path, words: list[str]) -> list[str]:
    (box / "out").symlink_to(box / "nowhere")
    return words


def _pipe(box: Path, beside: Path, words: list[str]) -> list[str]:
    os.mkfifo(box / "out")
    return words


def _work_link(box: Path, beside: Path, words: list[str]) -> list[str]:
    (box / "out").mkdir()
    for name in (".work", "log", "ply", "images"):
        (box / "out" / name).symlink_to(beside)
    return words


def _other_setup(box: Path, beside: Path, words: list[str]) -> list[str]:
    (box / "out").mkdir()
    for name in ("plan.json", "setup.json", "index.json", "results.csv", "run.json"):
        (box / "out" / name).write_text('{"format": "other"}\n')
    return words


def _named(name: str) -> Out:
    return lambda box, beside, words: _renamed(words, name)


OUTS: dict[str, Out] = {
    "a file": _file, "below a file": _below_a_file, "a folder in use": _used, "a link to a folder in use": _link,
    "a dangling link": _dangling,
    "a pipe": _pipe, "links inside": _work_link, "files of another set-up": _other_setup, "the input": _named("in"),
    "a long name": _named("x" * 300), "a line break": _named("a\nb"), "an escape": _named("\x1b[31m"), "no place": _named("/dev/null/x"),
    "the proc file system": _named("/proc/x"), "blank": _named(" "), "dots": _named("out/../out/./x"), "deep": _named("a/b/c/d/e/f"),
}  # fmt: skip

Prepare = Callable[[], None]


def _full_disk(rng: random.Random) -> Prepare:
    size = rng.choice((0, 1, 100, 1000, 4096, 20_000))

    def prepare() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))

    return prepare


def _few_files(rng: random.Random) -> Prepare:
    more = rng.choice((1, 2, 4, 8))
    return lambda: resource.setrlimit(resource.RLIMIT_NOFILE, (max(map(int, os.listdir("/proc/self/fd"))) + more, 4096))


def _little_memory(rng: random.Random) -> Prepare:
    more = rng.choice((1, 8, 64)) << 20

    def prepare() -> None:
        now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (now + more, resource.RLIM_INFINITY))

    return prepare


def _closed(stream: int) -> Callable[[random.Random], Prepare]:
    def prepare() -> None:
        signal.signal(signal.SIGPIPE, signal.SIG_IGN)
        reads, writes = os.pipe()
        os.close(reads)
        os.dup2(writes, stream)

    return lambda rng: prepare


def _full_stdout(rng: random.Random) -> Prepare:
    return lambda: os.dup2(os.open("/dev/full", os.O_WRONLY), 1) and None


def _ascii(rng: random.Random) -> Prepare:
    def prepare() -> None:
        sys.stdout = io.TextIOWrapper(open(1, "wb", closefd=False), encoding="ascii")

    return prepare


def _variable(*names: str) -> Callable[[random.Random], Prepare]:
    def make(rng: random.Random) -> Prepare:
        name = rng.choice(names)
        value = rng.choice((*NUMBERS, *WORDS)).replace("\0", "").replace("\ud800", "")
        return lambda: os.environ.__setitem__(name, value)

    return make


def _nobody(rng: random.Random) -> Prepare:
    """Run without the right to write the folder; where the tests run as root, by a change of the user."""

    def prepare() -> None:
        if os.getuid() == 0:
            os.setgid(65534)
            os.setuid(65534)
        else:
            os.chmod(".", 0o500)

    return prepare


def _no_folder(rng: random.Random) -> Prepare:
    def prepare() -> None:
        os.mkdir("gone")
        os.chdir("gone")
        os.rmdir("../gone")

    return prepare


SURROUNDINGS: dict[str, Callable[[random.Random], Prepare]] = {
    "full disk": _full_disk, "few open files": _few_files, "little memory": _little_memory, "stdout closed": _closed(1),
    "stderr closed": _closed(2), "full stdout": _full_stdout, "stdout of ASCII": _ascii, "no right to write": _nobody,
    "a current folder that is gone": _no_folder, "no temporary folder": lambda rng: lambda: os.environ.__setitem__("TMPDIR", "/nowhere"),
    "limits": _variable("NEUIDO_MAX_STEPS", "NEUIDO_MAX_PARTICLES", "NEUIDO_MAX_TEXT_BYTES", "NEUIDO_MAX_YAML_BYTES",
                        "NEUIDO_MAX_YAML_NODES", "NEUIDO_MAX_TABLE_CELLS", "NEUIDO_MAX_ARRAY_ELEMENTS", "NEUIDO_MAX_IMAGE_PIXELS",
                        "NEUIDO_MAX_COLLIDERS", "NEUIDO_MAX_TRAJECTORIES", "NEUIDO_MAX_MEMORY_BYTES"),
    "variables": _variable("NEUIDO_DATA", "NEUIDO_RUN", "COLUMNS", "TERM", "HOME", "LANG", "XDG_CACHE_HOME", "WANDB_RUN_ID"),
}  # fmt: skip
