"""Attacks on the whole command line: each input runs in a fork of a warm process, in a folder of its own.

    python -m tests.faults.attack [FIRST:LAST] [--workers 2] [--out attack.csv] [--report attack.md] [--only NUMBER]

An input depends on its number alone. A command may do its work, or refuse it by one line of at most 300 characters and exit status 2 (1:
a check failed); a signal ends it with 128 + n. Everything else is a fault: a traceback, another status, a write outside `out`, a trace in
`out` of what was refused, a temporary file that stays, a file under its final name that is not whole, more than 60 s or 4 GiB for
what is then refused.
"""

import argparse
import contextlib
import csv
import faulthandler
import hashlib
import json
import multiprocessing
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from neuido.commands.cli.functions import options_of
from neuido.commands.cli.trainer_help import HEAVY
from neuido.commands.main import LIGHT, main
from neuido.errors import LONGEST
from tests.faults.fuzzing import BYTES, SECONDS, SWAPS, swap, watched
from tests.faults.mutations import NUMBERS, VALUES, WORDS, mutated, yaml_snippet, yaml_tree
from tests.faults.surroundings import OUTS, SURROUNDINGS
from tests.faults.targets import TARGETS, Target
from tests.faults.wholeness import not_whole

LIMITS = {  # so that what is asked for by a lucky number ends soon
    "NEUIDO_MAX_STEPS": "20000", "NEUIDO_MAX_PARTICLES": "20000", "NEUIDO_MAX_TRAJECTORIES": "60", "NEUIDO_MAX_MEMORY_BYTES": "500000000",
}  # fmt: skip
STOP = 20.0
"""Seconds of a processor after which work that was accepted is ended by SIGTERM."""
GRACE = 60.0
"""Seconds that it may then take to end."""
WAIT = 60.0
"""Seconds of the clock that a command may sleep without any work in between; one that waits for the processor does not sleep."""
KINDS = ("file", "value", "words", "configuration", "out", "surroundings", "signal", "file")
"""What an input attacks; damaged files count twice."""
WRITTEN = ("out", "model.out", "model.save_to", "trainer.default_root_dir", "model.cache")
"""Options that say where a command writes."""
SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
INTERRUPTED = tuple(128 + number for number in SIGNALS)


class Attack(NamedTuple):
    """An input of the command line, and what came of it."""

    number: int
    target: str
    kind: str
    what: str
    status: int | None
    seconds: float
    fault: str
    line: str


def kind_of(number: int, count: int) -> tuple[int, str]:
    """Return the place of the target and the kind of an input: all targets first, then the next kind."""
    return number % count, KINDS[(number // count) % len(KINDS)]


def run_attack(target: Target, kind: str, number: int, sample: Path, root: Path) -> Attack:
    """Run a command on a damaged copy of its sample in a fork of this process, and judge it.

    Args:
        target: The command.
        kind: What is attacked.
        number: Of the input.
        sample: The whole sample.
        root: An empty folder, which is empty again at the end.
    """
    rng = random.Random(f"{target.name} {kind} {number}")
    box, beside = root / "box", root / "beside"
    shutil.copytree(sample, box / "in", symlinks=True)
    beside.mkdir()
    (beside / "kept.txt").write_text("kept")
    (root / "tmp").mkdir()
    words, prepare, delay, what = list(target.words), _nothing, None, kind
    if kind == "file":
        words, what = _damage(target, box / "in", rng, number), ""
        words, what = list(target.words), words
    elif kind == "value":
        words, what = _value(target, words, rng)
    elif kind == "words":
        words, what = _words(words, rng)
    elif kind == "configuration":
        words, what = _configuration(target, words, box / "in", rng)
    elif kind == "out":
        what = rng.choice(list(OUTS))
        words = OUTS[what](box, beside, words)
    elif kind == "surroundings":
        what = rng.choice(list(SURROUNDINGS))
        prepare = SURROUNDINGS[what](rng)
    elif kind == "signal":
        delay, number_of = rng.choice((0.0, 0.01, 0.05, 0.1, 0.2, 0.4, 0.8)), rng.choice(SIGNALS)
        what = f"{signal.Signals(number_of).name} after {delay:g} s"
    before = {"in": _tree(box / "in"), "out": _tree(box), "beside": _tree(beside)}
    status, seconds, err, notes = _forked(words, box, root, prepare, None if delay is None else (delay, number_of))
    line = err.strip().splitlines()[-1] if err.strip() else ""
    fault = _fault(target, kind, what, status, seconds, err, notes) or _traces(box, beside, before, status, what, target.command in HEAVY)
    if fault and (log := next((root / "tmp").glob("neuido-*.log"), None)) is not None:
        fault += " | " + " ".join(log.read_text(errors="replace").splitlines()[-4:])[-400:]
    for path in list(root.iterdir()):
        path.unlink() if path.is_symlink() or not path.is_dir() else shutil.rmtree(path)
    return Attack(number, target.name, kind, what[:200], status, seconds, fault, line[:400])


def _nothing() -> None:
    """Change nothing of the surroundings."""


def _damage(target: Target, folder: Path, rng: random.Random, number: int) -> str:
    files = sorted(path for path in folder.glob(target.files) if path.is_file())
    if not files:
        return "no file"
    path = rng.choice(files)
    if rng.random() < 0.15:
        how = rng.choice(SWAPS)
        swap(path, how)
        return f"{path.relative_to(folder)}: {how}"
    kind, new = mutated(path.read_bytes(), path.suffix, rng)
    path.write_bytes(new)
    return f"{path.relative_to(folder)}: {kind}"


def _options(target: Target, words: list[str]) -> list[str]:
    """Return the options of a command, those below a mapping with their prefix."""
    if target.command in LIGHT:
        module, function, _ = LIGHT[target.command]
        known = options_of(getattr(__import__(module, fromlist=[function]), function))
        return [name for key, below in known.items() for name in ([f"{key}.{b}" for b in below] or [key])]
    if target.command.startswith("--"):
        return ["print_completion"]
    own = {"fit": ("max_epochs", "max_steps"), "predict": ("limit_predict_batches",)}.get(target.command, ("limit_val_batches",))
    if target.command == "predict":
        model, data = ("operator", "init_from", "out", "cache"), ("scenes", "root", "frame_step", "width", "views")
    else:
        model, data = ("lr", "latent_dim", "trunk", "save_to", "init_from"), ("root", "batch_size", "families")
    trainer = (*own, "accelerator", "devices", "precision", "logger", "callbacks", "default_root_dir", "gradient_clip_val")
    return [
        *(f"model.{n}" for n in model),
        *(f"data.{n}" for n in data),
        *(f"trainer.{n}" for n in trainer),
        "ckpt_path",
        "seed_everything",
    ]


def _value(target: Target, words: list[str], rng: random.Random) -> tuple[list[str], str]:
    """Give an option a hostile value; `out` keeps a name inside of the folder."""
    name = rng.choice(_options(target, words))
    new = rng.choice((*NUMBERS, *WORDS, *map(str, VALUES)))
    if name in (*WRITTEN, "trainer.logger"):
        new = rng.choice(["", " ", "out/a\nb", "out/" + "x" * 300, "in", "in/scene.yaml", "out/é", "out/\x1b[31m", "out/\ud800", "null"])
    new = new.replace("\0", "").encode("utf-8", "surrogateescape" if "\ud800" not in new else "replace").decode("utf-8", "surrogateescape")
    option = f"--{name}"
    if option in words:
        words[words.index(option) + 1] = new
    else:
        words += [option, new]
    return words, f"{option} {new!r}"


def _words(words: list[str], rng: random.Random) -> tuple[list[str], str]:
    """Leave out, double, exchange or misspell words."""
    i, kind = rng.randrange(len(words)), rng.choice(("drop", "double", "exchange", "misspell", "add", "abbreviate", "hostile"))
    old = words[i]
    if kind == "drop":
        del words[i]
    elif kind == "double":
        words.insert(i, old)
    elif kind == "exchange":
        j = rng.randrange(len(words))
        words[i], words[j] = words[j], old
    elif kind == "misspell" and len(old) > 3:
        k = rng.randrange(2, len(old) - 1)
        words[i] = old[:k] + old[k + 1] + old[k] + old[k + 2 :]
    elif kind == "abbreviate" and len(old) > 4:
        words[i] = old[:-2]
    else:
        words.insert(i, rng.choice(("--", "-", "--x", "--help=1", "--config", "--config=in", "--config=absent.yaml", "--print_config=no",
                                    "@in", "--out=", "é", "", "--" + "x" * 400, "-h=1", "--config=/dev/null", "--=", "---",
                                    "--a.b.c=1")))  # fmt: skip
    return words, f"{kind} {old[:40]!r} at {i}"


def _configuration(target: Target, words: list[str], folder: Path, rng: random.Random) -> tuple[list[str], str]:
    """Give the options by a file, and damage it."""
    content: dict[str, Any] = {}
    rest, i = [words[0]], 1
    if target.command not in LIGHT:
        content = yaml.safe_load((folder / "config.yaml").read_text()) if (folder / "config.yaml").is_file() else {}
        rest, i = [word if word != "in/config.yaml" else "in/attack.yaml" for word in words], len(words)
    elif "--config" in words:
        content = yaml.safe_load((folder.parent / words[words.index("--config") + 1]).read_text())
    while i < len(words):
        if words[i] == "--config":
            i += 2
            continue
        if words[i].startswith("--") and i + 1 < len(words) and not words[i + 1].startswith("--"):
            keys, at = words[i][2:].split("."), content
            for key in keys[:-1]:
                at = at.setdefault(key, {})
            at[keys[-1]] = yaml.safe_load(words[i + 1])
            i += 2
        else:
            rest.append(words[i])
            i += 1
    data = yaml.safe_dump(content).encode()
    kind = rng.choice(("tree", "tree", "snippet", "bytes"))
    kept = data
    for _ in range(20):
        if kind == "bytes":
            kind, data = mutated(kept, ".yaml", rng)
        else:
            data = (yaml_tree if kind == "tree" else yaml_snippet)(kept, rng)
        if b"evil" not in data:  # where a configuration writes is the user's choice
            break
    (folder / "attack.yaml").write_bytes(data)
    return [*rest, *(["--config", "in/attack.yaml"] if target.command in LIGHT else [])], kind


def _forked(
    words: list[str], box: Path, root: Path, prepare: Callable[[], None], interrupt: tuple[float, int] | None
) -> tuple[int | None, float, str, list[str]]:
    """Run the words in a fork; return exit status (None: it had to be killed), seconds of a processor, stderr, what it did outside."""
    pipes = [os.pipe() for _ in ("stdout", "stderr", "notes")]  # what limits the size of files does not limit these
    signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)  # a signal waits until the child is one
    child = os.fork()
    if child == 0:
        for reads, _ in pipes:
            os.close(reads)
        _child(words, box, root, prepare, [writes for _, writes in pipes])
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
    for reads, writes in pipes:
        os.close(writes)
        os.set_blocking(reads, False)
    texts = [b""] * len(pipes)

    def drain() -> None:
        for i, (reads, _) in enumerate(pipes):
            with contextlib.suppress(BlockingIOError):
                while part := os.read(reads, 1 << 16):
                    texts[i] += part

    if interrupt is not None:
        time.sleep(interrupt[0])
        os.kill(child, interrupt[1])
    told, end, before, awake = 0.0, None, 0.0, time.monotonic()
    while True:
        drain()
        done, code, usage = os.wait4(child, os.WNOHANG)
        if done:
            drain()
            break
        used, sleeps = _processor_seconds(child)
        if used > before or not sleeps:
            before, awake = max(used, before), time.monotonic()
        if end is None and used > STOP:
            os.kill(child, signal.SIGTERM)
            told, end = used, time.monotonic() + 4 * GRACE
        elif time.monotonic() > awake + WAIT:
            os.kill(child, signal.SIGUSR1)  # it says where it waits
            time.sleep(0.5)
            drain()
            os.kill(child, signal.SIGKILL)
        elif end is not None and (used > told + GRACE or time.monotonic() > end):
            os.kill(child, signal.SIGKILL)
        time.sleep(0.005)
    for reads, _ in pipes:
        os.close(reads)
    status = os.waitstatus_to_exitcode(code)
    found = json.loads(texts[2] or b"[]")
    return (
        (None if status == -signal.SIGKILL else status),
        max(usage.ru_utime + usage.ru_stime, before),
        texts[1].decode(errors="replace"),
        found,
    )


def _processor_seconds(pid: int) -> tuple[float, bool]:
    """Return how long a process and those that it started have worked [s], and whether all of them sleep now."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except OSError:
        return 0.0, True
    below = [_processor_seconds(int(child)) for child in children]
    own = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return own + sum(seconds for seconds, _ in below), fields[0] == "S" and all(sleeps for _, sleeps in below)


def _child(words: list[str], box: Path, root: Path, prepare: Callable[[], None], pipes: list[int]) -> None:
    """Be the command, and end the process; the pipes take stdout, stderr and what was done outside."""
    status: Any = 99
    seen: list[str] = []
    try:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
        os.chdir(box)
        os.environ |= LIMITS | {"TMPDIR": str(root / "tmp")}
        os.dup2(pipes[0], 1)
        os.dup2(pipes[1], 2)
        faulthandler.register(signal.SIGUSR1, file=pipes[1], all_threads=True)
        sys.stdout = open(1, "w", closefd=False, encoding="utf-8")
        sys.stderr = open(2, "w", closefd=False, encoding="utf-8", errors="backslashreplace")
        sys.argv = ["neuido", *words]
        now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (now + BYTES, resource.getrlimit(resource.RLIMIT_AS)[1]))
        prepare()
        with watched(root) as outside:
            try:
                main(words)
            except SystemExit as stop:
                status = stop.code
        seen += outside[:5]
        sys.stdout.flush()
        with contextlib.suppress(OSError):
            sys.stderr.flush()
    except BaseException as error:
        seen.append(f"the harness sees {type(error).__name__}: {error}")
    finally:
        os.write(pipes[2], json.dumps(seen).encode())
        os._exit(status if isinstance(status, int) else 0 if status is None else 1)


def _fault(target: Target, kind: str, what: str, status: int | None, seconds: float, err: str, notes: list[str]) -> str:
    """Return what is wrong with how a command ended."""
    if status is None:
        return f"does not end: {' '.join(err.split())[-600:]}"
    if "Traceback (most recent call last)" in err:
        return "traceback: " + " ".join(err.strip().splitlines()[-2:])[:300]
    stopped = status in INTERRUPTED or (kind == "signal" and -status in SIGNALS)  # before the command could take it
    if stopped and kind != "signal" and seconds < STOP:
        return f"status {status}"
    if status not in (0, 1, 2) and not stopped and not (status == 128 + signal.SIGPIPE and "stdout" in what):
        return f"status {status}: {err.strip()[-200:]}"
    own = [line for line in err.splitlines() if line.startswith("neuido: ")]
    blind = "stderr" in what
    if status == 2 and not blind:
        if not own or len(own) > 1 or err.splitlines()[-1] != own[0]:
            return f"{len(own)} lines of errors: {err.strip()[-300:]!r}"
        if len(own[0]) > LONGEST + len("neuido: ") or not own[0].isprintable():
            return f"error of {len(own[0])} characters: {own[0][:200]!r}"
        if seconds > SECONDS:
            return f"refused after {seconds:.0f} s"
        if "not enough memory" in own[0] and "memory" not in what:
            return f"takes the memory and is refused: {own[0][:200]}"
    notes = [
        n
        for n in notes
        if "harness" in n or (not (target.acts and not n.startswith(("open", "os."))) and not (kind == "out" and "/proc/." in n))
    ]
    return f"acts outside: {notes[:2]}"[:400] if notes else ""


def _traces(box: Path, beside: Path, before: dict[str, dict[str, str]], status: int | None, what: str, heavy: bool) -> str:
    """Return what is wrong with the files after a command."""
    now = _tree(beside)
    named = what == "a link to a folder in use" or (what == "links inside" and heavy)  # a logger's folder too is named by the user
    if now != before["beside"] and not (named and before["beside"].items() <= now.items()):
        return f"changes what lies beside: {_difference(before['beside'], now)}"
    now = _tree(box / "in")
    named = what == "the input" or what.startswith(tuple(f"--{name} " for name in WRITTEN))  # new files where the user wants them
    if now != before["in"] and not (named and before["in"].items() <= now.items()):
        return f"changes its input: {_difference(before['in'], now)}"
    now = _tree(box)
    if left := [path for path in now if ".tmp" in Path(path).name and path not in before["out"]]:
        return f"leaves temporary files: {left[:2]}"
    if what == "full disk":  # work that a full disk ends goes on where it was, when there is space again
        kept = ("out/.work", "out/log/") if heavy else ("out/.work",)  # of a training, the log of the steps that were done
        now = {
            path: content for path, content in now.items() if not path.startswith(kept) and path not in ("out", "out/log", "out/log.csv")
        }
    if status == 2 and now != before["out"] and what != "full stdout":
        return f"is refused and leaves traces: {_difference(before['out'], now)}"
    for path in now:
        if path not in before["out"] and not (named and path.startswith("in/")) and (wrong := not_whole(box / path)):
            return f"leaves {path}, which is not whole: {wrong}"
    return ""


def _tree(folder: Path) -> dict[str, str]:
    """Return what a folder holds, with a digest each."""
    found = {}
    for path in sorted(folder.rglob("*")) if folder.is_dir() else []:
        name = str(path.relative_to(folder))
        if path.is_symlink():
            found[name] = f"link to {os.readlink(path)}"
        elif path.is_file():
            found[name] = hashlib.sha1(path.read_bytes(), usedforsecurity=False).hexdigest()
        else:
            found[name] = "folder" if path.is_dir() else "other"
    return found


def _difference(before: dict[str, str], now: dict[str, str]) -> str:
    return ", ".join(sorted(path for path in before.keys() | now.keys() if before.get(path) != now.get(path)))[:200]


def warm(target: Target, folder: Path) -> Path:
    """Write a target's sample, run it once in this process, so that imports and kernels are there in the forks, and return the sample."""
    sample = folder / target.name
    (sample / "in").mkdir(parents=True)
    here = os.getcwd()
    os.chdir(sample)
    hidden = [os.dup(1), os.dup(2)]
    try:
        with open(folder / "log", "w") as log:
            for number in (1, 2):
                os.dup2(log.fileno(), number)
            target.make(sample / "in")
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                try:
                    main(list(target.words))
                except SystemExit as stop:
                    status = stop.code
    finally:
        for number, file in enumerate(hidden, 1):
            os.dup2(file, number)
            os.close(file)
        os.chdir(here)
    if status:
        raise RuntimeError(f"{target.name} ends with {status} where nothing is damaged: {(folder / 'log').read_text()[-600:]}")
    shutil.rmtree(sample / "out", ignore_errors=True)
    return sample / "in"


def attacks(
    numbers: Iterable[int], folder: Path, targets: tuple[Target, ...] = TARGETS, samples: dict[str, Path] | None = None
) -> Iterable[Attack]:
    """Run inputs by their numbers; `samples` are those that were written before, and takes further ones."""
    samples = {} if samples is None else samples
    for number in numbers:
        place, kind = kind_of(number, len(targets))
        target = targets[place]
        if target.name not in samples:
            samples[target.name] = warm(target, folder / "samples")
        (folder / "root").mkdir(exist_ok=True)
        yield run_attack(target, kind, number, samples[target.name], folder / "root")


def report(rows: list[dict[str, str]], path: Path) -> None:
    """Write tables by kind and by command."""
    out = [f"{len(rows)} inputs, {sum(not row['fault'] for row in rows)} survived "
           f"({100 * np.mean([not row['fault'] for row in rows]):.2f} %)\n"]  # fmt: skip
    for column, title in (("kind", "what is attacked"), ("target", "command")):
        out.append(f"| {title} | inputs | survived | done | refused | interrupted | longest [s of a processor] |\n" + "| --- " * 7 + "|")
        for value in sorted({row[column] for row in rows}):
            own = [row for row in rows if row[column] == value]
            ends = Counter("done" if r["status"] == "0" else "refused" if r["status"] in "12" else "interrupted" for r in own)
            longest = max(float(row["seconds"]) for row in own)
            out.append(f"| {value} | {len(own)} | {sum(not row['fault'] for row in own)} | {ends['done']} | {ends['refused']} "
                       f"| {ends['interrupted']} | {longest:.1f} |")  # fmt: skip
        out.append("")
    path.write_text("\n".join(out))


def _work(share: list[int], folder: Path, found: Any) -> None:
    """Run a share of the inputs in a process of its own, and hand over each result."""
    folder.mkdir()
    try:
        for attack in attacks(share, folder):
            found.put(attack)
    finally:
        found.put(None)


def run_shares(numbers: Iterable[int], folder: Path, workers: int) -> Iterable[Attack]:
    """Run inputs in several processes; those of one command stay together, the quick commands first."""
    context = multiprocessing.get_context("fork")
    order = sorted(range(len(TARGETS)), key=lambda i: not TARGETS[i].quick)
    place = {target: i for i, target in enumerate(order)}
    numbers = sorted(numbers, key=lambda n: (place[n % len(TARGETS)], n))
    found = context.SimpleQueue()  # which has no thread: the workers fork
    shares = [[n for n in numbers if place[n % len(TARGETS)] % workers == i] for i in range(workers)]
    own = [context.Process(target=_work, args=(share, folder / str(i), found)) for i, share in enumerate(shares)]
    for process in own:
        process.start()
    left = workers
    while left:
        attack = found.get()
        left -= attack is None
        if attack is not None:
            yield attack


def run() -> None:
    """Run inputs, and write a row each; numbers that the table has already are left out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("numbers", nargs="?", default="0:1680")
    parser.add_argument("--out", type=Path, default=Path("attack.csv"))
    parser.add_argument("--report", type=Path)
    parser.add_argument("--only", type=int, nargs="+")
    parser.add_argument("--workers", type=int, default=1)
    given = parser.parse_args()
    first, last = map(int, given.numbers.split(":"))
    folder = Path(tempfile.mkdtemp(dir="/dev/shm" if Path("/dev/shm").is_dir() else None))
    rows = list(csv.DictReader(given.out.open(newline=""))) if given.out.is_file() and not given.only else []
    there = {int(row["number"]) for row in rows}
    try:
        with given.out.absolute().open("w", newline="") as file:
            writer = csv.DictWriter(file, Attack._fields)
            writer.writeheader()
            writer.writerows(rows)
            wanted = given.only or [number for number in range(first, last) if number not in there]
            for found in run_shares(wanted, folder, given.workers) if given.workers > 1 else attacks(wanted, folder):
                rows.append({key: f"{value:.2f}" if isinstance(value, float) else str(value) for key, value in found._asdict().items()})
                writer.writerow(rows[-1])
                file.flush()
                if found.fault or given.only:
                    print(
                        f"#{found.number} {found.target} {found.kind} ({found.what}): {found.fault or 'ok'}\n    {found.line}", flush=True
                    )
    finally:
        shutil.rmtree(folder)
    print(f"{len(rows)} inputs, {sum(bool(row['fault']) for row in rows)} faults")
    if given.report:
        report(rows, given.report)


if __name__ == "__main__":
    run()
