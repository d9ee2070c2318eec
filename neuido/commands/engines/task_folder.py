"""Where a task reads and writes: a folder, or an address that fsspec knows (`s3://bucket/path`). A task that is done is not done again."""

import contextlib
import json
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from neuido.data.files.parsing import read_json
from neuido.data.files.writing import write_json
from neuido.errors import UserError, shortened
from neuido.physics.runtime.lazy import import_extra

MARK = ".task.json"
"""Written last: what the task was, by a digest, and what it returned."""


def is_address(path: str) -> bool:
    """Return whether a path is an address for fsspec and no path of this machine."""
    return "://" in path


def joined(path: str, name: str) -> str:
    """Return the place of a name below a folder or an address."""
    return f"{path.rstrip('/')}/{name}" if is_address(path) else str(Path(path) / name)


@contextlib.contextmanager
def local_copy(path: str) -> Iterator[Path]:
    """Yield a folder as it is, or a copy of the folder at an address."""
    if not is_address(path):
        yield Path(path)
        return
    system, place = _system(path)
    with tempfile.TemporaryDirectory(prefix="neuido-task-") as folder, _told(path):
        target = Path(folder) / place.rstrip("/").rpartition("/")[2]
        system.get(place.rstrip("/"), str(target), recursive=True)
        yield target


def finished(out: str, digest: str) -> Any:
    """Return what a task returned when it was done with the same digest, or None where it was not."""
    with tempfile.TemporaryDirectory(prefix="neuido-task-") as folder:
        path = Path(out) / MARK
        if is_address(out):
            (system, place), path = _system(out), Path(folder) / "mark.json"
            with _told(out):
                if system.exists(f"{place}/{MARK}"):
                    system.get_file(f"{place}/{MARK}", str(path))
        try:
            content = read_json(path)
        except UserError:  # there is none, or it is damaged
            return None
    return content.get("value") if isinstance(content, dict) and content.get("digest") == digest else None


@contextlib.contextmanager
def written(out: str) -> Iterator[Path]:
    """Yield a folder to write into: `out` itself, or of an address a temporary one, whose files are uploaded when the block ends."""
    if not is_address(out):
        yield Path(out)
        return
    with tempfile.TemporaryDirectory(prefix="neuido-task-") as folder:
        target = Path(folder) / "out"
        target.mkdir()
        yield target
        system, place = _system(out)
        with _told(out):
            for path in sorted(path for path in target.rglob("*") if path.is_file()):
                name = path.relative_to(target).as_posix()
                system.makedirs(f"{place}/{name}".rpartition("/")[0], exist_ok=True)
                system.put_file(str(path), f"{place}/{name}")


def begin(out: str) -> None:
    """Take the mark of an earlier task away, so that no cut result passes for a whole one."""
    if not is_address(out):
        (Path(out) / MARK).unlink(missing_ok=True)
        return
    system, place = _system(out)
    with _told(out):
        if system.exists(f"{place}/{MARK}"):
            system.rm_file(f"{place}/{MARK}")


def finish(out: str, digest: str, value: Any) -> None:
    """Mark a task as done, after all that it wrote."""
    content = {"format": "neuido-task/1", "digest": digest, "value": value}
    if not is_address(out):
        write_json(Path(out) / MARK, content)
        return
    system, place = _system(out)
    with _told(out):
        system.pipe_file(f"{place}/{MARK}", json.dumps(content).encode())


def _system(path: str) -> tuple[Any, str]:
    """Return the file system of an address, and the place in it."""
    fsspec = import_extra("fsspec", f"the address {path}", extra="scale")
    if path.startswith(("s3://", "s3a://")):
        import_extra("s3fs", f"the address {path}", extra="s3")
    try:
        return fsspec.core.url_to_fs(path)
    except (ImportError, ValueError) as error:
        raise UserError(f"{path} cannot be opened: {error}") from error


@contextlib.contextmanager
def _told(path: str) -> Iterator[None]:
    """Turn errors of a remote file system into one line."""
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        raise UserError(f"{path} cannot be reached: {shortened(f'{type(error).__name__}: {error}')}") from error
