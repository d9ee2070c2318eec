"""Diagnoses of many folders by an engine: a task each, one table of all answers."""

import time
from collections.abc import Iterable
from pathlib import Path, PurePosixPath
from typing import Any

from neuido.commands.engines.outcome import Share
from neuido.commands.engines.task_folder import begin, finish, finished, is_address, joined, local_copy, written
from neuido.commands.engines.tasks import check_engine, map_tasks
from neuido.data.files.score_tables import write_rows
from neuido.data.files.writing import check_writable
from neuido.data.progress import Progress
from neuido.errors import UserError

TABLE = "diagnoses.csv"
UNDIGESTED = ("device", "resume", "progress")
"""Options that do not change what is asked."""


def diagnose_folder(folder: str, out: str, options: dict[str, Any]) -> dict[str, Any]:
    """Diagnose a folder into another one, unless it has the answer to the same data and options; return a row for the table."""
    from neuido.discrepancy import store, workflow

    with local_copy(folder) as source:
        _, place = workflow.kind_of(str(source))
        asked = {key: value for key, value in options.items() if key not in UNDIGESTED}
        asked |= {key: workflow.hash_of(asked[key]) for key in ("model", "law")}
        digest = store.plan_of(place, asked, out=Path(out))
        if options["resume"] and (row := finished(out, digest)) is not None:
            return row
        begun = time.monotonic()
        begin(out)
        with written(out) as target:
            found = workflow.diagnose(place, out=target, **options)
            bodies = found.bodies.values()
            row = {
                "answer": found.answer,
                "effects": " ".join("/".join((effect.name, *effect.alternatives)) for own in bodies for effect in own.effects),
                "before": found.error.before,
                "after": found.error.after,
                "unit": found.error.unit,
                "seconds": round(time.monotonic() - begun, 1),
                "error": "",
            }
        finish(out, digest, row)
    return row


def diagnose_folders(
    folders: Iterable[str], out: str, options: dict[str, Any], *, engine: str, address: str | None, share: Share, progress: bool
) -> int:
    """Diagnose folders into `out`/<name of the folder>, write a table of the answers, and return how many failed.

    Raises:
        UserError: Two folders have one name, `out` cannot be written, or the engine cannot be reached.
    """
    check_engine(engine, address, share)
    named = _by_name(folders)
    if not is_address(out):
        check_writable(Path(out).expanduser())
        out = str(Path(out).expanduser().absolute())
    files = {key: str(Path(options[key]).expanduser().absolute()) for key in ("model", "law") if options.get(key)}
    items = [(folder, joined(out, name), options | files) for name, folder in named.items()]
    rows: dict[str, dict[str, Any]] = {}
    names, failed = list(named), 0
    try:
        with Progress("diagnoses", len(items), shown=progress) as work:
            for outcome in map_tasks(diagnose_folder, items, engine=engine, address=address, share=share):
                name = names[outcome.number]
                rows[name] = {"name": name} | (outcome.value or {"answer": "failed", "error": outcome.error})
                failed += bool(outcome.error)
                work.print(f"[{len(rows)}/{len(items)}] {name}: {_told(rows[name])}")
                work.update()
    finally:
        if rows:
            _write_table(out, [rows[name] for name in names if name in rows])
    return failed


def _by_name(folders: Iterable[str]) -> dict[str, str]:
    """Return the folders by the names of their results."""
    named: dict[str, str] = {}
    for given in folders:
        folder = given if is_address(given) else str(Path(given).expanduser().absolute())
        name = PurePosixPath(folder.rstrip("/")).name if is_address(given) else Path(folder).resolve().name
        if name in (*named, "", TABLE) or name.startswith("."):
            other = f"as {named[name]}, and each" if name in named else "that results cannot have: each"
            raise UserError(f"folder = {given} has the name '{name}', {other} needs one of its own: rename it")
        named[name] = folder
    return named


def _told(row: dict[str, Any]) -> str:
    if row["error"]:
        return f"failed: {row['error']}"
    effects = f" ({row['effects']})" if row["effects"] else ""
    return f"{row['answer']}{effects}, error {row['before']:.3g} -> {row['after']:.3g} {row['unit']}"


def _write_table(out: str, rows: list[dict[str, Any]]) -> None:
    with written(out) as target:
        write_rows(target / TABLE, rows)
