"""Blind test of diagnoses: experiments with or without an undeclared effect, diagnosed without their keys and then scored against them.

    python benchmarks/blind.py --out runs/blind [--cases 60] [--curves 0] [--workers N] [--gpus 1] [--device cpu]
                               [--engine local|ray] [--address HOST:PORT]
                               [--minutes 0] [--ablation single-recording no-discretisation] [--statistics]
                               [--only make|diagnose|score|replay] [--folders FOLDER ...]

A third of the cases are nulls, half of them with wrong nuisance parameters. The others are spread evenly over the effects of the library;
some have two effects, and some an effect outside the library. Three solvers generate the cases in turn. Existing results are kept, so the
command resumes where it was stopped. Only the scoring opens the keys, after the digests of the answers are in results.csv.

The ablations `plain-bic`, `no-unknown` and `take-smallest-error` are computed from the full run and are always scored; `single-recording`
and `no-discretisation` need runs of their own. `--folders` scores the given folders instead, each with a truth.yaml or a key in ../keys.
`--statistics` keeps the fits of each case in its answer's folder; then `--only replay` decides every case again from them, within seconds
and without a simulation, and reports apart whether the search fitted the true effects and whether the decision named them (replay.csv).
Beside it stands what the evidence of the same fits would say (`neuido.discrepancy.inference.evidence`, experimental).
A GPU runs one case at a time unless `--workers` is given; with NVIDIA's MPS and twenty workers the throughput is about three times higher.
"""

import argparse
import csv
import dataclasses
import gc
import hashlib
import json
import math
import os
import shutil
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml

sys.path.insert(0, str(Path(__file__).parent))
import blind_scores

from neuido.commands.engines.outcome import Share
from neuido.commands.engines.tasks import ENGINES, map_tasks
from neuido.data.files.parsing import read_yaml
from neuido.data.files.writing import atomic_write, write_text
from neuido.data.undeclared import Case, make_undeclared
from neuido.data.undeclared.random_effects import KINDS, OUTSIDE
from neuido.errors import UserError

RERUN = ("single-recording", "no-discretisation")
SOLVERS = ("same", "finer", "elements")
ATTEMPTS = 16
PAIRS = (
    "drag_linear+yield", "uniform_acceleration+viscosity_shear", "friction+stiffness_gradient", "gravity+strain_stiffening",
    "magnus+softening", "drag_quadratic+hardening", "restitution+fibre", "friction+viscosity_shear", "position_force+yield",
    "drag_linear+friction",
)  # fmt: skip


def plan(cases: int, curves: int, seed: int, *, particles: int = 0, seconds: float = 0.0) -> list[tuple[str, int, Case]]:
    """Return names, seeds and options of the cases in random order."""
    rng = np.random.default_rng(seed)
    nulls, two, outside = round(cases / 3), round(cases * 5 / 60), round(cases * 5 / 60)
    kinds: list[tuple[str, bool]] = [("none", i < nulls // 2) for i in range(nulls)]

    def deal(names: tuple[str, ...], count: int) -> list[str]:
        """Return `count` names in which the numbers of occurrences differ by at most one."""
        order = [str(name) for _ in range(count // len(names) + 1) for name in rng.permutation(names)]
        return order[:count]

    kinds += [(k, False) for k in deal(PAIRS, two)] + [(k, False) for k in deal(tuple(OUTSIDE), outside)]
    kinds += [(k, False) for k in deal(tuple(KINDS), cases - len(kinds))]
    made = []
    for i, (kind, off) in enumerate(kinds):
        solver: str | None = SOLVERS[i % 3]
        if kind == "cohesion" or any((KINDS | OUTSIDE)[k].grid for k in kind.split("+") if k != "none"):
            solver = SOLVERS[i % 2]
        made.append(Case(kind=kind, nuisances=off, solver=solver, particles=particles, seconds=seconds))
    made += [Case(measured=("material_test", "track", "material_test", "guided")[i % 4]) for i in range(curves)]
    return [(f"case-{n:03d}", 1000 * seed + int(i), made[i]) for n, i in enumerate(rng.permutation(len(made)))]


def make_one(name: str, seed: int, case: Case, folder: str, device: str) -> str:
    """Generate a case and return an empty string, or the reason of the failure.

    If a seed fails, others are tried; the second half of the attempts uses the suggested solver, because for some bodies the difference
    between solvers exceeds any effect.
    """
    for attempt in range(ATTEMPTS):
        if 2 * attempt == ATTEMPTS:
            case = dataclasses.replace(case, solver=SOLVERS[0])
        try:
            make_undeclared(seed + 100_000 * attempt, str(Path(folder) / name), case=case, device=device, progress=False)
            return ""
        except UserError as error:
            reason = str(error)
        except Exception as error:  # such as a GPU out of memory: go on with the other cases; the same command retries this one
            return f"{type(error).__name__}: {error}"
        finally:
            free_memory(device)
    return reason


def free_memory(device: str) -> None:
    """Free the GPU memory that the last case of a worker still holds; otherwise twenty workers would fill a GPU."""
    if device != "cpu":
        import torch

        gc.collect()
        torch.cuda.empty_cache()


def diagnose_one(folder: str, out: str, ablation: str, device: str, minutes: float = 0.0, statistics: bool = False) -> str:
    """Diagnose a folder into `out` within a time limit [min] (0: none); return an empty string, or the reason of the failure."""
    from neuido.discrepancy import workflow
    from neuido.discrepancy.inference.search import attribution
    from neuido.discrepancy.report import answer

    target = Path(out)
    try:
        if ablation == "no-discretisation":
            kind, place = workflow.kind_of(folder)
            target.mkdir(parents=True, exist_ok=True)
            found = []
            for problem in workflow.problems_of(kind, place, None, device):
                begun = time.monotonic()
                if problem.settings > 1:
                    problem = dataclasses.replace(problem, settings=1, solvers=(0,))
                found.append((attribution.diagnose(problem, seconds=60.0 * minutes or math.inf), time.monotonic() - begun))
            answer.write(target, found, kind=kind, device=device)
        else:
            given = folder
            if ablation == "single-recording":
                given = str(_with_one_recording(Path(folder), target.parent / ".inputs" / target.name))
            workflow.diagnose(given, out=out, device=device, minutes=minutes, statistics=statistics, progress=False)
    except Exception as error:  # the case is scored as failed; go on with the others
        target.mkdir(parents=True, exist_ok=True)
        (target / "failed.txt").write_text(f"{type(error).__name__}: {error}\n")
        return f"{type(error).__name__}: {error}"
    finally:
        free_memory(device)
    (target / "failed.txt").unlink(missing_ok=True)
    return ""


def _with_one_recording(folder: Path, target: Path) -> Path:
    """Copy a measured folder without its held-out recordings; return the copy."""
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(folder, target, ignore=shutil.ignore_patterns("truth.yaml", "README.md"))
    for file in ("experiment.yaml", "test.yaml", "track.yaml"):
        if (target / file).is_file():
            content = yaml.safe_load((target / file).read_text())
            part = "tests" if file == "test.yaml" else "recordings"
            content[part] = [r for r in content[part] if r["role"] == "fit"]
            (target / file).write_text(yaml.safe_dump(content, sort_keys=False))
    return target


def in_parallel(work, tasks: list[tuple], options: argparse.Namespace) -> Iterator[tuple[tuple, Any]]:
    """Run tasks by the engine that the options name; yield (task, result) as they finish."""
    workers = options.workers or (2 if options.device == "cpu" else 1)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    gpus = 0.0 if options.device == "cpu" else min(options.gpus / workers, 1.0)
    share = Share(cores // workers if workers <= cores else cores / workers, gpus)
    for outcome in map_tasks(work, tasks, engine=options.engine, address=options.address, share=share, most=workers):
        yield tasks[outcome.number], outcome.error or outcome.value


def record(path: Path, row: dict[str, Any]) -> None:
    """Append a row to a CSV file."""
    fresh = not path.exists()
    with path.open("a", newline="") as stream:
        writer = csv.DictWriter(stream, list(row))
        if fresh:
            writer.writeheader()
        writer.writerow(row)


def write_table(path: Path, rows: list[dict[str, Any]]) -> None:
    """Write rows as a CSV file with all digits, which appears when it is whole."""
    with atomic_write(path) as hidden:
        for row in rows:
            record(hidden, row)


def key_of(folder: Path) -> dict[str, Any]:
    """Return the key of a case after checking its digest against the README of the case; without a key, the truth.yaml of the folder."""
    path = folder.parent / "keys" / f"{folder.name}.yaml"
    if not path.is_file():
        return read_yaml(folder / "truth.yaml")
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    if digest not in (folder / "README.md").read_text():
        raise SystemExit(f"{path} is not the key that {folder}/README.md sealed")
    return read_yaml(path)


def answers(folder: Path) -> list[dict[str, Any]] | None:
    """Return the diagnoses of a folder, one for each body, or None if there is none yet."""
    if (folder / "failed.txt").is_file():
        none = {"held_out": float("nan")}
        error = {"noise_floor": float("nan"), "discretisation_floor": 0.0, "before": none, "after": none}
        return [{"answer": "failed", "effects": [], "error": error}]
    if not (folder / "diagnosis.json").is_file():
        return None
    content = json.loads((folder / "diagnosis.json").read_text())
    return content.get("bodies", [content])


def score_all(folders: list[Path], out: Path, ablations: list[str]) -> str:
    """Score all existing answers, write scores.csv, and return the table."""
    columns, everything = {}, []
    for how in ("none", *ablations, *blind_scores.FROM_TRACE):
        rows = []
        for folder in folders:
            place = out / "answers" / ("none" if how in blind_scores.FROM_TRACE else how) / folder.name
            found = answers(place)
            if found is None:
                continue
            key = key_of(folder)
            if how in blind_scores.FROM_TRACE and found[0]["answer"] != "failed":
                trace = json.loads((place / "trace.json").read_text())
                found = [blind_scores.ablated(how, d, t) for d, t in zip(found, trace.get("bodies", [trace]), strict=True)]
            rows += [{"case": folder.name, "ablation": how} | blind_scores.score(key, d) for d in found]
        if rows:
            columns["full" if how == "none" else how] = blind_scores.summary(rows)
            everything += rows
    if not everything:
        return "nothing is diagnosed yet"
    write_table(out / "scores.csv", everything)
    return blind_scores.table(columns)


def replay_all(folders: list[Path], out: Path) -> str:
    """Decide all cases again from their kept fits, write replay.csv, and return the table of search recall and decision accuracy."""
    from neuido.discrepancy.inference.calibration import calibration
    from neuido.discrepancy.inference.evidence import evidences, judged
    from neuido.discrepancy.inference.search.decision import decide
    from neuido.discrepancy.inference.statistics import read_fits

    rows = []
    for folder in folders:
        place = out / "answers" / "none" / folder.name
        for i, diagnosis in enumerate(answers(place) or []):
            if (place / "fits" / f"{i}.npz").is_file():
                case, fits = read_fits(place / "fits" / f"{i}.npz")
                key = key_of(folder)
                row = {"case": folder.name} | blind_scores.replayed(key, diagnosis, case, decide(case))
                verdict = judged(evidences(case, fits), calibration()) if any(not fit.record.effects for fit in fits) else None
                rows.append(row | blind_scores.by_evidence(key, diagnosis, case, verdict))
    if not rows:
        return "no case has kept fits: diagnose with --statistics"
    write_table(out / "replay.csv", rows)
    return blind_scores.table({"replayed": blind_scores.recall(rows)})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/blind"))
    parser.add_argument("--cases", type=int, default=60)
    parser.add_argument("--curves", type=int, default=0, help="additional cases: material tests, tracks of flights and of guided bodies")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, help="number of parallel processes; default: 2 on the CPU, 1 on a GPU")
    parser.add_argument("--gpus", type=int, default=1, help="number of GPUs over which the processes are spread")
    parser.add_argument("--engine", choices=ENGINES, default="local", help="processes of this machine, or a Ray cluster")
    parser.add_argument("--address", help="address of the Ray cluster, whose machines see the folders")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--minutes", type=float, default=0.0, help="time limit of a diagnosis [min]; 0: none")
    parser.add_argument("--ablation", nargs="*", choices=RERUN, default=[])
    parser.add_argument("--only", choices=("make", "diagnose", "score", "replay"))
    parser.add_argument("--statistics", action="store_true", help="keep what each decision rests on in ANSWER/fits, for --only replay")
    parser.add_argument("--folders", nargs="+", type=Path, help="diagnose and score these folders instead of generated ones")
    parser.add_argument("--particles", type=int, default=0, help="particles of a body; 0: 1500 to 3000")
    parser.add_argument("--seconds", type=float, default=0.0, help="duration of the recordings of a body [s]; 0: 0.4 to 0.6")
    options = parser.parse_args()
    options.out = options.out.absolute()  # workers may start elsewhere
    options.out.mkdir(parents=True, exist_ok=True)
    if options.folders:
        folders = [folder.resolve() for folder in options.folders]
    else:
        cases = plan(options.cases, options.curves, options.seed, particles=options.particles, seconds=options.seconds)
        folders = [options.out / "cases" / name for name, *_ in cases]
        if options.only in (None, "make"):
            missing = [(*one, str(options.out / "cases"), options.device) for one in cases if not (options.out / "cases" / one[0]).is_dir()]
            for n, (task, failed) in enumerate(in_parallel(make_one, missing, options), 1):
                print(f"made {n} of {len(missing)}: {task[0]}{': FAILED, ' + failed if failed else ''}", flush=True)
        folders = [folder for folder in folders if folder.is_dir()]
    if options.only in (None, "diagnose"):
        places = [(f, options.out / "answers" / how / f.name, how) for how in ("none", *options.ablation) for f in folders]
        asked = [(str(folder), str(place), how, options.device, options.minutes, options.statistics) for folder, place, how in places]
        waiting = [task for task in asked if not (Path(task[1]) / "diagnosis.json").is_file()]
        for n, (task, failed) in enumerate(in_parallel(diagnose_one, waiting, options), 1):
            place = Path(task[1])
            found = answers(place) or []
            digest = "" if failed else hashlib.sha256((place / "diagnosis.json").read_bytes()).hexdigest()
            row = {"case": place.name, "ablation": task[2], "answer": " ".join(d["answer"] for d in found),
                   "named": " ".join(e["name"] for d in found for e in d["effects"]), "sha256": digest, "failed": failed}  # fmt: skip
            record(options.out / "results.csv", row)
            print(f"{n} of {len(waiting)}: {row['case']} ({task[2]}): {row['answer']} {row['named']} {failed}", flush=True)
    if options.only == "replay":
        text = replay_all(folders, options.out)
        write_text(options.out / "replay.md", text + "\n")
        print(text)
    if options.only in (None, "score"):
        text = score_all(folders, options.out, options.ablation)
        write_text(options.out / "table.md", text + "\n")
        print(text)


if __name__ == "__main__":
    main()
