"""Caches that several threads may ask at once: what they hold is made once, by one thread at a time."""

import functools
import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import Any, TypeVar

F = TypeVar("F", bound=Callable[..., Any])

BUILDING = threading.RLock()
"""Held while kernels are built or loaded. Warp registers functions and modules in tables of the whole process, so one lock serves all;
a builder may call another."""


def cached(function: F | None = None, *, limit: int | None = None) -> Any:
    """Keep the results of a function by its arguments; two threads never make the same one.

    `functools.cache` calls the function in both threads when two ask at once. For a builder of Warp kernels that means two modules of one
    name, of which the second replaces the first while it is in use.

    Args:
        function: Decorated; its arguments must be hashable.
        limit: Results that are kept, the least recently used dropped first; none: all.
    """
    if function is None:
        return functools.partial(cached, limit=limit)
    kept: OrderedDict[tuple, Any] = OrderedDict()

    @functools.wraps(function)
    def get(*args: Any, **options: Any) -> Any:
        key = (args, *sorted(options.items())) if options else args
        if limit is None and key in kept:  # whole as soon as it is there, and never dropped
            return kept[key]
        with BUILDING:
            if key not in kept:
                made = function(*args, **options)
                while limit is not None and len(kept) >= limit:
                    kept.popitem(last=False)
                kept[key] = made
            kept.move_to_end(key)
            return kept[key]

    def clear() -> None:
        with BUILDING:
            kept.clear()

    get.cache_clear = clear  # type: ignore[attr-defined]
    return get
