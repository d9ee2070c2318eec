"""Run other differentiable codes on the same body, grid and substeps as the engine, each in a process of its own.

    python benchmarks/side_by_side.py [--device cuda] [--sizes 32 100] [--substeps 100] [--seconds 240] [--out side_by_side.md]

The body is a block of n^3 particles, eight in a cell, in a grid of n^3 cells of 1/n m. It is neo-Hookean (or has the two networks of
NCLaw), stretches and shears from the start, and flies freely, since rules at walls differ between codes. The loss is a weighted sum of
the last positions; its gradient with respect to the initial velocities is compared with that of the first code. Times are medians, after
one call that compiles. A code that is not installed, fails or takes too long is listed with the reason, beside what it had measured.
"""

import argparse
import importlib
import json
import os
import platform
import resource
import statistics
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import torch
from peers import PEERS, Problem

HERE = Path(__file__).parent


def measure(name: str, problem: Problem, device: str, repeat: int, folder: Path) -> None:
    """Print the figures of one code; its motion and its gradient are written to `folder`."""
    module, kind = PEERS[name].split(":")
    start = time.perf_counter()
    peer = getattr(importlib.import_module(module), kind)(problem, device)
    row = {"code": name, "version": peer.version(), "precision": "float32", "differs": peer.differs}
    for way in ("forward", "gradient"):
        run = getattr(peer, way, None)
        if run is None:
            continue
        run()
        peer.wait()
        times = []
        for _ in range(repeat):
            begun = time.perf_counter()
            run()
            peer.wait()
            times.append(time.perf_counter() - begun)
        row[way] = statistics.median(times)
        if way == "forward":
            row["ready"] = time.perf_counter() - start - sum(times)
            np.save(folder / "x.npy", peer.positions())
        else:
            np.save(folder / "g.npy", peer.slopes())
        if device == "cuda":
            free, total = torch.cuda.mem_get_info()  # of the whole device, which no other process may use meanwhile
            row["bytes"] = total - free
        else:
            row["bytes"] = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        print(json.dumps(row), flush=True)  # stays where the other way takes too long


def in_a_process(name: str, problem: Problem, options: argparse.Namespace, folder: Path, limit: float) -> dict:
    """Measure one code in a process of its own; return its figures, or the reason why there are none."""
    given = [name, problem.side, problem.substeps, problem.law, options.device, options.repeat, folder]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(HERE.parent), os.environ.get("PYTHONPATH", "")])}
    command = [sys.executable, __file__, "--child", *map(str, given)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=limit, env=environment)
    except subprocess.TimeoutExpired as late:
        found = (late.stdout or b"").decode().splitlines()
        known = json.loads(found[-1]) if found and found[-1].startswith("{") else {"code": name}
        return known | {"failed": f"not done after {limit:.0f} s"}
    if done.returncode:
        return {"code": name, "failed": (done.stderr.strip().splitlines() or ["no message"])[-1][:200]}
    return json.loads(done.stdout.strip().splitlines()[-1])


def apart(a: Path, b: Path, start: np.ndarray | float = 0.0) -> str:
    """Return the norm of the difference of two stored arrays, relative to the second less `start`."""
    if not (a.is_file() and b.is_file()):
        return ""
    one, two = np.load(a).astype(np.float64), np.load(b).astype(np.float64)
    return f"{np.linalg.norm(one - two) / np.linalg.norm(two - start):.1e}"


def row_of(found: dict, problem: Problem, folder: Path, first: Path) -> list[str]:
    """Return a row of the table; a code that failed has its reason in the last column."""
    if "forward" not in found:
        return [found["code"], *[""] * 8, f"not run: {found['failed']}"]
    work = problem.count * problem.substeps
    rates = [f"{work / found[way]:.2e}" if way in found else "none" for way in ("forward", "gradient")]
    start = problem.arrays()[0]
    compared = [apart(folder / "x.npy", first / "x.npy", start), apart(folder / "g.npy", first / "g.npy")]
    figures = [f"{found['bytes'] / 1e9:.2f}", f"{found['ready']:.0f}", found["precision"], found["version"]]
    notes = [found["differs"], f"gradient {found['failed']}" if "failed" in found else ""]
    return [found["code"], *rates, *compared, *figures, "; ".join(filter(None, notes))]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu", choices=("cpu", "cuda"))
    parser.add_argument("--sizes", type=int, nargs="+", default=[32, 100], help="particles, and cells, along each side")
    parser.add_argument("--substeps", type=int, default=100)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=240.0, help="no further code begins after this time")
    parser.add_argument("--limit", type=float, default=60.0, help="longest time of one code [s]")
    parser.add_argument("--codes", nargs="+", default=list(PEERS), choices=list(PEERS))
    parser.add_argument("--laws", nargs="+", default=["neo-hookean", "networks"], choices=("neo-hookean", "networks"))
    parser.add_argument("--folder", type=Path, default=Path("side_by_side"), help="folder for motions and gradients")
    parser.add_argument("--out", type=Path, help="also write the tables to this file")
    parser.add_argument("--child", nargs=7, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.device == "cpu":
        torch.set_num_threads(1)
    if options.child:
        name, side, substeps, law, device, repeat, folder = options.child
        measure(name, Problem(int(side), int(substeps), law), device, int(repeat), Path(folder))
        return
    begun = time.perf_counter()
    device = torch.cuda.get_device_name() if options.device == "cuda" else f"{platform.processor() or platform.machine()}, one thread"
    text = [f"{device}, torch {torch.__version__}, medians of {options.repeat}, each code in a process of its own", ""]
    head = ["code", "forward [p-s/s]", "with gradient [p-s/s]", "motion", "gradient", "GB", "ready [s]", "precision", "version", "differs"]
    for law in options.laws:
        for side in options.sizes:
            problem = Problem(side, options.substeps, law)
            text += [f"## {problem.count:,} particles, {side}^3 cells, {options.substeps} substeps, {law}", ""]
            text += ["| " + " | ".join(head) + " |", "| " + " | ".join("---" for _ in head) + " |"]
            first = None
            for name in options.codes:
                left = options.seconds - (time.perf_counter() - begun)
                folder = options.folder / f"{law}-{side}-{name}"
                folder.mkdir(parents=True, exist_ok=True)
                for old in folder.glob("*.npy"):
                    old.unlink()
                first = first or folder
                if left > 0:
                    found = in_a_process(name, problem, options, folder, min(options.limit, left))
                else:
                    found = {"code": name, "failed": "no time left"}
                text.append("| " + " | ".join(row_of(found, problem, folder, first)) + " |")
                print(text[-1], file=sys.stderr, flush=True)
            text.append("")
            if options.out:
                options.out.write_text("\n".join(text))
    print("\n".join(text))


if __name__ == "__main__":
    main()
