"""Where the time of a benchmark goes: rows of a table, the time of the parts of a run, and the operations that take most of it."""

import contextlib
import functools
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import torch
from torch.profiler import ProfilerActivity, profile


@dataclass
class Row:
    """One row of the table: what, how often, the median [s], and its parts [s]."""

    name: str
    seconds: float
    count: int = 1
    note: str = ""
    parts: dict[str, list[float]] = field(default_factory=dict)
    table: str = ""
    """Further table, as text."""

    def figures(self) -> dict[str, Any]:
        """Return what a JSON file keeps: the numbers, with the median and the number of calls of each part."""
        parts = {name: {"median": statistics.median(t), "calls": len(t)} for name, t in self.parts.items() if t}
        return {"name": self.name, "seconds": self.seconds, "count": self.count, "note": self.note, "parts": parts}


@contextlib.contextmanager
def parts(wanted: dict[str, tuple[Any, str]], wait: Callable[[], None]) -> Iterator[dict[str, list[float]]]:
    """Measure every call of functions while the context is open: name -> (owner, attribute); return name -> seconds of each call.

    `wait` waits for the device, at both ends of a call.
    """
    found: dict[str, list[float]] = {}

    def timed(name: str, function: Callable) -> Callable:
        @functools.wraps(function)
        def run(*arguments: Any, **options: Any) -> Any:
            wait()
            start = time.perf_counter()
            try:
                return function(*arguments, **options)
            finally:
                wait()
                found.setdefault(name, []).append(time.perf_counter() - start)

        return run

    kept = [(owner, attribute, owner.__dict__[attribute]) for owner, attribute in wanted.values()]
    try:
        for (name, (owner, attribute)), (_, _, function) in zip(wanted.items(), kept):
            setattr(owner, attribute, timed(name, function))
        yield found
    finally:
        for owner, attribute, function in kept:
            setattr(owner, attribute, function)


def operations(run: Callable[[], object], calls: int = 5, rows: int = 14) -> str:
    """Return the operations that take most of the device and of the host, for some calls, as torch's profiler sees them."""
    cuda = torch.cuda.is_available()
    with profile(activities=[ProfilerActivity.CPU, *([ProfilerActivity.CUDA] if cuda else [])]) as seen:
        for _ in range(calls):
            run()
        if cuda:
            torch.cuda.synchronize()
    return tables_of(seen, calls, rows, cuda)


def tables_of(seen: Any, calls: int, rows: int, cuda: bool) -> str:
    """Format the operations of a profile: milliseconds and number of each in a call."""
    text = []
    for key in ("self_device_time_total", "self_cpu_time_total") if cuda else ("self_cpu_time_total",):
        found = sorted(seen.key_averages(), key=lambda each, key=key: -getattr(each, key))
        total = sum(getattr(each, key) for each in found)
        text.append(f"{key}: {total / 1e3 / calls:.3f} ms a call")
        text += [f"{getattr(e, key) / 1e3 / calls:9.3f} ms {e.count / calls:7.1f} x {e.key[:100]}" for e in found[:rows]]
    return "\n".join(text)
