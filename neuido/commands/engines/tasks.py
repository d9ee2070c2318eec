"""`map_tasks`, by which every command runs independent tasks, and the checks of the options that choose an engine."""

import importlib.util
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from neuido.commands.engines.outcome import Outcome, Share
from neuido.errors import UserError, suggest

ENGINES = ("local", "ray")


def map_tasks(
    function: Callable[..., Any],
    items: Sequence[tuple[Any, ...]],
    *,
    engine: str = "local",
    address: str | None = None,
    share: Share,
    most: int | None = None,
) -> Iterator[Outcome]:
    """Call a function with each of several arguments, in other processes or on other machines, and yield the outcomes as they come.

    A task whose worker ends is started anew, up to `RETRIES` times; so it must leave nothing that its repetition would trip over. When the
    iterator is closed, tasks that are running are ended.

    Args:
        function: A function of a module. Arguments and results are pickled.
        items: The arguments of each task.
        engine: `local` (processes of this machine) or `ray`.
        address: Of the Ray cluster.
        share: What a task takes of a machine.
        most: Tasks that run at a time; None: as many as the shares allow.

    Raises:
        UserError: An option is out of range, or the engine cannot be reached.
    """
    check_engine(engine, address, share)
    if engine == "local":
        from neuido.commands.engines.local_pool import run_locally

        yield from run_locally(function, items, share, most or len(items))
    else:
        from neuido.commands.engines.ray_cluster import AHEAD, run_on_ray

        yield from run_on_ray(function, items, share, address, min(most or AHEAD, AHEAD))


def check_engine(engine: str, address: str | None, share: Share) -> None:
    """Check the options of an engine before any work.

    Raises:
        UserError: An option is out of range.
    """
    if engine not in ENGINES:
        raise UserError(f"engine = {engine!r} is not known{suggest(engine, ENGINES)}; use {' or '.join(ENGINES)}")
    if engine == "ray" and importlib.util.find_spec("ray") is None:
        raise UserError("engine = ray needs the package ray, of the extra scale: pip install 'neuido[scale]'")
    if address is not None and engine != "ray":
        raise UserError(f"address = {address} is that of a Ray cluster: give --engine ray, or leave it out")
    if not (0 < share.cpus < math.inf):
        raise UserError(f"cpus = {share.cpus:g} must be positive: a task needs a part of a core")
    if not (0 <= share.gpus < math.inf) or (share.gpus > 1 and share.gpus != int(share.gpus)):
        raise UserError(f"gpus = {share.gpus:g} must be 0, a fraction of a GPU, or a whole number of GPUs")
    if share.cpus > 1 and share.cpus != int(share.cpus):
        raise UserError(f"cpus = {share.cpus:g} must be a fraction of a core, or a whole number of cores")
