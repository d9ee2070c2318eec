"""Tasks that end their own process. The module imports little, since each process that takes its place imports it again."""

import os
import signal
from pathlib import Path


def killed(folder: str, times: int) -> int:
    """End this process the first times that it is called with a folder; then return how often it was called."""
    calls = len(list(Path(folder).iterdir()))
    (Path(folder) / str(calls)).touch()
    if calls < times:
        os.kill(os.getpid(), signal.SIGKILL)
    return calls + 1


def killed_once(folder: str, out: str, options: dict, mark: str) -> dict:
    """Diagnose a folder, but end this process where it is the first that is called with a mark."""
    from neuido.commands.engines.many_diagnoses import diagnose_folder

    killed(mark, 1)
    return diagnose_folder(folder, out, options)
