"""Tasks in processes of this machine, one at a time in each, with cores (and a GPU) of their own."""

import contextlib
import math
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from neuido.commands.engines.outcome import RETRIES, Outcome, Share, attempt
from neuido.errors import UserError


def run_locally(function: Callable[..., Any], items: Sequence[tuple[Any, ...]], share: Share, most: int) -> Iterator[Outcome]:
    """Run tasks in as many processes as the shares of cores and GPUs and `most` allow, and yield the outcomes as they come.

    Each process is a pool of its own, so that one that is killed takes no other task with it.
    """
    places = _places(share, min(most, len(items)))
    before = multiprocessing.active_children()
    with contextlib.ExitStack() as stack:
        stack.callback(lambda: [child.terminate() for child in multiprocessing.active_children() if child not in before])
        pools = {place: _pool(*places[place]) for place in range(len(places))}
        tries = dict.fromkeys(range(len(items)), 0)
        waiting = iter(range(len(items)))
        running: dict[Future, tuple[int, int]] = {}

        def start(place: int, number: int | None) -> None:
            if number is not None:
                tries[number] += 1
                running[pools[place].submit(_attempt, function, items[number])] = (place, number)

        for place in pools:
            start(place, next(waiting, None))
        while running:
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                place, number = running.pop(future)
                try:
                    value, error = future.result()
                except BrokenProcessPool:
                    pools[place] = _pool(*places[place])
                    if tries[number] <= RETRIES:
                        start(place, number)
                        continue
                    value, error = None, f"its process ended {tries[number]} times: killed, or no memory was left"
                yield Outcome(number, value, error)
                start(place, next(waiting, None))
        for pool in pools.values():
            pool.shutdown()


def _pool(cores: list[int], gpus: str) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn"), initializer=_begin, initargs=(cores, gpus))


def _attempt(function: Callable[..., Any], arguments: tuple[Any, ...]) -> tuple[Any, str]:
    try:
        return attempt(function, arguments)
    except KeyboardInterrupt:  # of SIGTERM, when the task has put away what it had begun
        os._exit(128 + signal.SIGTERM)


def _begin(cores: list[int], gpus: str) -> None:
    """Keep this process to its cores and GPUs, leave Ctrl-C to the process that started it, and end with that one."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    os.environ["CUDA_VISIBLE_DEVICES"] = gpus  # read when CUDA starts, which no import here does
    os.environ["OMP_NUM_THREADS"] = str(max(len(cores), 1))
    if cores and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, cores)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=lambda: (parent.join(), os._exit(1)), daemon=True).start()


def _places(share: Share, tasks: int) -> list[tuple[list[int], str]]:
    """Return cores and GPUs of each process.

    Raises:
        UserError: A task needs more than there is.
    """
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else list(range(os.cpu_count() or 1))
    count = math.floor(len(cores) / share.cpus + 1e-9)
    if count < 1:
        raise UserError(f"cpus = {share.cpus:g}: this process may use {len(cores)} cores; give fewer")
    gpus: list[str] = []
    if share.gpus:
        gpus = visible_gpus()
        if share.gpus > len(gpus):
            raise UserError(f"gpus = {share.gpus:g}: this machine has {len(gpus)} GPUs that torch finds; give 0 for the CPU")
        count = min(count, math.floor(len(gpus) / share.gpus + 1e-9))
    count = max(1, min(count, tasks))
    own = max(1, math.floor(share.cpus))
    places = []
    for place in range(count):
        first = math.floor(place * share.gpus + 1e-9)
        last = max(first + 1, first + math.floor(share.gpus))
        start = math.floor(place * share.cpus + 1e-9)
        places.append((cores[start : start + own], ",".join(gpus[first:last])))
    return places


def visible_gpus() -> list[str]:
    """Return the GPUs that this process may use, as `CUDA_VISIBLE_DEVICES` names them."""
    import torch

    named = [name for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name.strip()]
    return (named or [str(i) for i in range(torch.cuda.device_count())])[: torch.cuda.device_count()]
