"""Diagnose folders of tracks and material tests in several ways that should make no difference, and compare answers and figures.

    python benchmarks/independence.py FOLDER... --out runs/independence --effects drag_linear,drag_quadratic

Each folder is diagnosed as it is; with two threads; with `--minutes` 2 and 60; killed (SIGKILL) and started again; with its recordings in
another order; in another unit (mm or kPa); and a track also with its origin 10 m away; or in those of these ways that `--ways` names, and
on a GPU: `--ways "as it is" "on a GPU"`, which is what an experiment with bodies can be asked. The table in OUT/independence.md has the
answer, the effects, and how far the figures and the widths of their 90 % intervals are from those of the first way, in such widths.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import yaml

from neuido.data.files.writing import write_text
from neuido.data.progress import Progress

WAYS = ("as it is", "two threads", "--minutes 2", "--minutes 60", "killed, started again", "another order", "mm or kPa", "10 m away")
GPU = "on a GPU"
LENGTHS = ("x", "y", "z")
STRESSES = ("nominal_stress", "true_stress", "shear_stress")
STORED = 3
"""Stored predictions after which a diagnosis is killed."""


def rewritten(source: Path, target: Path, way: str) -> Path:
    """Write a folder in another order, unit or place, and return it; the folder itself for the other ways."""
    if way not in ("another order", "mm or kPa", "10 m away"):
        return source
    kind = next(name for name in ("track.yaml", "test.yaml") if (source / name).is_file())
    content = yaml.safe_load((source / kind).read_text())
    key = "recordings" if kind == "track.yaml" else "tests"
    entries = content[key]
    files: dict[tuple, str] = {}
    target.mkdir(parents=True)
    for number, entry in enumerate(entries):
        table = np.genfromtxt(source / entry["file"], delimiter=",", names=True, deletechars="", replace_space=" ")
        columns, scale = entry["columns"], {name: float(entry.get("scale", {}).get(name, 1.0)) for name in entry["columns"]}
        values = [np.asarray(table[title], dtype=np.float64) for title in columns.values()]
        for i, name in enumerate(columns):
            if way == "mm or kPa" and name in (*LENGTHS, *STRESSES):
                values[i], scale[name] = values[i] * 1e3, scale[name] / 1e3
            if way == "10 m away" and name in LENGTHS:
                values[i] = values[i] + 10.0 / scale[name]
        same = (entry["file"], *columns.items())  # tests of one specimen share a file
        entry["file"], entry["scale"] = files.setdefault(same, f"{number}.csv"), scale
        text = "\n".join(",".join(f"{value:.15g}" for value in row) for row in zip(*values))
        write_text(target / entry["file"], f"{','.join(columns)}\n{text}\n")
        entry["columns"] = {name: name for name in columns}
    if way == "another order":
        content[key] = entries[::-1]
    write_text(target / kind, yaml.safe_dump(content))
    return target


def diagnosed(folder: Path, out: Path, way: str, more: list[str]) -> dict:
    """Diagnose a folder in one way and return diagnosis.json; what is done is not done again."""
    if not (out / "diagnosis.json").is_file():
        minutes = way.split()[1] if way.startswith("--minutes") else "0"
        device = "cuda" if way == GPU else "cpu"
        command = [sys.executable, "-m", "neuido", "diagnose", str(folder), "--out", str(out), "--device", device, "--progress", "false"]
        command += ["--minutes", minutes, *more]
        environment = os.environ | {"OMP_NUM_THREADS": "2" if way == "two threads" else "1"}
        if way.startswith("killed"):
            process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL)
            while process.poll() is None and len(list(out.glob(".work/*/0/*.npy"))) < STORED:
                time.sleep(0.02)
            process.send_signal(signal.SIGKILL)
            process.wait()
        subprocess.run(command, env=environment, check=True, stdout=subprocess.DEVNULL)
    return json.loads((out / "diagnosis.json").read_text())


def figures(answer: dict) -> dict[str, tuple[float, float]]:
    """Return value and width of the interval of each parameter of the named effects."""
    found = {}
    for effect in answer["effects"]:
        for name, p in effect["parameters"].items():
            if "interval90" in p and not isinstance(p["value"], list):
                low, high = p["interval90"]
                found[f"{effect['name']}.{name}"] = p["value"], high - low
    return found


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--effects", default="", help="as of neuido diagnose; all where empty")
    parser.add_argument("--draws", default="39", help="as of neuido diagnose")
    parser.add_argument("--ways", nargs="+", choices=(*WAYS, GPU), default=WAYS, help="the first is what the others are compared with")
    options = parser.parse_args(arguments)
    more = ["--draws", options.draws, *(["--effects", options.effects] if options.effects else [])]
    rows = [
        "| folder | way | answer | effects | largest move of a figure | of a width | simulations |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    with Progress("diagnoses", len(options.folders) * len(options.ways), unit="diagnoses") as work:
        for folder in options.folders:
            first: dict = {}
            for way in options.ways:
                work.update()
                own = options.out / folder.name / way.replace(" ", "-").strip("-")
                if way == "10 m away" and not (folder / "track.yaml").is_file():
                    continue
                written = own.with_name(f"{own.name}-folder")
                answer = diagnosed(written if written.is_dir() else rewritten(folder, written, way), own, way, more)
                first = first or answer
                both = [(of, figures(first)[key]) for key, of in figures(answer).items() if key in figures(first)]
                moved = max((abs(v - before) / w for (v, _), (before, w) in both if w > 0), default=0.0)
                wider = max((abs(w / before - 1.0) for (_, w), (_, before) in both if before > 0), default=0.0)
                names = ", ".join(e["name"] for e in answer["effects"])
                count = answer["work"]["simulations"]
                rows.append(f"| {folder.name} | {way} | {answer['answer']} | {names} | {moved:.1g} | {wider:.1g} | {count} |")
    write_text(options.out / "independence.md", "\n".join(rows) + "\n")
    print("\n".join(rows))


if __name__ == "__main__":
    main()
