"""Adapters of plain re-implementations of published loops; they are none of the authors' code."""

import plain
import torch
from torch.utils.checkpoint import checkpoint

from neuido.types import ParticleState
from peers import Problem
from peers.engine import Engine


class NeumaLike(Engine):
    """The loop of NCLaw and NeuMA: see `plain.py`."""

    differs = "re-implementation by us: Warp's own adjoints, one autograd function a substep, laws in torch"

    def version(self) -> str:
        """Return the version of the code."""
        return "-"

    def move(self) -> torch.Tensor:
        """Return the last positions [m], (P, 3)."""
        return plain.rollout(self.sim, self.problem.substeps, self.elastic, self.plastic, state=self.state)[-1]


class MasivLike(NeumaLike):
    """The loop of MASIV: that of NCLaw, checkpointed frame by frame (`Estimator.forward_loss`), all positions kept."""

    differs = "re-implementation by us: as NeuMA-like, and each frame of `FRAME` substeps is computed again in the backward pass"
    FRAME = 10

    def __init__(self, problem: Problem, device: str) -> None:
        super().__init__(problem, device)
        self.transfers = plain.Transfers(self.sim)

    def frame(self, *state: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Return x, v, C and F after a frame."""
        x, v, C, F = state
        for _ in range(self.FRAME):
            x, v, C = plain.Substep.apply(self.transfers, x, v, C, self.elastic(F).contiguous())
            F = F + self.problem.dt * (C @ F)
            F = F if self.plastic is None else self.plastic(F)
        return x, v, C, F

    def move(self) -> torch.Tensor:
        """Return the last positions [m], (P, 3)."""
        state = self.state
        for _ in range(self.problem.substeps // self.FRAME):
            state = ParticleState(*checkpoint(self.frame, *state, use_reentrant=False))
        return state.x
