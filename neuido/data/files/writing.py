"""Atomic writing: files and folders get their final name only when complete. Links are never followed."""

import contextlib
import hashlib
import json
import os
import shutil
import socket
import uuid
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuido.errors import UserError

if TYPE_CHECKING:
    import numpy as np


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike, *, keep_suffix: bool = False, digest: bool = False) -> Iterator[Path]:
    """Write a file atomically: yield a temporary path, and rename it to `path` when the block ends.

    The data are synchronised to disk before the renaming; inside of a `new_folder`, when that ends. If the block raises, as on a full
    disk, the temporary file is removed and an earlier file stays unchanged. Several processes may write the same file, because each has
    its own temporary path. A link is replaced, not followed.

    Args:
        path: The file; its folder is created if it does not exist.
        keep_suffix: Whether the temporary path has the suffix of `path`, for writers that depend on it.
        digest: Whether a hidden file beside it notes the SHA-256 of what was written, for `is_as_written`.
    """
    path = Path(path)
    with made_folder(path.parent):
        hidden = temporary_path(path, path.suffix if keep_suffix else "")
        try:
            yield hidden
            durable = not _in_new_folder(path)
            if durable:
                _sync(hidden)
            if digest:
                write_text(_note_of(path), f"{sha256_of(hidden)}\n")
            os.replace(hidden, path)
        except BaseException:
            remove(hidden)
            raise
        if durable:
            _sync(path.parent)


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file's content."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def is_as_written(path: Path, *, unnoted: bool = False) -> bool:
    """Return whether a file has the content that `atomic_write(..., digest=True)` noted.

    Args:
        path: The file.
        unnoted: What is returned where nothing is noted, as of files of earlier versions.
    """
    noted = noted_digest(path)
    if noted is None:
        return unnoted
    return path.is_file() and noted == sha256_of(path)


def noted_digest(path: Path) -> str | None:
    """Return the SHA-256 that `atomic_write(..., digest=True)` noted of a file; none where nothing is noted."""
    note = _note_of(path)
    return note.read_text().strip() if note.is_file() else None


def _note_of(path: Path) -> Path:
    return path.with_name(f".{path.name}.sha256")


def _in_new_folder(path: Path) -> bool:
    """Return whether a file lies in a folder under its temporary name, which is synchronised as a whole."""
    return any(parent.name.startswith(".") and parent.name.endswith(".tmp") for parent in path.parents)


def write_text(path: Path, text: str) -> None:
    """Write a small file all at once; several processes may write the same one."""
    write_bytes(path, text.encode())


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file that memory holds all at once."""
    with atomic_write(path) as hidden:
        hidden.write_bytes(content)


def write_arrays(path: Path, arrays: Mapping[str, "np.ndarray"], *, compressed: bool = True, digest: bool = False) -> None:
    """Write NumPy arrays as one .npz file all at once; `digest` is that of `atomic_write`."""
    import numpy as np

    with atomic_write(path, digest=digest) as hidden, hidden.open("wb") as stream:
        (np.savez_compressed if compressed else np.savez)(stream, **arrays)  # type: ignore[arg-type]


def write_png(path: Path, image: "np.ndarray", *, compression: int | None = None) -> None:
    """Write an image in OpenCV's order of colours, (H, W), (H, W, 3) or (H, W, 4) uint8, as a PNG file all at once.

    Args:
        path: The file.
        image: The image.
        compression: Level from 0 to 9; OpenCV's own where absent.
    """
    import cv2

    options = [] if compression is None else [cv2.IMWRITE_PNG_COMPRESSION, compression]
    done, content = cv2.imencode(".png", image, options)  # imwrite reports no full disk
    if not done:
        raise UserError(f"OpenCV cannot encode the picture {path}")
    write_bytes(path, content.tobytes())


def write_figure(path: Path, figure: Any, *, dpi: float) -> None:
    """Write a figure of matplotlib as a PNG file all at once."""
    with atomic_write(path) as hidden:
        figure.savefig(hidden, dpi=dpi, format="png")


def copy_file(source: str | os.PathLike, path: Path) -> None:
    """Copy the content of a file all at once."""
    with atomic_write(path) as hidden:
        shutil.copyfile(source, hidden)


def write_json(path: Path, content: Any) -> None:
    """Write a small JSON file all at once, an indent a level."""
    write_text(path, json.dumps(content, indent=1) + "\n")


@contextlib.contextmanager
def new_folder(path: str | os.PathLike) -> Iterator[Path]:
    """Create a folder atomically: yield an empty temporary folder, and rename it to `path` when the block ends.

    If the block raises, the temporary folder is removed.

    Raises:
        UserError: `path` is a link; another process of this machine is writing the folder; or by then `path` exists, and is a file or a
            folder with content.
    """
    path = Path(path)
    if path.is_symlink():
        raise UserError(f"{path} is a link, which is not followed here: remove it, or give another out")
    _check_writer(path)
    with made_folder(path.parent):
        hidden = temporary_path(path)
        hidden.mkdir()
        try:
            yield hidden
            for part in sorted(hidden.rglob("*"), reverse=True):
                _sync(part)
            _sync(hidden)
            try:
                _take_hidden_files(path, hidden)
                os.replace(hidden, path)
            except OSError as error:
                if path.exists():
                    raise UserError(f"{path} was created by another process meanwhile and is not replaced: give another folder") from error
                raise
        except BaseException:
            remove(hidden)
            raise
        _sync(path.parent)


@contextlib.contextmanager
def made_folder(path: Path) -> Iterator[None]:
    """Create a folder and those above it; when the block ends, those that were created and are empty are removed."""
    made = [each for each in (path, *path.parents) if not each.exists()]
    try:
        path.mkdir(parents=True, exist_ok=True)
        yield
    finally:
        for each in made:
            with contextlib.suppress(OSError):  # something is in it
                each.rmdir()


def _take_hidden_files(path: Path, hidden: Path) -> None:
    """Move what a folder has into a temporary one, where it has hidden files alone, so that this can take its place."""
    there = list(path.iterdir()) if path.is_dir() and not path.is_symlink() else []
    if all(entry.name.startswith(".") for entry in there):
        for entry in there:
            os.replace(entry, hidden / entry.name)


def _check_writer(path: Path) -> None:
    """Refuse a folder whose temporary folder belongs to another process of this machine that is alive."""
    for other in path.parent.glob(f".{_literal(path.name)}.{_host()}-*.tmp"):
        pid = _writer(other, path)
        if pid is not None and pid != os.getpid() and process_lives(pid, unknown=False):
            raise UserError(
                f"{path} is being written by process {pid} on {socket.gethostname()}: wait for it or end it, or give another out"
            )


def _host() -> str:
    return "".join(c for c in socket.gethostname() if c.isalnum())[:20]


def _writer(hidden: Path, path: Path) -> int | None:
    """Return the process that a temporary name belongs to."""
    pid = hidden.name[len(path.name) + len(_host()) + 3 :].partition("-")[0]
    return int(pid) if pid.isdigit() else None


def temporary_path(path: Path, suffix: str = "") -> Path:
    """Return a temporary path beside a file that no other process uses.

    Temporary files of this file that dead processes of this machine left are removed.
    """
    old_name = path.with_name(f".{path.name}.tmp")  # of earlier versions
    if old_name.is_file():
        remove(old_name)
    for old in path.parent.glob(f".{_literal(path.name)}.{_host()}-*.tmp{_literal(suffix)}"):
        pid = _writer(old, path)
        if pid is not None and not process_lives(pid, unknown=True):
            remove(old)
    return path.with_name(f".{path.name}.{_host()}-{os.getpid()}-{uuid.uuid4().hex[:8]}.tmp{suffix}")


def remove(path: Path) -> None:
    """Remove a file, a folder with its content, or a link without its target."""
    if path.is_symlink() or path.is_file():
        path.unlink(missing_ok=True)
    elif path.is_dir():
        shutil.rmtree(path)


def make_real_folder(path: Path, what: str) -> Path:
    """Create a folder if it does not exist; refuse a link, which could lead anywhere.

    Args:
        path: The folder.
        what: What it is called in error messages.

    Raises:
        UserError: `path` is a link or a file.
    """
    if path.is_symlink():
        raise UserError(f"{what} {path} is a link, which is not followed here: remove it, or give another out")
    try:
        path.mkdir(parents=True, exist_ok=True)
    except FileExistsError as error:
        raise UserError(f"{what} {path} is a file: remove it, or give another out") from error
    return path


def check_writable(folder: Path, option: str = "out") -> None:
    """Check before long work that a folder can be created and written; create nothing.

    Args:
        folder: The folder.
        option: The option that gave it, for error messages.

    Raises:
        UserError: The folder is a file, lies below a file, or is not writable.
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
    """Escape a text for `glob`, so that the pattern matches this text only."""
    return "".join(f"[{c}]" if c in "*?[" else c for c in text)


def process_lives(pid: int, *, unknown: bool) -> bool:
    """Return whether a process of this machine is alive; return `unknown` if the platform cannot tell, as on Windows."""
    if os.name != "posix":
        return unknown  # there, os.kill with signal 0 would end the process
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
