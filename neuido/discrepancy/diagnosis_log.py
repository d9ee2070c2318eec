"""What a diagnosis tells while it runs: progress on stderr, and a row of log.csv for each stage."""

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
    """Progress that says what leads, how much of the work of a body's search is done, and how much time is left."""

    leads = ""
    budget: "Budget | None" = None
    """Of the search that runs."""
    until = math.inf
    """When the time is up, in `time.monotonic`."""

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
        path: The CSV file; a resumed run adds to it.
        shown: Whether progress is shown.
        begun: When the work began, in `time.monotonic`.
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
        """Begin a body with a name, empty where there is one alone, and a time limit [s]."""
        self.name, self.progress.leads, self.progress.budget = name, "", None
        self.progress.until = time.monotonic() + seconds

    def watch(self, budget: "Budget") -> None:
        """Show how much of the work of a search is done."""
        self.progress.budget = budget

    def tick(self, count: int) -> None:
        """Count further simulations."""
        self.count += count
        self.progress.update(count)

    def lead(self, key: str, left: float, before: float, unit: str) -> None:
        """Show which candidate leads, and what it leaves of the error."""
        from neuido.discrepancy.report.reader_units import Units
        from neuido.discrepancy.report.wording import title

        name, _, form = key.partition(":")
        units = Units([left, before], [left, before])
        shown = f"{title(name)}{f', {form}' if form else ''}"
        self.progress.leads = f"in the lead: {shown}, which leaves {units.said(left, unit)} of {units.said(before, unit)}"
        self._row(self.progress.leads)

    def __call__(self, stage: str) -> None:
        if not stage.endswith(" simulations") and stage != self.stage:  # counts are shown anyway
            self.stage = stage
            self._row(stage)
            self.progress.say(f"{self.name}{': ' if self.name else ''}{self.stage}")

    def _row(self, stage: str) -> None:
        self.rows.writerow([f"{time.monotonic() - self.begun:.1f}", self.name, stage, self.count])
        self.file.flush()

    def work(self, steps: "Mapping[str, Work]") -> None:
        """Write what each step of a diagnosis ran, the most expensive first."""
        for step, w in sorted(steps.items(), key=lambda item: -item[1].effort):
            line = f"{step}: {w.simulations} simulations, {w.reused} reused, {w.effort:.3g} particle-substeps or data, {w.seconds:.1f} s"
            self._row(line)
            self.progress.note(line)
