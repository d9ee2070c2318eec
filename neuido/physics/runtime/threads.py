"""Threads for scenes on the CPU: Warp runs a kernel on one core there, and releases the GIL meanwhile."""

import os
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import torch

_counting = threading.Lock()
_inside: list[int] = []
"""torch's number of threads before the first of the rollouts that run now, once for each."""


@contextmanager
def one_thread_each() -> Iterator[None]:
    """torch's own threads would crowd those of the scenes, and cost more than they bring where matrices are small."""
    with _counting:
        if not _inside:
            _inside.append(torch.get_num_threads())
        else:
            _inside.append(_inside[0])  # the number is the process's own: what another rollout lowered is not what it was before
        torch.set_num_threads(1)
    try:
        yield
    finally:
        with _counting:
            before = _inside.pop()
            torch.set_num_threads(1 if _inside else before)


def scene_pool() -> ThreadPoolExecutor:
    """One worker for each core that this process may use."""
    return ThreadPoolExecutor(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(), "scene")
