"""Print tables of laws inferred from video, from the scores that `neuido test` and `neuido fit` write.

    python benchmarks/tables.py stage2 research/results/stage2.csv research/results/stage2_ten.csv [--before FILE ...]
    python benchmarks/tables.py methods research/results/table1.csv

As in the files, CD and its floor are times 1e4. RMSE is in 1e-3 of the unit cube.
"""

import argparse
import csv
from collections.abc import Iterable, Sequence
from pathlib import Path
from statistics import mean

STAGE2 = ("cd", "floor", "rmse", "psnr", "ssim", "crop_psnr", "crop_ssim", "seconds")
METHODS = ("cd", "rmse", "psnr", "ssim", "crop_psnr", "steps", "seconds", "peak_memory_gb")
SCALES = {"rmse": 1e3}
DIGITS = {"steps": 4, "seconds": 2, "peak_memory_gb": 2}
"""Significant digits of figures for which three are unsuitable."""


def read(files: Iterable[Path]) -> list[dict[str, str]]:
    """Return the rows of CSV files, concatenated."""
    rows = []
    for file in files:
        with file.open(newline="") as stream:
            rows += list(csv.DictReader(stream))
    return rows


def shown(rows: Sequence[dict[str, str]], key: str, factor: float = 1.0) -> str:
    """Return the mean of a figure over rows as text; empty if a row lacks it."""
    values = [row.get(key) or "" for row in rows]
    if not rows or not all(values):
        return ""
    return f"{factor * SCALES.get(key, 1.0) * mean(map(float, values)):.{DIGITS.get(key, 3)}g}"


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    return "\n".join("| " + " | ".join(row) + " |" for row in (head, ["---"] * len(head), *rows))


def stage2(files: Sequence[Path], before: Sequence[Path]) -> str:
    """Return a table of zero-shot laws by scene with the means of each file, and a comparison with uninformed latents on unseen scenes."""
    earlier = {row["scene"]: row for row in read(before)}

    def figures(rows: Sequence[dict[str, str]]) -> list[str]:
        return [shown(rows, key, 1e3 if key == "seconds" else 1.0) for key in STAGE2]

    head = ["scene", "CD", "floor", "RMSE [1e-3]", "PSNR", "SSIM", "PSNR, crop", "SSIM, crop", "ms", "CD before Stage II"]
    out, unseen = [], []
    for file in files:
        rows = read([file])
        for row in rows:
            name = row["scene"] + (", unseen" if row.get("unseen") == "1" else "")
            out.append([name, *figures([row]), shown([earlier[row["scene"]]], "cd") if row["scene"] in earlier else ""])
        seen = [row for row in rows if row.get("unseen") != "1"]
        out.append([f"**{len(seen)} training scenes of {file.stem}, mean**", *figures(seen), ""])
        unseen += [row for row in rows if row.get("unseen") == "1"]
    text = table(head, out)
    if unseen:
        own = []
        for row in unseen:
            ratio = float(row["cd_random"]) / float(row["cd"])
            rivals = [shown([row], key) for key in ("cd", "cd_mean", "cd_random", "cd_trained")]
            own.append([row["scene"], *rivals, f"{ratio:.1f}", f"{float(row['modulus']):.3g}"])
        text += "\n\n" + table(["scene", "CD", "mean latent", "random", "of Stage I", "random / ours", "modulus found [Pa]"], own)
    return text


def both(row: dict[str, str] | None) -> str:
    """Return CD and PSNR of a row as text, or why they are missing."""
    if row is None:
        return "not run"
    return f"{shown([row], 'cd')} / {shown([row], 'psnr')}" if row.get("cd") else "fails"


def methods(file: Path) -> str:
    """Return a table of means over the scenes that ran, by run and stage, and a table of CD and PSNR by scene."""
    rows = read([file])
    groups: dict[tuple[str, str], list[dict[str, str]]] = {}
    for row in rows:
        groups.setdefault((row["run"], row["stage"]), []).append(row)
    head = ["run", "stage", "scenes", "CD", "CD / floor", "RMSE [1e-3]", "PSNR", "SSIM", "PSNR, crop", "steps", "s a scene", "GB"]
    out, scenes = [], list(dict.fromkeys(row["scene"] for row in rows))
    by_scene = []
    for (run, stage), own in groups.items():
        good = [row for row in own if row.get("cd")]
        figures = [shown(good, key) for key in METHODS]
        share = f"{mean(float(row['cd']) for row in good) / mean(float(row['floor']) for row in good):.3g}" if good else ""
        out.append([run, stage, f"{len(good)}/{len(scenes)}", figures[0], share, *figures[1:]])
        found = {row["scene"]: row for row in own}
        by_scene.append([run, stage, *(both(found.get(s)) for s in scenes)])
    return table(head, out) + "\n\nCD / PSNR:\n\n" + table(["run", "stage", *scenes], by_scene)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=("stage2", "methods"))
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--before", nargs="*", type=Path, default=[])
    options = parser.parse_args()
    print(stage2(options.files, options.before) if options.kind == "stage2" else methods(options.files[0]))


if __name__ == "__main__":
    main()
