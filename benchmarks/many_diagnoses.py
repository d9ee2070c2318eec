"""Diagnose many small folders on a Ray cluster of this machine while its workers and the command are killed, and compare with one process.

    python benchmarks/many_diagnoses.py --folders 64 --workers 2 --out runs/many

The cluster has a head without cores and one node of one core for each worker. While the command runs, the process of a task is killed
twice; then the command itself is killed (SIGKILL), and started again. All answers must be there, and equal to those of `--engine local`.
"""

import argparse
import csv
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from neuido.data.progress import Progress

SAME = ("name", "answer", "effects")
COMMAND = [sys.executable, "-m", "neuido"]


def make_folders(out: Path, count: int) -> list[Path]:
    """Make tracks with an undeclared effect, or none, and return their folders."""
    folders = [out / "folders" / f"throw-{number:02d}" for number in range(count)]
    with Progress("folders", count, unit="folders") as work:
        for seed, folder in enumerate(folders):
            if not folder.is_dir():
                words = ["undeclared", "--out", folder, "--seed", seed, "--measured", "track", "--progress", "false"]
                subprocess.run([*COMMAND, *map(str, words)], check=True, capture_output=True)
            work.update()
    return folders


def command(folders: list[Path], out: Path, *more: str) -> list[str]:
    """Return the words of `neuido diagnose` for the folders."""
    options = ["--draws", "19", "--effort", "quick", "--device", "cpu", "--progress", "false"]
    return [*COMMAND, "diagnose", *map(str, folders), "--out", str(out), *options, *more]


def answers(out: Path) -> list[tuple[str, ...]]:
    """Return name, answer and effects of each folder, sorted."""
    with (out / "diagnoses.csv").open(newline="") as stream:
        return sorted(tuple(row[key] for key in SAME) for row in csv.DictReader(stream))


def figures(out: Path) -> dict[str, bytes]:
    """Return the corrected model of each folder that has one."""
    return {file.parent.name: file.read_bytes() for file in sorted(out.glob("*/model_after.yaml"))}


def done(out: Path) -> int:
    """Return how many folders are finished."""
    return len(list(out.glob("*/.task.json")))


def task_processes() -> list[int]:
    """Return the processes in which Ray runs a task."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                if (entry / "cmdline").read_bytes().startswith(b"ray::attempt"):
                    found.append(int(entry.name))
            except OSError:  # it has ended
                continue
    return found


def kill_a_worker(limit: float = 600.0) -> int:
    """Kill the process of a running task, and return its number."""
    end = time.monotonic() + limit
    while time.monotonic() < end:
        for number in task_processes():
            os.kill(number, signal.SIGKILL)
            return number
        time.sleep(0.2)
    raise SystemExit("no task of Ray ran")


def wait_for(out: Path, count: int, process: subprocess.Popen, limit: float = 3600.0) -> None:
    """Wait until so many folders are finished, or the command has ended."""
    end = time.monotonic() + limit
    while done(out) < count and process.poll() is None and time.monotonic() < end:
        time.sleep(0.5)


def with_kills(folders: list[Path], out: Path, workers: int) -> dict[str, float]:
    """Run the diagnoses on a cluster with the kills, and return the times [s]."""
    from ray.cluster_utils import Cluster

    os.environ.setdefault("RAY_worker_niceness", "0")
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    try:
        for _ in range(workers):
            cluster.add_node(num_cpus=1)
        words = command(folders, out, "--engine", "ray", "--address", cluster.address)
        begin = time.monotonic()
        first = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        for part in (1, 2):
            wait_for(out, part * len(folders) // 5, first)
            print(f"{done(out)} done: killed the worker {kill_a_worker()}", flush=True)
        wait_for(out, len(folders) // 2, first)
        first.kill()
        first.wait()
        kept = done(out)
        print(f"{kept} done: killed the command", flush=True)
        again = time.monotonic()
        subprocess.run(words, stdout=subprocess.DEVNULL, check=False)
        return {"before the command was killed": again - begin, "after": time.monotonic() - again, "kept": kept}
    finally:
        cluster.shutdown()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folders", type=int, default=64)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("runs/many"))
    options = parser.parse_args()
    out = options.out.resolve()
    folders = make_folders(out, options.folders)
    times = with_kills(folders, out / "ray", options.workers)
    begin = time.monotonic()
    subprocess.run(command(folders, out / "local", "--engine", "local"), stdout=subprocess.DEVNULL, check=False)
    alone = time.monotonic() - begin
    found, expected = answers(out / "ray"), answers(out / "local")
    models = figures(out / "ray") == figures(out / "local")
    print("\n".join(f"{name}: {value:.4g}" for name, value in times.items()))
    print(f"local: {alone:.4g} s; {len(found)} answers of {len(folders)}, the same as by local: {found == expected}, models too: {models}")
    if found != expected or not models or len(found) != len(folders):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
