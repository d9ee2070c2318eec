"""Progress of a running diagnosis: a line on stderr, and a row of log.csv for each stage."""

import csv
import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuido.data.progress import Progress, duration

if TYPE_CHECKING:
    from neuido.discrepancy.store import Budget, Work


class Budgeted(Progress):
    """Progress that shows the leading candidate, the share of the effort that is spent, and the time that is left."""

    leads = ""
    """Text on the leading candidate; empty where none leads."""
    budget: "Budget | None" = None
    """Budget of the running search."""
    until = math.inf
    """End of the time limit, on the clock of `time.monotonic` [s]."""

    def line(self, now: float) -> str:
        parts = [super().line(now)]
        parts += [self.leads] if self.leads else []
        if self.budget is not None and math.isfinite(self.budget.work):
            parts.append(f"{min(self.budget.spent() / self.budget.work, 1.0):.0%} of the effort")
        if math.isfinite(self.until):
            parts.append(f"{duration(max(self.until - now, 0.0))} of the time left" if now < self.until else "the time is up: concluding")
        return "; ".join(parts)

    def say(self, stage: str) -> None:
        self.stage = stage
        if self._bar is not None:
            left = duration(max(self.until - time.monotonic(), 0.0)) if math.isfinite(self.until) else ""
            self._bar.set_postfix_str("; ".join(filter(None, (stage, self.leads, left and f"{left} left"))))


class Log:
    """Show progress on stderr, and write each stage as a row of log.csv.

    Args:
        path: The CSV file. A resumed run appends to it.
        shown: Whether progress is shown.
        begun: Start of the work, on the clock of `time.monotonic` [s].
    """

    def __init__(self, path: Path, *, shown: bool, begun: float) -> None:
        self.begun, self.count, self.stage, self.name = begun, 0, "", ""
        self.progress = Budgeted("diagnosis", unit="simulations", shown=shown)
        fresh = not path.is_file() or not path.stat().st_size
        self.file = path.open("a", newline="")
        self.rows = csv.writer(self.file)
        if fresh:
            self.rows.writerow(["seconds", "body", "stage", "simulations"])

    def __enter__(self) -> "Log":
        self.progress.__enter__()
        return self

    def __exit__(self, *_: Any) -> None:
        self.file.close()
        self.progress.close()

    def begin(self, name: str, seconds: float) -> None:
        """Start the log of a body with its name (empty if there is only one) and its time limit [s]."""
        self.name, self.progress.leads, self.progress.budget = name, "", None
        self.progress.until = time.monotonic() + seconds

    def watch(self, budget: "Budget") -> None:
        """Show from now on which share of the budget of a search is spent."""
        self.progress.budget = budget

    def tick(self, count: int) -> None:
        """Count further simulations."""
        self.count += count
        self.progress.update(count)

    def lead(self, key: str, left: float, before: float, unit: str) -> None:
        """Show the leading candidate, with the error that it leaves (`left`) of the error before, both in `unit`."""
        from neuido.discrepancy.report.reader_units import Units
        from neuido.discrepancy.report.wording import title

        name, _, form = key.partition(":")
        units = Units([left, before], [left, before])
        shown = f"{title(name)}{f', {form}' if form else ''}"
        self.progress.leads = f"in the lead: {shown}, which leaves {units.said(left, unit)} of {units.said(before, unit)}"
        self._row(self.progress.leads)

    def __call__(self, stage: str) -> None:
        if not stage.endswith(" simulations") and stage != self.stage:  # the number of simulations is shown anyway
            self.stage = stage
            self._row(stage)
            self.progress.say(f"{self.name}{': ' if self.name else ''}{self.stage}")

    def _row(self, stage: str) -> None:
        self.rows.writerow([f"{time.monotonic() - self.begun:.1f}", self.name, stage, self.count])
        self.file.flush()

    def work(self, steps: "Mapping[str, Work]") -> None:
        """Write the simulations, cost and time of each step of a diagnosis, the most expensive first."""
        for step, w in sorted(steps.items(), key=lambda item: -item[1].effort):
            line = f"{step}: {w.simulations} simulations, {w.reused} reused, {w.effort:.3g} particle-substeps or data, {w.seconds:.1f} s"
            self._row(line)
            self.progress.note(line)
