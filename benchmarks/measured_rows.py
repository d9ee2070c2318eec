"""Diagnose every row of real measurements as it is shipped, and write the page that judges the answers.

    python benchmarks/measured_rows.py run --out OUT [--rows treloar-rubber ...] [--minutes 15]
    python benchmarks/measured_rows.py page

`run` needs the data folder (NEUIDO_DATA). Raw curves and the plate go through `neuido import` first. Each row is one `neuido diagnose`
in a process of its own; its figures replace those of the row in research/results/measured_rows.csv. `page` makes
research/results/measured_rows.md of that file and of measured_known.yaml: what is known of a row, the judgement, and what its data
could not tell. A row that was not run again is in the page with the reason.
"""

import argparse
import csv
import json
import os
import resource
import subprocess
import sys
from collections.abc import Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import yaml

RESULTS = Path(__file__).resolve().parents[1] / "research" / "results"
CURVES = {
    "polystyrene-creep": "creep-polystyrene-160C",
    "polystyrene-oscillation": "oscillation-polystyrene",
    "emulsion": "flow-curve-emulsion-0.70",
}
PLATES = {  # row: declared law, and the noise of the displacements in units of the plate
    "plate-true-law": ("decoupled_neo_hookean", 1e-3),
    "plate-neo-hooke": ("neo_hookean", 1e-3),
    "plate-neo-hooke-quiet": ("neo_hookean", 1e-4),
    "plate-linear": ("linear", 1e-3),
}
STEPS = (10, 20, 30, 40)
FIELDS = "row body answer named in_class size unit before after over_floor said rivals notes seconds commit date".split()


def prepare(row: str, data: Path, folder: Path) -> Path:
    """Return the folder to diagnose for a row; a raw curve or plate is imported to `folder`."""
    if row in CURVES:
        neuido("import", str(data / "rheometer-curves" / f"{CURVES[row]}.csv"), "--out", str(folder))
    elif row in PLATES:
        _plate(data / "plate-known-truth", folder, *PLATES[row])
    else:
        return data / row
    return folder


def _plate(source: Path, folder: Path, law: str, noise: float) -> None:
    """Import the plate with noise in all displacements, and declare a law whose constants are off by 7 to 10 %."""
    raw, generator = folder.with_name(f"{folder.name}-raw"), np.random.default_rng(0)
    raw.mkdir(parents=True, exist_ok=True)
    for n in STEPS:
        table = np.genfromtxt(source / f"nodes_{n}.csv", delimiter=",", names=True)
        for axis in ("ux", "uy"):
            table[axis] += noise * generator.standard_normal(len(table))
        np.savetxt(raw / f"nodes_{n}.csv", table, delimiter=",", header=",".join(table.dtype.names), comments="", fmt="%.12g")
    files, options = [str(raw / f"nodes_{n}.csv") for n in STEPS], ["--elements", str(source / "elements.csv")]
    options += ["--forces", str(source / "reactions_*.csv"), "--units.displacement", "m", "--units.force", "N"]
    neuido("import", *files, *options, "--thickness", "1 m", "--condition", "strain", "--poisson", "0.35", "--out", str(folder))
    header = yaml.safe_load((folder / "plane.yaml").read_text())
    header["model"] = {"elasticity": {"law": law, "young": 2.5, "poisson": 0.38}, "free": ["young", "poisson"]}
    for recording in header["recordings"]:
        recording["noise"] = {"displacement": noise}
    (folder / "plane.yaml").write_text(yaml.safe_dump(header))


def neuido(*arguments: str) -> None:
    """Run the command line as shipped."""
    subprocess.run([sys.executable, "-m", "neuido", *arguments], check=True, stdout=subprocess.DEVNULL)


def diagnose(folder: Path, out: Path, minutes: float) -> tuple[dict[str, Any], float]:
    """Run `neuido diagnose` as shipped; return the content of diagnosis.json and the seconds of the processor."""
    begun = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    neuido("diagnose", str(folder), "--out", str(out), "--minutes", str(minutes), "--progress", "false", "--device", "cpu")
    return json.loads((out / "diagnosis.json").read_text()), resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - begun


def figures(row: str, c: Mapping[str, Any]) -> dict[str, Any]:
    """Return the row of the table for one body of a diagnosis."""
    effects, error = c["effects"], c["error"]
    judged = "held_out" if error["before"]["held_out"] is not None else "fit"
    first = c["words"][0] if c["words"] else ""
    rivals = [m for m in c["models"] if m["verdict"] in ("class", "rejected", "weighed")]
    own = {m["step"]: m["error_ratio"] for m in c["models"] if m["verdict"] == "named"}
    beside = [f"{m['name']} {own[m['step']] / m['error_ratio']:.2g}" for m in rivals if m["step"] in own]
    worst = error.get("worst_over_floor") or error["left_over_floor"]
    return {
        "row": row,
        "body": c.get("body", ""),
        "answer": c["answer"],
        "named": " + ".join(e["name"] for e in effects),
        "in_class": " ".join(dict.fromkeys(name for e in effects for name in e["class"] if name != e["name"])),
        "size": "; ".join(_size(e) for e in effects),
        "unit": error["unit"],
        "before": f"{error['before'][judged]:.3g}",
        "after": f"{error['after'][judged]:.3g}",
        "over_floor": "" if worst is None else f"{worst:.3g}",
        "said": "yes" if "something more" in first else "",
        "rivals": "; ".join(beside[:3]),
        "notes": "; ".join(c["why"]) or ("an error of the scale explains it as well" if "scale_error" in c else ""),
    }


def _size(effect: Mapping[str, Any]) -> str:
    """Return the first parameter of an effect with its interval."""
    name, p = next(iter(effect["parameters"].items()))
    low, high = p["interval90"]
    return f"{name} {p['value']:.3g} ({low:.3g} to {high:.3g}) {p['unit'] if p['unit'] != '1' else ''}".strip()


def run(rows: Sequence[str], out: Path, minutes: float) -> None:
    """Diagnose rows one after the other and put their figures into measured_rows.csv."""
    data = Path(os.environ["NEUIDO_DATA"]) / "measured"
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], check=True, capture_output=True, text=True).stdout.strip()
    for row in rows:
        content, seconds = diagnose(prepare(row, data, out / "folders" / row), out / row, minutes)
        found = [figures(row, c) for c in content.get("bodies", [content])]
        stamp = {"seconds": f"{seconds / len(found):.0f}", "commit": commit, "date": date.today().isoformat()}
        kept = [r for r in table() if r["row"] != row]
        with (RESULTS / "measured_rows.csv").open("w", newline="") as stream:
            writer = csv.DictWriter(stream, FIELDS, lineterminator="\n")
            writer.writeheader()
            writer.writerows([*kept, *(r | stamp for r in found)])
        for r in found:
            print(*(r[key] for key in ("row", "body", "answer", "named", "before", "after", "over_floor")), stamp["seconds"], flush=True)


def every_row() -> list[str]:
    """Return the rows of measured_known.yaml that are run on one core."""
    known = yaml.safe_load((RESULTS / "measured_known.yaml").read_text())["rows"]
    return list(dict.fromkeys(entry["row"] for entry in known if "earlier" not in entry))


def table() -> list[dict[str, str]]:
    """Return the rows of measured_rows.csv; none if it is not there."""
    path = RESULTS / "measured_rows.csv"
    if not path.is_file():
        return []
    with path.open(newline="") as stream:
        return list(csv.DictReader(stream))


def page() -> str:
    """Return the page that judges every row."""
    known = yaml.safe_load((RESULTS / "measured_known.yaml").read_text())
    rows = {(r["row"], r["body"]): r for r in table()}
    head = ("data", "answer", "size (90 %)", "error before, after", "over the floor", "rivals: times the error", "s")
    judged = ("data", "known", "judgement", "could not be told")

    def lines(cells: Sequence[str]) -> str:
        return "| " + " | ".join(cells) + " |"

    out = [known["title"], "", known["text"], "", lines(head), lines(["---"] * len(head))]
    for entry in known["rows"]:
        r = rows.get((entry["row"], entry.get("body", "")))
        out.append(lines(_line(entry, r)))
    out += ["", "## What is known, and what could not be told", "", lines(judged), lines(["---"] * len(judged))]
    out += [lines([entry["title"], entry["known"], entry["judged"], entry["untold"]]) for entry in known["rows"]]
    counts = {verdict: sum(e["verdict"] == verdict for e in known["rows"]) for verdict in ("right", "in class", "doubtful", "wrong")}
    return "\n".join([*out, "", "In all: " + ", ".join(f"{n} {verdict}" for verdict, n in counts.items()) + ".", ""])


def _line(entry: Mapping[str, Any], r: Mapping[str, str] | None) -> list[str]:
    if r is None:
        return [entry["title"], entry["earlier"], *[""] * 5]
    named = r["named"].replace("_", " ") or r["answer"]
    answer = named + (f" (or {', '.join(r['in_class'].split()).replace('_', ' ')})" if r["in_class"] else "")
    over, errors = r["over_floor"] + (", said" if r["said"] else ""), f"{r['before']}, {r['after']} {r['unit']}"
    return [entry["title"], answer, r["size"], errors, over, r["rivals"].replace("_", " "), r["seconds"]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    sub = parser.add_subparsers(dest="command", required=True)
    running = sub.add_parser("run")
    running.add_argument("--rows", nargs="*")
    running.add_argument("--out", type=Path, required=True)
    running.add_argument("--minutes", type=float, default=15.0)
    sub.add_parser("page")
    args = parser.parse_args()
    if args.command == "page":
        (RESULTS / "measured_rows.md").write_text(page())
        return
    run(args.rows or every_row(), args.out, args.minutes)


if __name__ == "__main__":
    main()
