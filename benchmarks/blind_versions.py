"""Diagnose the same blind cases by several versions of the code, and compare them by McNemar's exact test.

    python benchmarks/blind_versions.py run --out runs/versions --trees old=TREE --lanes new=10 old=10 --seeds 71 72 --seconds 560
    python benchmarks/blind_versions.py score --out runs/versions

`run` makes the cases of the seeds in turn by this version, and diagnoses each by this version (`new`) and by those in the named folders, in
so many processes each, all with the same limit of `--minutes`. No diagnosis begins that would not end within `--seconds`. Run again, the
command goes on with the cases that no process has taken. Only `score` opens the keys. It writes answers.csv (a row per diagnosis), work.csv
(simulations of each step) and versions.md: all scores, and on the cases that both versions of a pair answered how many only one got right.
"""

import argparse
import csv
import importlib
import importlib.util
import json
import math
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from scipy.stats import binomtest

REPOSITORY = Path(__file__).resolve().parents[1]
NEW = "new"
"""Name of this version."""
RESERVE = 20.0
"""Seconds beyond the limit of time that a diagnosis may take to write its report, and a lane to end."""
FAILED = {"answer": "failed", "effects": [], "error": {"noise_floor": math.nan, "discretisation_floor": 0.0,
          "before": {"held_out": math.nan}, "after": {"held_out": math.nan}}}  # fmt: skip
GROUPS = {
    "all": ("null", "nuisance", "one", "two", "outside"),
    "nulls, not named": ("null", "nuisance"),
    "one effect, in class": ("one",),
    "two effects, both in class": ("two",),
    "outside the library, unknown": ("outside",),
}


def claim(path: Path) -> bool:
    """Return whether this process is the first to make a file, which so marks work that is taken."""
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        path.touch(exist_ok=False)
    except FileExistsError:
        return False
    return True


def plan(options: argparse.Namespace) -> list[tuple[int, str, int, dict[str, Any]]]:
    """Return seed, name, own seed and options of each case: the first of every seed, then the second ones."""
    import blind

    plans = [blind.plan(options.cases, 0, s, particles=options.particles, seconds=options.recorded) for s in options.seeds]
    together = [[(seed, name, own, asdict(case)) for name, own, case in one] for seed, one in zip(options.seeds, plans, strict=True)]
    return [one for row in zip(*together, strict=True) for one in row]


def lane(options: argparse.Namespace) -> None:
    """Diagnose cases by one version, one after the other, until the time is up; the present version makes those that are missing."""
    import neuido

    version, makes = options.lane, options.lane == NEW
    assert Path(neuido.__file__).resolve().is_relative_to(options.trees[version].resolve()), neuido.__file__
    name = "neuido.discrepancy.workflow"
    door = importlib.import_module(name if importlib.util.find_spec(name) else "neuido.discrepancy.command")
    while time.time() + 60.0 * options.minutes + RESERVE < options.end:
        for seed, name, own, case in options.tasks:
            folder, place = options.out / "cases" / f"{seed}" / name, options.out / version / f"{seed}" / name
            if makes and not folder.is_dir() and claim(options.out / "making" / f"{seed}-{name}"):
                import blind

                blind.make_one(name, own, blind.Case(**case), str(folder.parent), options.device)
                claim(options.out / "made" / f"{seed}-{name}")
            if (options.out / "made" / f"{seed}-{name}").exists() and folder.is_dir() and claim(place.with_suffix(".taken")):
                diagnose(door, folder, place, options)
                break
        else:
            time.sleep(1.0)


def diagnose(door: Any, folder: Path, place: Path, options: argparse.Namespace) -> None:
    """Diagnose a case, and write how long that took beside the answer."""
    begun, error = time.monotonic(), ""
    place.mkdir(parents=True, exist_ok=True)
    try:
        door.diagnose(str(folder), out=str(place), device=options.device, minutes=options.minutes, progress=False)
    except Exception as caught:  # the case is scored as failed; go on with the others
        error = f"{type(caught).__name__}: {caught}"
    (place / "ended.json").write_text(json.dumps({"seconds": time.monotonic() - begun, "error": error}))
    print(f"{place.relative_to(options.out)}: {time.monotonic() - begun:.0f} s {error[:200]}", flush=True)
    if options.device != "cpu":
        import gc

        import torch

        gc.collect()
        torch.cuda.empty_cache()


def run(options: argparse.Namespace) -> None:
    """Start the lanes of both versions, which end by themselves."""
    end = time.time() + options.seconds
    (options.out / "plan.json").write_text(json.dumps(plan(options)))
    cores = sorted(os.sched_getaffinity(0))
    lanes: list[subprocess.Popen] = []
    for i, version in enumerate(name for name, count in options.lanes.items() for _ in range(int(count))):
        command = [sys.executable, __file__, "run", "--lane", version, "--end", str(end), *sys.argv[2:]]
        path = f"{options.trees[version]}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
        environment = os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1"}
        lanes.append(subprocess.Popen(command, env=environment))
        os.sched_setaffinity(lanes[-1].pid, {cores[i % len(cores)]})
    for one in lanes:
        try:
            one.wait(max(end + RESERVE - time.time(), 1.0))
        except subprocess.TimeoutExpired:
            one.kill()


def is_right(row: Mapping[str, Any], named: Sequence[str]) -> bool:
    """Return whether a row of scores is what a case asks for; a search that was cut off is not."""
    if row["group"] in ("null", "nuisance"):
        return row["answer"] in ("none", "insufficient", "unknown")
    if row["group"] == "outside":
        return row["answer"] in ("unknown", "insufficient")
    return row["answer"] in named and bool(row["in_class"])


def compared(rows: Mapping[str, Mapping[str, Mapping[str, Any]]], other: str, named: Sequence[str]) -> str:
    """Return a table of McNemar's exact test on the cases that both versions answered; `rows`: version -> case -> scores."""
    both = [case for case in rows[NEW] if case in rows[other]]
    titles = (
        "same cases",
        "number",
        "new right",
        f"{other} right",
        "new alone",
        f"{other} alone",
        "p",
        "median s, new",
        f"median s, {other}",
    )
    lines = ["| " + " | ".join(titles) + " |", "| " + " | ".join(["---"] * len(titles)) + " |"]
    for name, groups in GROUPS.items():
        own = [case for case in both if rows[NEW][case]["group"] in groups]
        right = [[is_right(rows[version][case], named) for case in own] for version in (NEW, other)]
        only = [sum(a and not b for a, b in zip(*pair, strict=True)) for pair in (right, right[::-1])]
        p = binomtest(only[0], sum(only)).pvalue if sum(only) else 1.0
        seconds = [f"{statistics.median(rows[version][case]['wall'] for case in own):.0f}" if own else "" for version in (NEW, other)]
        cells = (name, len(own), *map(sum, right), *only, f"{p:.2g}", *seconds)
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def score(options: argparse.Namespace) -> None:
    """Score all answers against the keys of their cases, and compare the versions."""
    import blind
    import blind_scores

    rows: dict[str, dict[str, dict[str, Any]]] = {}
    work = []
    for mark in sorted(options.out.glob("*/*/*/ended.json"), key=lambda mark: (mark.parents[2].name != NEW, mark)):
        version, seed, case = mark.parent.relative_to(options.out).parts
        answer = (blind.answers(mark.parent) or [FAILED])[0]
        key, ended, spent = blind.key_of(options.out / "cases" / seed / case), json.loads(mark.read_text()), answer.get("work") or {}
        row = {"version": version, "seed": seed, "case": case, **blind_scores.score(key, answer), "wall": round(ended["seconds"], 1)}
        row |= {"simulations": spent.get("simulations", answer.get("evaluations", "")), "ended_by": spent.get("ended_by", "")}
        rows.setdefault(version, {})[f"{seed}/{case}"] = row | {"leads": json.dumps(answer.get("leads") or []), "error": ended["error"]}
        work += [{"version": version, "seed": seed, "case": case, "step": step, **own}
                 for step, own in (spent.get("by_step") or {}).items()]  # fmt: skip
    everything = [row for own in rows.values() for row in own.values()]
    for path, table in ((options.out / "answers.csv", everything), (options.out / "work.csv", work)):
        if table:
            with path.open("w", newline="") as stream:
                writer = csv.DictWriter(stream, list(dict.fromkeys(key for row in table for key in row)))
                writer.writeheader()
                writer.writerows(table)
    columns = {version: blind_scores.summary(list(own.values())) for version, own in rows.items() if own}
    unfinished = [f"{sum(row['answer'] == 'unfinished' for row in own.values())} of {len(own)} {version}" for version, own in rows.items()]
    parts = [blind_scores.table(columns) if columns else "nothing is diagnosed yet", f"Unfinished: {', '.join(unfinished)}."]
    parts += [compared(rows, other, blind_scores.NAMED) for other in rows if other != NEW and NEW in rows]
    text = "\n\n".join(parts) + "\n"
    (options.out / "versions.md").write_text(text)
    print(text)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("run", "score"))
    parser.add_argument("--trees", nargs="*", default=[], help="NAME=FOLDER of the sources of each other version")
    parser.add_argument("--lanes", nargs="+", default=["new=1"], help="NAME=COUNT: processes of each version")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--cases", type=int, default=60, help="cases of a seed")
    parser.add_argument("--particles", type=int, default=0, help="as of blind.py")
    parser.add_argument("--recorded", type=float, default=0.0, help="as --seconds of blind.py")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--minutes", type=float, default=3.0, help="limit of time of a diagnosis [min]")
    parser.add_argument("--seconds", type=float, default=3600.0, help="time of the whole run [s]")
    parser.add_argument("--lane", help=argparse.SUPPRESS)
    parser.add_argument("--end", type=float, help=argparse.SUPPRESS)
    options = parser.parse_args()
    options.out = options.out.absolute()
    options.lanes = dict(one.split("=") for one in options.lanes)
    options.trees = {NEW: REPOSITORY} | {name: Path(tree).absolute() for name, tree in (one.split("=") for one in options.trees)}
    if missing := set(options.lanes) - set(options.trees):
        parser.error(f"--trees has no folder for {', '.join(sorted(missing))}")
    options.out.mkdir(parents=True, exist_ok=True)
    if options.what == "score":
        score(options)
    elif options.lane:
        options.tasks = json.loads((options.out / "plan.json").read_text())
        lane(options)
    else:
        run(options)


if __name__ == "__main__":
    main()
