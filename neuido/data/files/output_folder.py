"""The one policy for folders that commands write: a used folder is continued, refused or held by another process, never mixed.

* A folder is for one set-up, which a file in it says (`plan.json` or `setup.json`). The same set-up goes on with what is there; another
  one is refused in one line that names what differs and the option to change.
* A folder that holds other files is refused: nothing is added to it.
* One process at a time writes it, or one process a shard. The lock, `.lock-out` in the folder, names its owner; that of a process that died
  is taken over. Hidden files do not count as use.
"""

import contextlib
import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from neuido.data.files.lock import OwnedLock
from neuido.data.files.sweep_run import RUN_FILES
from neuido.data.files.writing import check_writable, made_folder, write_text
from neuido.errors import UserError

PLAN = "plan.json"
LOCK = ".lock-out"


@contextlib.contextmanager
def claimed_folder(
    path: Path,
    plan: Mapping[str, Any],
    held: str,
    *,
    file: str = PLAN,
    compared: str | None = None,
    option: str = "out",
    shard: int = 0,
    shards: int = 1,
    keeps: tuple[str, ...] = (),
) -> Iterator[Path]:
    """Make a folder for a set-up, or go on with one of the same set-up, and hold it while the block runs.

    Where it is refused, nothing is made or changed; nor where the block is, before it writes anything.

    Args:
        path: The folder.
        plan: The set-up, which JSON can hold.
        held: What the folder of another set-up is said to hold: "clips of another set-up".
        file: Name of the file with the set-up.
        compared: Key of the set-up whose entries the error compares; the whole set-up where absent.
        option: Name of the option that gives the folder.
        shard: Which share of the work this process does.
        shards: Number of shares; each has a lock of its own.
        keeps: Names of files and folders that may be there before the set-up is.

    Raises:
        UserError: The folder cannot be made or written, has another set-up or other files, or another process writes it.
    """
    check_writable(path, option)
    text = json.dumps(plan, indent=1, default=list) + "\n"
    _check_use(path, text, held, file, compared, option, keeps)
    with made_folder(path), held_folder(path, option=option, shard=shard, shards=shards):
        _check_use(path, text, held, file, compared, option, keeps)  # another process may have come first
        fresh = not (path / file).exists()
        if fresh:
            write_text(path / file, text)
        try:
            yield path
        except UserError:
            if fresh and shards == 1 and _content(path) == [file]:  # refused before anything was made
                (path / file).unlink()
            raise


@contextlib.contextmanager
def held_folder(path: Path, *, option: str = "out", shard: int = 0, shards: int = 1) -> Iterator[None]:
    """Hold a folder that is there while the block runs, alone or as one of several shards.

    Args:
        path: The folder.
        option: Name of the option that gives it.
        shard: Which share of the work this process does.
        shards: Number of shares.

    Raises:
        UserError: Another process writes it, or a shard whose work overlaps.
    """
    purpose = f"{option} = {path}"
    with OwnedLock(path / _name(shard, shards), purpose, keep=False):
        for other, own_shard, own_shards in _other_locks(path, shard, shards):
            if (shard - own_shard) % math.gcd(shards, own_shards) == 0:
                with OwnedLock(other, f"{purpose}, shard {own_shard} of {own_shards},", keep=False):
                    pass
        yield


def check_unused(path: Path, option: str = "out") -> None:
    """Refuse a folder that cannot be written or is in use already; nothing is made.

    Raises:
        UserError: It is a file, may not be written, or holds files.
    """
    check_writable(path, option)
    if used := _content(path):
        raise UserError(f"{option} = {path} is in use, it holds {_listed(used)}: give another {option}, or empty the folder")


def _check_use(path: Path, text: str, held: str, file: str, compared: str | None, option: str, keeps: tuple[str, ...]) -> None:
    there = path / file
    if there.is_file():
        found = _read(there)
        wanted = json.loads(text)
        if found != wanted:
            raise UserError(f"{path} holds {held}{_difference(found, wanted, compared)}: give another {option}, or remove the folder")
    elif used := [name for name in _content(path) if name not in (*keeps, *RUN_FILES)]:
        raise UserError(f"{option} = {path} is in use for something else, it holds {_listed(used)}: give another {option}")


def _content(path: Path) -> list[str]:
    """Return the names in a folder that are not hidden; none where there is no folder."""
    return sorted(entry.name for entry in path.iterdir() if not entry.name.startswith(".")) if path.is_dir() else []


def _listed(names: list[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def _read(path: Path) -> Any:
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError):
        return None


def _difference(found: Any, wanted: Any, key: str | None) -> str:
    old, new = (content.get(key) if key and isinstance(content, dict) else content for content in (found, wanted))
    if not isinstance(old, dict) or not isinstance(new, dict):
        return ""
    changed = [f"{name} is {old.get(name)} there and {value} here" for name, value in new.items() if old.get(name) != value]
    changed = [words if len(words) <= 100 else f"{words.split(' ')[0]} differs" for words in changed]
    return f" ({'; '.join(changed)})" if changed else ""


def _name(shard: int, shards: int) -> str:
    return LOCK if shards == 1 else f"{LOCK}-{shard}-of-{shards}"


def _other_locks(path: Path, shard: int, shards: int) -> list[tuple[Path, int, int]]:
    """Return the locks of other shards in a folder, with shard and number of shards."""
    found = []
    for other in path.glob(f"{LOCK}*"):
        words = other.name.removeprefix(LOCK).split("-")
        if other.name == LOCK:
            found.append((other, 0, 1))
        elif len(words) == 4 and words[2] == "of" and words[1].isdigit() and words[3].isdigit() and int(words[3]) > 1:
            found.append((other, int(words[1]), int(words[3])))
    return [each for each in found if each[0].name != _name(shard, shards)]
