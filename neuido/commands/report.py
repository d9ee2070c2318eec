"""The `report` command: one self-contained page of several runs, with tables, curves and videos side by side."""

import math
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from neuido.data.files.html_page import Best, escaped, figure, page, plain, style_axes, svg, table, video
from neuido.data.files.results import Entry, figures, labelled, logged_curves, mean, open_runs, scenes_of
from neuido.data.files.score_tables import read_rows
from neuido.errors import UserError

MEASURES = {  # name: (title, whether higher is better)
    "cd": ("Chamfer distance [1e-4, unit cube]", False),
    "rmse": ("RMSE of matched particles [m]", False),
    "iou": ("Silhouettes, intersection over union", True),
    "later_iou": ("Silhouettes of the frames that no fit has seen, intersection over union", True),
    "later_cd": ("Chamfer distance of the frames that no fit has seen [1e-4, unit cube]", False),
    "psnr": ("PSNR on held-out views [dB]", True),
    "ssim": ("SSIM on held-out views", True),
    "flip": ("ꟻLIP on held-out views", False),
    "lpips": ("LPIPS on held-out views", False),
    "crop_psnr": ("PSNR of the crop around the body [dB]", True),
    "crop_ssim": ("SSIM of the crop around the body", True),
    "crop_flip": ("ꟻLIP of the crop around the body", False),
    "crop_lpips": ("LPIPS of the crop around the body", False),
}
FLOOR, PAPER = "resampling floor", "paper: "
NOT_OURS = "Rows of the paper are quoted from it; its materials and images are others, so they compare in order of magnitude at most."
MOST_PANELS = 12


def report(
    runs: list[str],
    *,
    out: str = "report.html",
    title: str = "neuido: runs side by side",
    paper: str | None = None,
    videos: bool = True,
    limit: float = 30.0,
) -> None:
    """Write one self-contained page of several runs: scores side by side, curves over time, logged curves, videos; or of diagnoses.

    Best figures are bold. Beside the Chamfer distance stands its resampling floor: what a perfect law with other particles would score. A
    figure that a run does not have is left empty (LPIPS needs weights, `--model.lpips_backbone`).

    Results of `neuido diagnose`, of this version or an older one, give the page of a diagnosis, several of them with a table of all first.

    Args:
        runs: Folders of runs, of results, or of sweeps (whose runs then count one by one), or of diagnoses; `label=folder` gives a name.
        out: The page to write.
        title: Its title.
        paper: CSV of figures to quote beside, with columns `run`, `scene` and measures, or others; they are never bold.
        videos: Whether to put the videos of the scenes into the page.
        limit: Most megabytes of videos; what is beyond is named.

    Raises:
        UserError: A folder without results, a malformed table.
    """
    from neuido.data.files.writing import check_writable, write_text

    if not runs:
        raise UserError("runs is empty: name at least one folder")
    if Path(out).is_dir():
        raise UserError(f"out = {out} is a folder: name the page, such as {Path(out) / 'report.html'}")
    check_writable(Path(out).absolute().parent)
    diagnosed = _diagnoses(runs)
    if diagnosed is not None:
        target = Path(out)
        write_text(target, diagnosed)
        print(f"results in {target}")
        return
    entries = open_runs(runs)
    quoted = read_rows(paper) if paper else []
    parts = [f"<h1>{escaped(title)}</h1>", *_scores(entries, [row for row in quoted if "scene" in row])]
    parts += [*_costs(entries), *_last_logged(entries), *_quoted([row for row in quoted if "scene" not in row])]
    if quoted:
        parts.append(f'<p class="note">{NOT_OURS}</p>')
    parts += [*_spread(entries), *_by_frame(entries), *_logged(entries)]
    if videos:
        parts += _videos(entries, 1e6 * limit)
    target = Path(out)
    write_text(target, page(title, "\n".join(parts)))
    print(f"{len(entries)} runs, {len(scenes_of(entries))} scenes\nresults in {target}")


def _diagnoses(runs: Sequence[str]) -> str | None:
    """Return the page of diagnoses where the folders hold some; None where none of them does.

    Raises:
        UserError: Only some of them do.
    """
    named = [(label or folder.name, folder) for label, folder in map(labelled, runs)]
    there = [(folder / "diagnosis.json").is_file() for _, folder in named]
    if not any(there):
        return None
    if not all(there):
        raise UserError(f"runs: {named[there.index(False)][1]} holds no diagnosis.json, others do: name one kind of results at a time")
    from neuido.discrepancy import Diagnosis

    found = [(label, Diagnosis.read(folder)) for label, folder in named]
    if len(found) == 1:
        return found[0][1].page()
    from neuido.discrepancy.report.page import page

    parts = [
        (own.to_dict() | {"body": label if len(d.bodies) == 1 else f"{label}: {body}"}, own.motion())
        for label, d in found
        for body, own in d.bodies.items()
    ]
    return page([content for content, _ in parts], [motion for _, motion in parts], name=f"{len(found)} diagnoses")


class Line(NamedTuple):
    """One line of a table of scores: label and score in each scene."""

    label: str
    values: dict[str, float]
    """By scene."""
    counts: bool = True
    """Whether it may be the best."""


def lines_of(name: str, entries: Sequence[Entry], quoted: Sequence[dict[str, Any]]) -> list[Line]:
    """List the rows of a measure: one per run and per baseline of that run (`cd_random`), then the floor and the paper's value."""
    out = []
    for entry in entries:
        known = set(MEASURES)
        columns = [
            c for c in dict.fromkeys(c for row in entry.rows for c in row) if c == name or (c.startswith(f"{name}_") and c not in known)
        ]
        for column in columns:
            values = {str(row["scene"]): row[column] for row in entry.rows if isinstance(row.get(column), float)}
            rival = column.removeprefix(name).removeprefix("_")
            out.append(Line(f"{entry.label}, {rival}" if rival else entry.label, values))
    if out and name == "cd":
        floors = {s: row["floor"] for s in scenes_of(entries) for e in entries if "floor" in (row := e.row_of(s))}
        out.append(Line(FLOOR, floors, counts=False))
    labels = dict.fromkeys(str(row.get("run", "")) for row in quoted if name in row) if out else ()
    for label in labels:
        values = {str(row["scene"]): row[name] for row in quoted if str(row.get("run", "")) == label and name in row}
        out.append(Line(PAPER + label, values, counts=False))
    return out


def score_table(name: str, lines: Sequence[Line], scenes: Sequence[str], unseen: Sequence[str] = ()) -> str:
    """One measure: a row a line, a column a scene, the mean, and for the Chamfer distance the mean over that of the floor."""
    higher = MEASURES[name][1]
    columns = {s: [line.values.get(s, math.nan) for line in lines] for s in scenes}
    columns["mean"] = [mean([line.values.get(s) for s in scenes]) for line in lines]
    cells = {}
    for column, values in columns.items():
        own = [v for v, line in zip(values, lines) if line.counts and math.isfinite(v)]
        best = (max(own) if higher else min(own)) if len(own) > 1 else None
        shown = f"{best:.4g}" if best is not None else ""
        cells[column] = [Best(v) if line.counts and f"{v:.4g}" == shown else v for v, line in zip(values, lines)]
    head = ["", *(f"{s} (unseen)" if s in unseen else s for s in scenes), "mean"]
    rows = [[line.label, *(cells[column][i] for column in columns)] for i, line in enumerate(lines)]
    floors = next((line.values for line in lines if line.label == FLOOR), {})
    if floors:
        head.append("mean over floor")
        low = mean([floors.get(s) for s in scenes])
        rows = [[*row, math.nan if line.label.startswith(PAPER) else value / low] for row, line, value in zip(rows, lines, columns["mean"])]
    return table(head, rows)


def _scores(entries: list[Entry], quoted: list[dict[str, Any]]) -> list[str]:
    scenes = scenes_of(entries)
    unseen = [s for s in scenes if any(e.row_of(s).get("unseen") == 1 for e in entries)]
    parts = []
    for name, (title, higher) in MEASURES.items():
        lines = lines_of(name, entries, quoted)
        if any(line.counts and line.values for line in lines):
            parts.append(f"<h2>{title}, {'higher' if higher else 'lower'} is better</h2>{score_table(name, lines, scenes, unseen)}")
    if scenes and not any("lpips" in row for e in entries for row in e.rows):
        parts.append('<p class="note">LPIPS is absent: no run was given the weights of its network (--model.lpips_backbone).</p>')
    failed = [(e.label, row["scene"], row["failed"]) for e in entries for row in e.rows if row.get("failed")]
    if failed:
        parts.append("<h2>Failed</h2>" + table(("run", "scene", "reason"), failed))
    return parts


def _costs(entries: list[Entry]) -> list[str]:
    """Means over the scenes of all further figures: steps, seconds, memory."""
    known = ("scene", "failed", "unseen", "floor", "stage", "found_", "later_", *MEASURES)  # of beginnings
    columns = list(dict.fromkeys(c for e in entries for row in e.rows for c in row if not c.startswith(known)))
    rows = [(e.label, [mean([row[c] for row in e.rows if isinstance(row.get(c), float)]) for c in columns]) for e in entries if e.rows]
    told = [i for i in range(len(columns)) if any(math.isfinite(means[i]) for _, means in rows)]
    if not told:
        return []
    shown = [[label, *(means[i] for i in told)] for label, means in rows]
    return ["<h2>Cost and further figures, means over the scenes</h2>", table(["", *(columns[i] for i in told)], shown)]


def _last_logged(entries: list[Entry]) -> list[str]:
    """Of runs of sweeps: parameters, and the last value of what they logged."""
    runs = [e for e in entries if e.parameters and e.last]
    parameters = dict.fromkeys(p for e in runs for p in e.parameters)
    last = [{name: points[-1][1] for name, points in logged_curves(e.root).items()} for e in runs]
    names = [n for n in dict.fromkeys(n for own in last for n in own) if not n.startswith("train/") and n.count("/") == 1]
    if not names:
        return []
    rows = [(*(e.parameters.get(p, "") for p in parameters), *(own.get(n, math.nan) for n in names)) for e, own in zip(runs, last)]
    return ["<h2>What the runs logged last</h2>", table((*parameters, *names), rows)]


def _quoted(rows: list[dict[str, Any]]) -> list[str]:
    head = list(dict.fromkeys(c for row in rows for c in row))
    return ["<h2>The paper's</h2>", table(head, [[row.get(c) for c in head] for row in rows])] if rows else []


def _spread(entries: list[Entry]) -> list[str]:
    """Over runs that differ in their seeds alone: least, greatest, mean and deviation of the Chamfer distance."""
    seeds = [e for e in entries if e.last and e.parameters and e.rows and all("seed" in name for name in e.parameters)]
    if len(seeds) < 2:
        return []
    rows = []
    for scene in scenes_of(seeds):
        values = [row["cd"] for e in seeds if isinstance((row := e.row_of(scene)).get("cd"), float)]
        if len(values) > 1:
            middle, deviation = statistics.fmean(values) or math.nan, statistics.stdev(values)
            rows.append(
                (scene, len(values), min(values), max(values), middle, deviation, deviation / middle, (max(values) - min(values)) / middle)
            )
    head = ("scene", "seeds", "least", "greatest", "mean", "deviation", "deviation over mean", "range over mean")
    return ["<h2>Chamfer distance over seeds [1e-4]</h2>" + table(head, rows)] if rows else []


def _panels(count: int) -> tuple[Any, list[Any]] | None:
    columns = min(3, count)
    rows = -(-count // columns)
    drawn = figure(rows, columns, (3.6 * columns, 2.6 * rows))
    if drawn is None:
        return None
    made, axes = drawn
    for ax in axes.flat[count:]:
        ax.axis("off")
    return made, list(axes.flat[:count])


def _by_frame(entries: list[Entry]) -> list[str]:
    """Plot the Chamfer distance over time, one panel per scene."""
    found = {s: {e.label: rows for e in entries if (rows := e.by_frame(s))} for s in scenes_of(entries)}
    found = dict(list((s, own) for s, own in found.items() if own)[:MOST_PANELS])
    drawn = _panels(len(found)) if found else None
    if drawn is None:
        return []
    made, axes = drawn
    colours = {e.label: f"C{i % 10}" for i, e in enumerate(entries)}
    for ax, (scene, own) in zip(axes, found.items()):
        for label, rows in own.items():
            ax.plot(figures(rows, "frame"), figures(rows, "cd"), color=colours[label], lw=1, label=plain(label))
        rows = next(iter(own.values()))
        ax.plot(figures(rows, "frame"), figures(rows, "floor"), color="0.4", ls=":", lw=1, label=FLOOR)
        ax.set(title=plain(scene), yscale="log", xlabel="frame", ylabel="CD [1e-4]")
        style_axes(ax)
    axes[0].legend(fontsize=6, frameon=False)
    return ["<h2>Chamfer distance over time</h2>", svg(made)]


def _logged(entries: list[Entry]) -> list[str]:
    """Plot the logged quantities that are averages over scenes or families, one panel each."""
    found: dict[str, dict[str, list[tuple[float, float]]]] = {}
    for entry in entries:
        for name, points in logged_curves(entry.root).items() if entry.last else ():
            if name.count("/") <= 1 and len(points) > 1:
                found.setdefault(name, {})[entry.label] = points
    order = sorted(found, key=lambda name: (not name.startswith("train/"), not name.startswith("val/")))[:MOST_PANELS]
    drawn = _panels(len(order)) if order else None
    if drawn is None:
        return []
    made, axes = drawn
    for ax, name in zip(axes, order):
        for label, points in found[name].items():
            ax.plot(*zip(*points), lw=1, label=plain(label))
        if all(v > 0 for points in found[name].values() for _, v in points):
            ax.set_yscale("log")
        ax.set(title=plain(name), xlabel="step")
        style_axes(ax)
    axes[0].legend(fontsize=6, frameon=False)
    return ["<h2>Logged while training</h2>", svg(made)]


def _videos(entries: list[Entry], most: float) -> list[str]:
    """Show the videos of each scene side by side, until the page reaches its size limit."""
    parts, spent, left = [], 0, []
    for scene in scenes_of(entries):
        row = []
        for entry in entries:
            for path in entry.videos(scene):
                made = video(path, f"{entry.label}, {path.stem}") if spent < most else None
                if made is None or spent + len(made) > most:
                    left.append(str(path))
                else:
                    row.append(made)
                    spent += len(made)
        if row:
            parts.append(f"<h3>{escaped(scene)}</h3>" + "".join(row))
    if left:
        parts.append(f'<p class="note">Left out, unreadable or beyond the limit: {escaped(", ".join(left))}.</p>')
    return ["<h2>Videos: recorded left, predicted right</h2>", *parts] if parts else []
