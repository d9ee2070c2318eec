"""Progress of the fit of one scene: time, memory, the best parameters, and the last parameters whose simulation succeeded."""

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

MIN_IMPROVEMENT = 0.01
"""Relative decrease by which a loss counts as lower."""
FAILURE_WINDOW = 5
"""Number of steps within which two failures count as consecutive."""
MAX_FAILURES = 3
"""Consecutive failures after which the last working parameters are considered unstable themselves."""
RATE_RECOVERY = 2.0**0.1
"""Factor by which each successful step raises reduced learning rates."""


@dataclass
class Progress:
    """State of the fit of a scene that a checkpoint stores besides the parameters: only numbers and tensors."""

    steps: int = 0
    """Optimiser steps taken."""
    seconds: float = 0.0
    """Duration of these steps [s]."""
    peak_memory_gb: float = 0.0
    """Peak memory of torch on a GPU [GB]."""
    warp_memory_gb: float = 0.0
    """Peak memory of the Warp pool since the start of the process [GB]."""
    done: bool = False
    damping: float = 1.0
    """Factor on the learning rates: halved after a law whose simulation failed, and restored by ten successful steps."""
    failed_at: int = -FAILURE_WINDOW - 1
    """Step of the last failure."""
    failures: int = 0
    """Number of consecutive failures."""
    lowest: float = float("inf")
    lowest_at: int = 0
    over: bool = False
    """Whether early stopping has ended the fit."""
    best: dict[str, Tensor] = field(default_factory=dict)
    """Parameters of the lowest loss."""
    good: dict[str, Tensor] = field(default_factory=dict)
    """Last parameters whose simulation succeeded."""
    first: dict[str, Tensor] = field(default_factory=dict)
    """First parameters whose simulation succeeded."""

    def record_success(self, fit: nn.Module) -> None:
        """Record that the simulation of the current parameters succeeded, and let the learning rates recover."""
        self.good = snapshot(fit)
        self.first = self.first or self.good
        self.damping = min(1.0, self.damping * RATE_RECOVERY)

    def restore_last_good(self, fit: nn.Module, *, ran: bool = False) -> bool:
        """Restore the last working parameters, after repeated failures moved halfway to the first ones; return whether there were any.

        Args:
            fit: The module whose parameters to restore.
            ran: The simulation succeeded and only its gradient is not finite. The parameters are then kept at first, because momentum may
                move them on.
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
        """Record the loss of a fit; set `over` after `patience` steps without a lower loss."""
        if value < (1 - MIN_IMPROVEMENT) * self.lowest:
            self.lowest, self.lowest_at, self.best = value, self.steps, snapshot(fit)
        elif self.steps - self.lowest_at >= patience:
            self.over = True

    def state(self) -> dict[str, Any]:
        """Return the content for a checkpoint; `Progress(**state)` restores it."""
        return dict(vars(self))


def snapshot(fit: nn.Module) -> dict[str, Tensor]:
    """Copy a module's trainable parameters."""
    return {name: p.detach().clone() for name, p in fit.named_parameters() if p.requires_grad}


@torch.no_grad()
def restore(fit: nn.Module, kept: dict[str, Tensor]) -> bool:
    """Restore the parameters of a `snapshot`; return whether it held any."""
    parameters = dict(fit.named_parameters())
    for name, value in kept.items():
        parameters[name].copy_(value)
    return bool(kept)
