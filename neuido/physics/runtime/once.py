"""Thread-safe caches: each entry is computed once, by one thread at a time."""

import functools
import os
import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

BUILDING = threading.RLock()
"""Lock that is held while kernels are built or loaded. There is one for the whole process, since Warp's tables of functions and modules are
global. It is reentrant, since a builder may call another."""

if hasattr(os, "register_at_fork"):  # a fork while another thread builds would have half of a kernel, and a lock that nobody releases
    os.register_at_fork(before=BUILDING.acquire, after_in_parent=BUILDING.release, after_in_child=BUILDING.release)


def cached(function: Callable[..., Any] | None = None, *, limit: int | None = None) -> Any:
    """Cache the results of a function by its arguments, and compute each only once even if several threads call it.

    With `functools.cache`, two threads may both compute a result. For a builder of Warp kernels that would create two modules of one name,
    of which the second replaces the first while it is in use.

    Args:
        function: The decorated function; its arguments must be hashable.
        limit: Largest number of results; the least recently used is dropped first. None: no limit.
    """
    if function is None:
        return functools.partial(cached, limit=limit)
    results: OrderedDict[tuple, Any] = OrderedDict()

    @functools.wraps(function)
    def get(*args: Any, **options: Any) -> Any:
        key = (args, *sorted(options.items())) if options else args
        if limit is None and key in results:  # needs no lock: such entries are complete and never dropped
            return results[key]
        with BUILDING:
            if key not in results:
                made = function(*args, **options)
                while limit is not None and len(results) >= limit:
                    results.popitem(last=False)
                results[key] = made
            results.move_to_end(key)
            return results[key]

    def clear() -> None:
        with BUILDING:
            results.clear()

    get.cache_clear = clear  # type: ignore[attr-defined]
    return get
