"""Files and folders that appear under their names when they are whole, and never otherwise; links that are never followed."""

import contextlib
import os
import shutil
import socket
import uuid
from collections.abc import Iterator
from pathlib import Path

from neuido.errors import UserError


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike, *, keep_suffix: bool = False) -> Iterator[Path]:
    """Give the name of a temporary file beside a file; when the block ends it takes the file's place, for good and all at once.

    Several processes may write one file: each has a temporary name of its own. Where the block fails, as on a full disk, the temporary
    file goes and what was there before stays. A link is replaced, not followed.

    Args:
        path: The file; its folder is made.
        keep_suffix: Whether the temporary name ends as the file's does, for writers that go by it.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    hidden = temporary_path(path, path.suffix if keep_suffix else "")
    try:
        yield hidden
        _sync(hidden)
        os.replace(hidden, path)
    except BaseException:
        remove(hidden)
        raise
    _sync(path.parent)


@contextlib.contextmanager
def new_folder(path: str | os.PathLike) -> Iterator[Path]:
    """Give an empty temporary folder beside a folder; when the block ends it appears under that name. Where the block fails it goes.

    Raises:
        UserError: A folder with content, or a file, has the name by then.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    hidden = temporary_path(path)
    hidden.mkdir()
    try:
        yield hidden
        for part in sorted(hidden.rglob("*"), reverse=True):
            _sync(part)
        _sync(hidden)
        try:
            os.replace(hidden, path)
        except OSError as error:
            if path.exists():
                raise UserError(f"{path} was made by another process meanwhile, and is left as it is") from error
            raise
    except BaseException:
        remove(hidden)
        raise
    _sync(path.parent)


def temporary_path(path: Path, suffix: str = "") -> Path:
    """Return a name beside a file that no other process uses; what dead processes of this machine left beside it goes first."""
    host = "".join(c for c in socket.gethostname() if c.isalnum())[:20]
    old_name = path.with_name(f".{path.name}.tmp")  # of earlier versions
    if old_name.is_file():
        remove(old_name)
    for old in path.parent.glob(f".{_literal(path.name)}.{host}-*.tmp{_literal(suffix)}"):
        pid = old.name[len(path.name) + len(host) + 3 :].partition("-")[0]
        if pid.isdigit() and not process_lives(int(pid), unknown=True):
            remove(old)
    return path.with_name(f".{path.name}.{host}-{os.getpid()}-{uuid.uuid4().hex[:8]}.tmp{suffix}")


def remove(path: Path) -> None:
    """Remove a file, a folder with all that it holds, or a link, whose target stays."""
    if path.is_symlink() or path.is_file():
        path.unlink(missing_ok=True)
    elif path.is_dir():
        shutil.rmtree(path)


def make_real_folder(path: Path, what: str) -> Path:
    """Make a folder, or take the one that is there.

    Raises:
        UserError: It is a link, which could lead anywhere, or a file.
    """
    if path.is_symlink():
        raise UserError(f"{what} {path} is a link, and links are not followed here: remove it, or give another out")
    try:
        path.mkdir(parents=True, exist_ok=True)
    except FileExistsError as error:
        raise UserError(f"{what} {path} is a file: remove it, or give another out") from error
    return path


def check_writable(folder: Path, option: str = "out") -> None:
    """Refuse a folder that cannot be made or written, before long work begins; nothing is made.

    Raises:
        UserError: It is a file, lies below one, or may not be written.
    """
    there = folder
    while not there.exists() and there != there.parent:
        there = there.parent
    if not there.is_dir():
        raise UserError(f"{option} = {folder} cannot be a folder: {there} is a file")
    probe = there / f".{uuid.uuid4().hex}.tmp"
    try:
        probe.touch()
    except OSError as error:
        raise UserError(f"{option} = {folder} cannot be written: {str(error.strerror).lower()}") from error
    probe.unlink(missing_ok=True)


def _literal(text: str) -> str:
    """Return a text as a pattern of `glob` that matches it alone."""
    return "".join(f"[{c}]" if c in "*?[" else c for c in text)


def process_lives(pid: int, *, unknown: bool) -> bool:
    """Return whether a process of this host is alive; `unknown` where that cannot be asked, as on Windows."""
    if os.name != "posix":
        return unknown  # a signal of 0 would end it there
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:
        pass
    return True


def _sync(path: Path) -> None:
    if os.name != "posix":
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
