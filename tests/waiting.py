"""Waiting for a process by what it does, and not by the clock: a machine that is busy with other work is slow, which is no fault."""

import subprocess
import time
from collections.abc import Callable
from multiprocessing.process import BaseProcess

HANGS = 1800.0
"""Seconds after which a process counts as one that hangs: on idle cores no run of a test takes a tenth of them."""


def wait_for(condition: Callable[[], object], process: subprocess.Popen | BaseProcess) -> None:
    """Wait until a condition holds; fail with what the process printed if it ends before, or if it hangs."""
    until = time.monotonic() + HANGS
    while not condition():
        ended = process.exitcode if isinstance(process, BaseProcess) else process.poll()
        if ended is not None and not condition():
            printed = "" if isinstance(process, BaseProcess) else process.communicate()
            raise AssertionError(f"the process ended first, with status {ended}: {printed}")
        assert time.monotonic() < until, "nothing happened"
        time.sleep(0.02)
