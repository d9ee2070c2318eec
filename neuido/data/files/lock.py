"""File lock between processes that records its owner."""

import contextlib
import json
import math
import os
import socket
import time
from pathlib import Path
from types import TracebackType
from typing import Any

from filelock import FileLock, Timeout

from neuido.data.files.writing import process_lives
from neuido.errors import UserError


class LockHeld(UserError):
    """The lock is held by another process."""


class OwnedLock:
    """Exclusive file lock that stores the pid and host of its owner in `<file>.owner`.

    The owner can share the lock with a child process (`share_with_child`). The lock then stays held while the child lives, even if the
    owner is killed.

    Args:
        path: The lock file.
        purpose: What the lock guards, for error messages; for example "the run runs/a".
        wait: Longest time to wait for the lock [s]; negative: wait forever.
        keep: Whether the lock file stays when the lock is released.
    """

    def __init__(self, path: str | os.PathLike, purpose: str, *, wait: float = 0.0, keep: bool = True) -> None:
        self.path, self.purpose, self.wait, self.keep = Path(path), purpose, wait, keep
        self.owner = self.path.with_name(self.path.name + ".owner")
        self._lock = FileLock(str(self.path))

    def __enter__(self) -> "OwnedLock":
        """Acquire the lock.

        Raises:
            LockHeld: Another process holds the lock; the message has its pid and host.
            UserError: The lock file cannot be created.
        """
        end = math.inf if self.wait < 0 else time.monotonic() + self.wait
        while True:
            try:
                self._lock.acquire(timeout=-1 if end == math.inf else max(0.0, end - time.monotonic()))
            except Timeout as error:
                raise LockHeld(self._message(self._record())) from error
            except OSError as error:
                raise UserError(f"the lock file {self.path} cannot be created: {(error.strerror or str(error)).lower()}") from error
            record = self._record()
            if record.get("host") != socket.gethostname() or not _lives(record.get("child"), record.get("child_started")):
                self._note({})
                return self
            self._lock.release()
            if time.monotonic() >= end:
                raise LockHeld(self._message(record))
            time.sleep(0.1)

    def share_with_child(self, child: int) -> None:
        """Keep the lock held while a child process lives, even if this process is killed."""
        self._note({"child": child, "child_started": _started(child)})

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Release the lock."""
        self.owner.unlink(missing_ok=True)
        if not self.keep:  # whoever opened it before sees that it has no name any more, and opens another
            with contextlib.suppress(OSError):  # Windows removes no open file
                self.path.unlink(missing_ok=True)
        self._lock.release()

    def _note(self, more: dict[str, Any]) -> None:
        hidden = self.owner.with_name(f"{self.owner.name}.{os.getpid()}.tmp")
        since = time.strftime("%Y-%m-%d %H:%M:%S")
        hidden.write_text(json.dumps({"pid": os.getpid(), "host": socket.gethostname(), "since": since, **more}) + "\n")
        os.replace(hidden, self.owner)

    def _record(self) -> dict[str, Any]:
        try:
            content = json.loads(self.owner.read_text())
        except (OSError, ValueError):
            return {}
        return content if isinstance(content, dict) else {}

    def _message(self, record: dict[str, Any]) -> str:
        who = f"process {record.get('child', record['pid'])} on {record.get('host')}" if "pid" in record else "another process"
        since = f" since {record['since']}" if "since" in record else ""
        return f"{self.purpose} is held by {who}{since} (lock file {self.path}): wait until it ends, or stop it"


def _started(pid: int) -> str | None:
    """Return the start time of a process in ticks, to tell it from a later one with the same pid; None if the platform has no /proc."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19]
    except (OSError, IndexError):
        return None


def _lives(pid: Any, started: Any) -> bool:
    """Whether the recorded process is alive, and not a later one with the same pid."""
    if not isinstance(pid, int) or pid < 1 or not process_lives(pid, unknown=False):
        return False
    if started is None:
        return True
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except (OSError, IndexError):
        return False
    return _started(pid) == started and state != "Z"
