"""All shards of a folder as tasks of an engine."""

from collections.abc import Callable
from typing import Any

from neuido.commands.engines.outcome import Share
from neuido.commands.engines.tasks import check_engine, map_tasks
from neuido.data.progress import Progress
from neuido.errors import UserError


def run_shards(
    function: Callable[..., Any],
    options: dict[str, Any],
    *,
    shard: int,
    shards: int,
    engine: str,
    address: str | None,
    share: Share,
    progress: bool,
) -> None:
    """Call a function for every shard, with its options and with `shard` and `shards`.

    Raises:
        UserError: A single shard is asked for, the engine cannot be reached, or a shard failed (when all others are done).
    """
    if shard:
        raise UserError(f"shard = {shard} is for jobs that are started one by one: leave it out where an engine runs all shards")
    if shards < 1:
        raise UserError(f"shards = {shards}: at least 1 is needed")
    check_engine(engine, address, share)
    failures = []
    with Progress("shards", shards, shown=progress) as work:
        items = [(function, options | {"shard": i, "shards": shards}) for i in range(shards)]
        for outcome in map_tasks(_call, items, engine=engine, address=address, share=share):
            failures += [f"shard {outcome.number}: {outcome.error}"] if outcome.error else []
            work.update()
    if failures:
        raise UserError(f"{len(failures)} of {shards} shards failed, first {failures[0]}; the same command goes on with what is missing")


def _call(function: Callable[..., Any], options: dict[str, Any]) -> None:
    function(**options)
