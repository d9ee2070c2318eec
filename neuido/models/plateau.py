"""When a fit no longer gets better."""

from collections.abc import Mapping
from typing import Any

from torch import Tensor

LEAST = 0.01
"""The share by which a value must fall to count as lower."""


class Plateau:
    """The lowest value so far, the parameters that gave it, and whether it has stood for too long.

    Args:
        lowest, step, over, best: As `state` gives them, of an interrupted run.
    """

    def __init__(self, lowest: float = float("inf"), step: int = 0, over: bool = False, best: dict[str, Tensor] | None = None):
        self.lowest, self.step, self.over, self.best = lowest, step, over, best

    def see(self, step: int, value: float, parameters: Mapping[str, Tensor], patience: int) -> None:
        """Take the value that the parameters have at a step; `over` becomes true after `patience` steps without a lower one."""
        if value < (1 - LEAST) * self.lowest:
            self.lowest, self.step = value, step
            self.best = {name: tensor.detach().clone() for name, tensor in parameters.items()}
        elif step - self.step >= patience:
            self.over = True

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {"lowest": self.lowest, "step": self.step, "over": self.over, "best": self.best}
