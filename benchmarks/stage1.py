"""Train Stage I at the scale of the paper for several latent dimensions and both trunks, and compare with the paper in one table.

    python benchmarks/stage1.py --data data/trajectories --out runs/stage1 [--runs objective-64-128 raw-128-128 ...]

The name of a run is TRUNK-WIDTH-DIM[-KEY=VALUE ...]: the trunk, its hidden width, the latent dimension d, and further model options.
The paper's own Stage I: `--config configs/paper/stage1.yaml --setup configs/paper/trajectories.yaml --data data/trajectories_paper
--runs raw-256-128-lr=0.003-basis_dim=64 ...`.

Missing trajectories are generated first. The fits run in parallel, one or more on each GPU (`--per-device`), each as a process
`neuido fit --config CONFIG`. OUT receives their logs, weights (safetensors) and table.md.
"""

import argparse
import csv
import os
import subprocess
import sys
import time
from pathlib import Path

import torch

from neuido.data.files.results import logs

ROOT = Path(__file__).resolve().parent.parent
PAPER = {32: (1023.0, 3.598e-8), 64: (839.2, 3.211e-8), 256: (688.5, 3.341e-8)}
"""Stress MSE and plastic MSE of the paper's Table 3, which omits d = 128. The data differ, as the paper gives no ranges."""

COLUMNS = [
    ("val/stress_mse", "stress MSE [Pa^2]"),
    ("val/plastic_mse", "plastic MSE"),
    ("val/stress_error", "stress error, median"),
    ("val/plastic_error_yielding", "plastic error where it flows, median"),
    ("val/stress_mse_zero", "stress MSE of zero stress"),
    ("val/plastic_mse_identity", "plastic MSE of the identity"),
    ("val/plastic_error_yielding_identity", "plastic error of the identity"),
    ("instance/stress_error", "stress error, held-out instances"),
    ("instance/plastic_error_yielding", "plastic error, held-out instances"),
    ("instance/plastic_mse", "plastic MSE, held-out instances"),
]


def command(options: argparse.Namespace, name: str) -> list[str]:
    trunk, width, dim, *more = name.split("-")
    extra = [word for option in more for word in (f"--model.{option.split('=')[0]}", option.split("=")[1])]
    arguments = [
        "fit", "--config", str(options.config),
        "--model.trunk", trunk, "--model.hidden_dim", width, "--model.latent_dim", dim,
        "--model.save_to", str(options.out / f"{name}.safetensors"), "--data.root", str(options.data),
        "--trainer.logger.save_dir", str(options.out), "--trainer.logger.name", name,
        "--trainer.enable_progress_bar", "false", *extra, *options.extra,
    ]  # fmt: skip
    return [sys.executable, "-m", "neuido", *arguments]


def figures(folder: Path) -> dict[str, float]:
    """Return the last value of each column in the metrics.csv files of a run."""
    found: dict[str, float] = {}
    for path in logs(folder):
        with path.open() as file:
            for row in csv.DictReader(file):
                found |= {key: float(value) for key, value in row.items() if value not in ("", None)}
    return found


def table(options: argparse.Namespace, seconds: dict[str, float]) -> str:
    head = ["trunk", "width", "d", "options", *(title for _, title in COLUMNS), "minutes"]
    lines = ["| " + " | ".join(head) + " |", "| " + " | ".join("---" for _ in head) + " |"]
    for name in options.runs:
        found = figures(options.out / name)
        cells = [f"{found[key]:.3g}" if key in found else "missing" for key, _ in COLUMNS]
        trunk, width, dim, *more = name.split("-")
        lines.append("| " + " | ".join([trunk, width, dim, " ".join(more), *cells, f"{seconds.get(name, float('nan')) / 60:.1f}"]) + " |")
    for dim, (stress, plastic) in PAPER.items():
        lines.append(
            "| " + " | ".join(["paper, Table 3", "", str(dim), "", f"{stress:g}", f"{plastic:g}", *[""] * (len(COLUMNS) - 1)]) + " |"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("data/trajectories"))
    parser.add_argument("--out", type=Path, default=Path("runs/stage1"))
    parser.add_argument(
        "--runs", nargs="+", default=[f"{trunk}-{dim}" for trunk in ("objective-64", "raw-128") for dim in (32, 64, 128, 256)]
    )
    parser.add_argument("--config", type=Path, default=ROOT / "configs" / "stage1.yaml", help="configuration of the fits")
    parser.add_argument("--setup", type=Path, default=ROOT / "configs" / "trajectories.yaml", help="configuration of the trajectories")
    parser.add_argument("--per-device", type=int, default=1, help="number of parallel fits on each GPU")
    parser.add_argument("extra", nargs="*", help="further arguments of `neuido fit`, after --")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    if not (options.data / "index.json").exists():
        start = time.time()
        arguments = ["trajectories", "--config", str(options.setup), "--out", str(options.data), "--batch", "40"]
        subprocess.run([sys.executable, "-m", "neuido", *arguments], check=True, env=environment)
        print(f"trajectories generated in {time.time() - start:.0f} s", flush=True)
    devices = max(1, torch.cuda.device_count())
    waiting = list(options.runs)
    running: dict[str, tuple[subprocess.Popen, int, float]] = {}
    seconds: dict[str, float] = {}
    load = [0] * devices
    while waiting or running:
        while waiting and min(load) < options.per_device:
            name = waiting.pop(0)
            device = load.index(min(load))
            log = (options.out / f"{name}.log").open("w")
            one = {**environment, "CUDA_VISIBLE_DEVICES": str(device)} if torch.cuda.is_available() else environment
            process = subprocess.Popen(command(options, name), stdout=log, stderr=subprocess.STDOUT, env=one)
            running[name] = (process, device, time.time())
            load[device] += 1
        for name, (process, device, start) in list(running.items()):
            if process.poll() is not None:
                seconds[name] = time.time() - start
                load[device] -= 1
                del running[name]
                state = "done" if process.returncode == 0 else f"FAILED ({process.returncode}), see {options.out / name}.log"
                print(f"{name}: {state}, {seconds[name]:.0f} s", flush=True)
                (options.out / "table.md").write_text(table(options, seconds) + "\n")
        time.sleep(0.5)
    print(table(options, seconds))


if __name__ == "__main__":
    main()
