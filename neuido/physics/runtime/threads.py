"""One thread per scene on the CPU, where Warp runs a kernel on one core and releases the GIL meanwhile."""

import os
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import torch

_counting = threading.Lock()
_inside: list[int] = []
"""The number of torch's threads before the first of the rollouts that are running, once for each rollout."""


@contextmanager
def one_thread_each() -> Iterator[None]:
    """Open a context in which torch uses one thread, so that its threads do not compete with those of the scenes."""
    with _counting:
        if not _inside:
            _inside.append(torch.get_num_threads())
        else:
            _inside.append(_inside[0])  # the number belongs to the process, and another rollout may have lowered it already
        torch.set_num_threads(1)
    try:
        yield
    finally:
        with _counting:
            before = _inside.pop()
            torch.set_num_threads(1 if _inside else before)


def scene_pool() -> ThreadPoolExecutor:
    """Create a pool of threads for scenes, one for each core that this process may use."""
    return ThreadPoolExecutor(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(), "scene")
