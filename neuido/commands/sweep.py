"""The `sweep` command: the runs of a wandb sweep file, one after the other and without a server."""

import contextlib
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from neuido.commands.cli.config_files import find_config
from neuido.commands.cli.interruption import SIGNALS, STATE
from neuido.commands.cli.sweep_file import Metric, Run, SweepFile, command_of, read_sweep, runs_of
from neuido.commands.engines.outcome import Share
from neuido.commands.engines.tasks import check_engine, map_tasks
from neuido.data.files.lock import LockHeld, OwnedLock
from neuido.data.files.score_tables import read_rows, write_rows
from neuido.data.files.sweep_run import FOLDER, FORMAT, read_status, write_status
from neuido.data.files.writing import check_writable, made_folder
from neuido.data.progress import Progress
from neuido.errors import UserError


def sweep(
    file: str,
    *,
    out: str | None = None,
    shard: int = 0,
    shards: int = 1,
    count: int | None = None,
    seed: int = 0,
    report: bool = True,
    engine: str | None = None,
    address: str | None = None,
    cpus: float = 1.0,
    gpus: float = 0.0,
) -> int:
    """Run a wandb sweep file (grid or random) without a server; wandb logs offline, and the results come into one CSV.

    Each run has a folder of its own, <out>/<its parameters>: what it prints (log.txt), its logs and its results. Runs that are finished
    are skipped when the same command is given again; one that was interrupted goes on from its checkpoint, and starts anew where it left
    none, as one that failed does. Several processes, or machines
    with one file system, may share a sweep: each takes its shard, and a run that another process holds is left to it.
    The same file runs under `wandb sweep` and `wandb agent`.

    Args:
        file: The sweep file, or the name of one that comes with neuido (`sweeps/views`).
        out: Folder for the runs and results.csv; runs/sweeps/<name of the file> where absent.
        shard: Which part of the runs, 0 to shards - 1.
        shards: Number of parts.
        count: Runs of a random sweep, or the first ones of a grid; run_cap of the file where absent.
        seed: Of a random sweep.
        report: Write <out>/report.html (`neuido report`) where runs have scores.
        engine: Run the runs side by side: local (processes of this machine) or ray (a cluster that sees the folder; extra scale). Absent:
            one after the other.
        address: Ray cluster: HOST:PORT, ray://HOST:PORT or auto. Absent: RAY_ADDRESS, else a cluster of this machine alone.
        cpus: Cores for each run.
        gpus: GPUs for each run, or a fraction of one; 0: it runs on the CPU.

    Returns:
        Exit status: 1 where a run failed or was interrupted.

    Raises:
        UserError: A malformed file, a shard that there is not.
    """
    if not 0 <= shard < shards:
        raise UserError(f"shard = {shard} of shards = {shards}: it must be from 0 to shards - 1")
    if count is not None and count < 1:
        raise UserError(f"count = {count}: at least 1 is needed")
    share = Share(cpus, gpus)
    if engine is not None:
        check_engine(engine, address, share)
    path = Path(find_config(file, "FILE"))
    plan = read_sweep(path)
    if plan.early_terminate:
        print("early_terminate is for wandb's server: all runs go to their end here", file=sys.stderr)
    runs = runs_of(plan, count=count, seed=seed)
    folder = Path(out or f"runs/sweeps/{plan.name}").absolute()
    check_writable(folder)
    own = runs[shard::shards]
    with made_folder(folder):
        with Progress("sweep", len(own), unit="runs") as work:
            told = _in_turn(plan, own, folder, work) if engine is None else _side_by_side(plan, own, folder, engine, address, share)
            for i, (run, words) in enumerate(told, 1):
                work.print(f"[{i}/{len(own)}] {run.name}: {words}")
                work.update()
                collect(plan, runs, folder)
        rows = collect(plan, runs, folder)
    _summarise(rows, plan.metric, folder)
    if report and any(name.startswith("scores/") for row in rows for name in row):
        _report([str(folder / row["run"]) for row in rows if row["status"] == "done"], folder, path)
    print(f"results in {folder}: results.csv, and a folder a run")
    return int(any(row["status"] in ("failed", "interrupted") for row in rows if row["run"] in {run.name for run in own}))


def _in_turn(plan: SweepFile, runs: list[Run], folder: Path, work: Progress) -> Iterator[tuple[Run, str]]:
    """Run runs one after the other, and yield each with how it went."""
    for run in runs:
        work.say(run.name)
        yield run, _one(plan, run, folder / run.name)


def _side_by_side(
    plan: SweepFile, runs: list[Run], folder: Path, engine: str, address: str | None, share: Share
) -> Iterator[tuple[Run, str]]:
    """Run runs as tasks of an engine, and yield each with how it went."""
    items = [(plan, run, folder / run.name) for run in runs]
    for outcome in map_tasks(_one, items, engine=engine, address=address, share=share):
        run = runs[outcome.number]
        if outcome.error:
            state = {"format": FORMAT, "run": run.name, "parameters": run.parameters, "status": "failed", "error": outcome.error}
            write_status(folder / run.name, state)
        yield run, outcome.value or f"failed: {outcome.error}"


def _one(plan: SweepFile, run: Run, folder: Path) -> str:
    """Run one run unless it is finished or held elsewhere; how it went, as a word or two."""
    folder.mkdir(exist_ok=True)
    with contextlib.ExitStack() as stack:
        try:
            lock = stack.enter_context(OwnedLock(folder / ".lock", f"the run {run.name}"))
        except LockHeld as error:
            return f"another process runs it: {error}"
        environment = _environment(plan, run, folder)
        words = command_of(plan, run, environment)
        before = read_status(folder)
        if before.get("status") == "done" and before.get("command") == words:
            return "done before"
        if not (_interrupted(before) and before.get("command") == words and (folder / STATE).is_file()):  # else it is taken up again
            _empty(folder)
        state: dict[str, Any] = {"format": FORMAT, "run": run.name, "parameters": run.parameters, "command": words}
        write_status(folder, {**state, "status": "started"})
        start = time.monotonic()
        try:
            code = _execute(words, environment, folder / "log.txt", lock)
        except KeyboardInterrupt:
            write_status(folder, {**state, "status": "interrupted", "seconds": round(time.monotonic() - start, 1)})
            raise
        state |= {"status": _status(code), "seconds": round(time.monotonic() - start, 1)}
        if code != 0:
            state["error"] = _last_line(folder / "log.txt") or f"exit status {code}"
        write_status(folder, state)
    return f"{state['status']} in {state['seconds']:.0f} s{': ' + state['error'] if code else ''}"


def _status(code: int) -> str:
    """Classify an exit status; a run ended by a signal (-n, or 128 + n from its own handler) is neither done nor failed."""
    if code == 0:
        return "done"
    return "interrupted" if code < 0 or code - 128 in (*SIGNALS, signal.SIGKILL) else "failed"


def _interrupted(state: Mapping[str, Any]) -> bool:
    """Whether a run was ended by a signal, or with the machine, before its sweep could note how it ended."""
    return state.get("status") in ("interrupted", "started")


def _environment(plan: SweepFile, run: Run, folder: Path) -> dict[str, str]:
    beside = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])  # so that `neuido` is this one
    own = {FOLDER: str(folder), "WANDB_RUN_ID": run.name, "WANDB_RUN_GROUP": plan.name, "WANDB_DIR": str(folder)}
    return {**os.environ, "PATH": beside, "WANDB_MODE": "offline", "PYTHONUNBUFFERED": "1", **own}


def _execute(words: list[str], environment: Mapping[str, str], log: Path, lock: OwnedLock) -> int:
    """Run a command, wait, and return its exit status. It holds the lock on, should the sweep be killed before it."""
    with log.open("w") as file:
        try:
            process = subprocess.Popen(words, env=environment, stdout=file, stderr=subprocess.STDOUT)
        except OSError as error:
            raise UserError(f"the command {words[0]!r} of the sweep cannot be run: {error.strerror}") from error
        try:
            lock.share_with_child(process.pid)
            return process.wait()
        except BaseException:
            process.terminate()
            process.wait()
            raise


def _empty(folder: Path) -> None:
    """Remove what an earlier try left; a folder that is no run of a sweep is left alone."""
    there = [path for path in folder.iterdir() if not path.name.startswith(".lock")]
    if there and not read_status(folder):
        raise UserError(f"{folder} holds something that is no run of this sweep: give another folder by --out")
    for path in sorted(there, key=lambda path: path.name == "run.json"):  # what tells whose folder it is goes last
        shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()


def _last_line(path: Path) -> str:
    lines = [line.strip() for line in path.read_text(errors="replace").splitlines() if line.strip()]
    return lines[-1][-300:] if lines else ""


def logged(folder: Path) -> dict[str, float]:
    """Return the last value of each column of the metrics.csv files below a folder; a newer file wins."""
    from neuido.data.files.results import logs

    values: dict[str, float] = {}
    for path in logs(folder):
        for row in read_rows(path):
            values |= {name: value for name, value in row.items() if isinstance(value, float)}
    return values


def scored(folder: Path) -> dict[str, float]:
    """Means over the scenes of each score below a folder, as `scores/...`; of a fit those after it, or of a later test.

    `scores/failed` counts the scenes whose law could not run; their means are over the others.
    """
    from neuido.data.files.results import tables

    values: dict[str, float] = {}
    for rows in tables(folder).values():
        stages = {row.get("stage") for row in rows}
        stage = next((each for each in ("test", "after", "before") if each in stages), None)  # nothing fitted: there is but one
        last = [row for row in rows if row.get("stage") == stage]
        for name in dict.fromkeys(name for row in last for name in row):
            own = [row[name] for row in last if isinstance(row.get(name), float)]
            values |= {f"scores/{name}": sum(own) / len(own)} if own else {}
        if failed := sum("failed" in row for row in last):
            values["scores/failed"] = float(failed)
    return values


def collect(plan: SweepFile, runs: list[Run], folder: Path) -> list[dict[str, Any]]:
    """Write results.csv, a row a run that was begun: name, status, seconds, parameters, the metric, then all that it logged and scored."""
    first = [plan.metric.name] if plan.metric else []
    with OwnedLock(folder / ".lock", f"the sweep {folder}", wait=-1):  # of two shards the later one has all rows
        rows = []
        for run in runs:
            state = read_status(folder / run.name)
            if not state:
                continue
            row = {"run": run.name, "status": state["status"], "seconds": state.get("seconds", ""), **run.parameters}
            own = folder / run.name
            values = logged(own) | scored(own) if state["status"] == "done" else {}
            row |= {name: "" for name in first} | values
            rows.append(row | ({"error": state["error"]} if "error" in state else {}))
        write_rows(folder / "results.csv", rows)
    return rows


def _summarise(rows: list[dict[str, Any]], metric: Metric | None, folder: Path) -> None:
    if metric is not None:
        told = [
            (row[metric.name], row["run"]) for row in rows if isinstance(row.get(metric.name), float) and math.isfinite(row[metric.name])
        ]
        if told:
            value, name = max(told) if metric.maximise else min(told)
            print(f"best {metric.name}: {value:.6g} ({name})")
        elif any(row["status"] == "done" for row in rows):
            print(f"no run logged the metric {metric.name} into a metrics.csv below {folder}", file=sys.stderr)
    counts = {status: sum(row["status"] == status for row in rows) for status in ("done", "failed", "interrupted", "started")}
    print(f"{', '.join(f'{n} {status}' for status, n in counts.items() if n) or 'no run'}")


def _report(runs: list[str], folder: Path, path: Path) -> None:
    from neuido.commands.report import report

    beside = path.with_suffix(".paper.csv")
    report(runs, out=str(folder / "report.html"), paper=str(beside) if beside.is_file() else None)
