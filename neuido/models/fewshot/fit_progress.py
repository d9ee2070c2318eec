"""How far the fit of one scene has come: its clock and memory, its best parameters, and the last ones whose law ran."""

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

MIN_IMPROVEMENT = 0.01
"""The share by which a loss must fall to count as lower."""
FAILURE_WINDOW = 5
"""Steps after a failure within which another one counts as of the same row."""
MAX_FAILURES = 3
"""Failures in a row that say that the last parameters that ran are themselves at the edge."""
RATE_RECOVERY = 2.0**0.1
"""Factor on the rates of each step that runs, up to their own."""


@dataclass
class Progress:
    """What a checkpoint keeps of a scene beside its parameters; plain figures and tensors alone."""

    steps: int = 0
    """Optimiser steps done."""
    seconds: float = 0.0
    """Time of these steps."""
    peak_memory_gb: float = 0.0
    """Of torch, on a GPU."""
    warp_memory_gb: float = 0.0
    """Of Warp's pool, since the process began."""
    done: bool = False
    damping: float = 1.0
    """Factor on the rates; it is halved when a step has led to a law that does not run, and comes back in ten that do."""
    failed_at: int = -FAILURE_WINDOW - 1
    """Step of the last failure."""
    failures: int = 0
    """In a row."""
    lowest: float = float("inf")
    lowest_at: int = 0
    over: bool = False
    """Whether the loss has not fallen for too long."""
    best: dict[str, Tensor] = field(default_factory=dict)
    """The parameters of the lowest loss."""
    good: dict[str, Tensor] = field(default_factory=dict)
    """The last parameters that ran."""
    first: dict[str, Tensor] = field(default_factory=dict)
    """The first ones that did."""

    def record_success(self, fit: nn.Module) -> None:
        """Record that the present parameters ran, and let the learning rates recover."""
        self.good = snapshot(fit)
        self.first = self.first or self.good
        self.damping = min(1.0, self.damping * RATE_RECOVERY)

    def restore_last_good(self, fit: nn.Module, *, ran: bool = False) -> bool:
        """Restore the last parameters that ran, or move them halfway to the first ones after repeated failures; return whether there were
        any.

        Args:
            fit: What to bring back.
            ran: The law ran and only its gradient is not finite: momentum may lead on, so that nothing else changes at first.
        """
        self.failures = self.failures + 1 if self.steps - self.failed_at <= FAILURE_WINDOW else 1
        self.failed_at = self.steps
        if self.failures >= MAX_FAILURES:
            self.good = {name: torch.lerp(value, self.first[name], 0.5) for name, value in self.good.items()}
        elif ran:
            return True
        self.damping *= 0.5
        return restore(fit, self.good)

    def record_loss(self, value: float, fit: nn.Module, patience: int) -> None:
        """Record the loss of a fit; set `over` after `patience` steps without a lower one."""
        if value < (1 - MIN_IMPROVEMENT) * self.lowest:
            self.lowest, self.lowest_at, self.best = value, self.steps, snapshot(fit)
        elif self.steps - self.lowest_at >= patience:
            self.over = True

    def state(self) -> dict[str, Any]:
        """Return the content of a checkpoint, from which `Progress(**state)` is made again."""
        return dict(vars(self))


def snapshot(fit: nn.Module) -> dict[str, Tensor]:
    """Copy a module's trainable parameters."""
    return {name: p.detach().clone() for name, p in fit.named_parameters() if p.requires_grad}


@torch.no_grad()
def restore(fit: nn.Module, kept: dict[str, Tensor]) -> bool:
    """Put a `snapshot` back; whether there was one."""
    parameters = dict(fit.named_parameters())
    for name, value in kept.items():
        parameters[name].copy_(value)
    return bool(kept)
