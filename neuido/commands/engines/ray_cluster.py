"""Tasks on a Ray cluster."""

import contextlib
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from neuido.commands.cli.interruption import SIGNALS
from neuido.commands.engines.outcome import RETRIES, Outcome, Share, attempt
from neuido.errors import UserError, shortened

AHEAD = 1000
"""Largest number of tasks that a cluster is given at a time: it keeps each in the memory of its head."""


def run_on_ray(
    function: Callable[..., Any], items: Sequence[tuple[Any, ...]], share: Share, address: str | None, most: int
) -> Iterator[Outcome]:
    """Run tasks on a Ray cluster, and yield the outcomes as they come.

    Args:
        function: A function of a module that the machines of the cluster can import.
        items: Arguments of each task.
        share: What a task takes of a machine.
        address: Of the cluster: `HOST:PORT`, `ray://HOST:PORT` or `auto`. None: that in RAY_ADDRESS, else a cluster of this machine
            alone, which ends with the command.
        most: Tasks that the cluster is given at a time.

    Raises:
        UserError: The cluster is not there, or no machine of it has such a share.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "1")  # a task without a share of a GPU sees none
    import ray

    with _connected(ray, address):
        _check(ray, share)
        task = ray.remote(attempt).options(num_cpus=share.cpus, num_gpus=share.gpus, max_retries=RETRIES)
        waiting = iter(range(len(items)))
        running: dict[Any, int] = {}
        try:
            while True:
                while len(running) < most and (number := next(waiting, None)) is not None:
                    running[task.remote(function, items[number])] = number
                if not running:
                    return
                for done in ray.wait(list(running), num_returns=1)[0]:
                    try:
                        value, error = ray.get(done)
                    except ray.exceptions.RayError as failure:  # its worker ended once more than it is tried anew
                        value, error = None, shortened(f"{type(failure).__name__}: {failure}")
                    yield Outcome(running.pop(done), value, error)
        finally:
            for left in running:
                with contextlib.suppress(Exception):  # the cluster may be gone
                    ray.cancel(left, force=True)


@contextlib.contextmanager
def _connected(ray: Any, address: str | None) -> Iterator[None]:
    """Connect to a cluster, or start one of this machine, unless this process is connected already."""
    if ray.is_initialized():
        yield
        return
    own = {} if address or os.environ.get("RAY_ADDRESS") else {"include_dashboard": False}
    handlers = {number: signal.getsignal(number) for number in SIGNALS}
    try:
        ray.init(address=address, log_to_driver=False, logging_level="error", **own)
        if threading.current_thread() is threading.main_thread():  # Ray puts its own handler of SIGTERM there
            for number, handler in handlers.items():
                signal.signal(number, handler)
    except Exception as error:  # of many types, plain `Exception` among them
        there = address or os.environ.get("RAY_ADDRESS")
        what = f"address = {there}: no Ray cluster answers there" if there else "engine = ray: no cluster can be started on this machine"
        raise UserError(f"{what}: {error}") from error
    try:
        yield
    finally:
        ray.shutdown()


def _check(ray: Any, share: Share) -> None:
    """Refuse a share that no machine of the cluster has: its tasks would wait forever."""
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    if not any(node.get("CPU", 0.0) >= share.cpus and node.get("GPU", 0.0) >= share.gpus for node in nodes):
        has = "; ".join(sorted({f"{node.get('CPU', 0):g} cores, {node.get('GPU', 0):g} GPUs" for node in nodes}))
        raise UserError(f"cpus = {share.cpus:g}, gpus = {share.gpus:g}: no machine of the cluster has as much (they have {has}); give less")
