"""One thread per scene on the CPU, where Warp runs a kernel on one core and releases the GIL meanwhile."""

import os
import threading
import weakref
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


_pools: "weakref.WeakSet[ScenePool]" = weakref.WeakSet()


class ScenePool(ThreadPoolExecutor):
    """Pool of threads for scenes, one for each core that this process may use, which a fork of the process may use too.

    A fork has the pool but none of its threads. The pool would take its work there and never do it.
    """

    def __init__(self) -> None:
        super().__init__(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(), "scene")
        _pools.add(self)


def _renew() -> None:
    """Empty the pools of a fork, so that they start threads of their own."""
    for pool in list(_pools):
        ScenePool.__init__(pool)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_renew)


def scene_pool() -> ThreadPoolExecutor:
    """Create a pool of threads for scenes, one for each core that this process may use."""
    return ScenePool()
