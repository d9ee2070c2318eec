"""A lock between processes that says who holds it."""

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
    """Another process holds the lock."""


class OwnedLock:
    """An exclusive lock on a file, on every platform, with the pid and host of its owner beside it in `<file>.owner`.

    The owner may name a process that it started (`hand_to`). While that process lives, the lock counts as held even where its owner died.

    Args:
        path: The lock file; it stays where it is.
        purpose: What the lock guards, for the error: "the run runs/a".
        wait: Seconds to wait for another owner; negative: without end.
    """

    def __init__(self, path: str | os.PathLike, purpose: str, *, wait: float = 0.0) -> None:
        self.path, self.purpose, self.wait = Path(path), purpose, wait
        self.owner = self.path.with_name(self.path.name + ".owner")
        self._lock = FileLock(str(self.path))

    def __enter__(self) -> "OwnedLock":
        """Take the lock.

        Raises:
            Held: Another process has it; one line with its pid and host.
            UserError: The file cannot be made.
        """
        end = math.inf if self.wait < 0 else time.monotonic() + self.wait
        while True:
            try:
                self._lock.acquire(timeout=-1 if end == math.inf else max(0.0, end - time.monotonic()))
            except Timeout as error:
                raise LockHeld(self._message(self._record())) from error
            except OSError as error:
                raise UserError(f"the lock {self.path} cannot be made: {(error.strerror or str(error)).lower()}") from error
            record = self._record()
            if record.get("host") != socket.gethostname() or not _lives(record.get("child"), record.get("child_started")):
                self._note({})
                return self
            self._lock.release()
            if time.monotonic() >= end:
                raise LockHeld(self._message(record))
            time.sleep(0.1)

    def hand_to(self, child: int) -> None:
        """Let a process that was started under this lock hold it on, should this process be killed."""
        self._note({"child": child, "child_started": _started(child)})

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Give the lock back."""
        self.owner.unlink(missing_ok=True)
        self._lock.release()

    def _note(self, more: dict[str, Any]) -> None:
        hidden = self.owner.with_name(f"{self.owner.name}.{os.getpid()}.tmp")
        hidden.write_text(json.dumps({"pid": os.getpid(), "host": socket.gethostname(), **more}) + "\n")
        os.replace(hidden, self.owner)

    def _record(self) -> dict[str, Any]:
        try:
            content = json.loads(self.owner.read_text())
        except (OSError, ValueError):
            return {}
        return content if isinstance(content, dict) else {}

    def _message(self, record: dict[str, Any]) -> str:
        who = f"process {record.get('child', record['pid'])} on {record.get('host')}" if "pid" in record else "another process"
        return f"{self.purpose} is held by {who} (lock {self.path}): wait for it or end it"


def _started(pid: int) -> str | None:
    """Return when a process started, in a form that only equality is asked of; none where the platform does not say."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19]
    except (OSError, IndexError):
        return None


def _lives(pid: Any, started: Any) -> bool:
    """Whether a process is alive and the one that was noted, not a later one with its number."""
    if not isinstance(pid, int) or pid < 1 or not process_lives(pid, unknown=False):
        return False
    if started is None:
        return True
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except (OSError, IndexError):
        return False
    return _started(pid) == started and state != "Z"
