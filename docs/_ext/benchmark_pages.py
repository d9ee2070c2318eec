"""The benchmark pages, made from research/results and its index."""

import csv
import re
import shutil
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "research" / "results"
LONGEST = 40


def benchmark_pages() -> dict[str, str]:
    """Return the pages of the benchmarks by their place under docs/generated."""
    entries = yaml.safe_load((RESULTS / "index.yaml").read_text())
    pages, rows = {}, []
    for entry in entries:
        page = Path(entry["file"]).stem
        pages[f"benchmarks/{page}.md"] = _page(entry)
        rows.append(f"| [{entry['title']}](benchmarks/{page}.md) | {entry['machine']} | {entry['date']} | `{entry['command']}` |")
    toc = "\n".join(f"benchmarks/{Path(e['file']).stem}" for e in entries)
    pages["benchmarks.md"] = (
        "# Benchmarks\n\nEvery table is made from the files in `research/results`. Bodies of the literature and measured data\n"
        "come from the data folder. "
        "Times of shared machines are upper bounds, and say so.\n\n| what | machine | date | command |\n| --- | --- | --- | --- |\n"
        + "\n".join(rows)
        + f"\n\n```{{toctree}}\n:hidden:\n\n{toc}\n```\n"
    )
    return pages


def _page(entry: dict) -> str:
    text = (RESULTS / entry["file"]).read_text()
    body = re.sub(r"\A# .*\n", "", text)
    pictures = ROOT / "docs" / "generated" / "benchmarks"
    pictures.mkdir(parents=True, exist_ok=True)
    for target in re.findall(r"!\[[^\]]*\]\(([^)]+)\)", body):
        shutil.copyfile(RESULTS / target, pictures / target)
    body = re.sub(r"(?<!!)\[([^\]]+)\]\((?!http|#)[^)]+\)", r"\1", body)  # links between files of the repository
    facts = f"| machine | date | command |\n| --- | --- | --- |\n| {entry['machine']} | {entry['date']} | `{entry['command']}` |\n"
    raw = "".join(_raw(RESULTS / name) for name in entry["raw"])
    return f"# {entry['title']}\n\n{facts}\n{body}\n{raw}"


def _raw(path: Path) -> str:
    """Return a raw file as a section: its table, or where that is long how many rows it has."""
    title = f"\n## As written: {path.name}\n\n"
    if path.suffix == ".md":
        return title + re.sub(r"^# .*\n", "", path.read_text()) + "\n"
    with path.open() as file:
        head, *rows = list(csv.reader(file))
    shown = [head, ["---"] * len(head), *rows[:LONGEST]]
    more = f"\n{len(rows) - LONGEST} more rows in `research/results/{path.name}`.\n" if len(rows) > LONGEST else ""
    return title + "\n".join("| " + " | ".join(cell.replace("|", " or ") for cell in row) + " |" for row in shown) + "\n" + more
