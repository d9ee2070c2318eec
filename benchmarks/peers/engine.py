"""Adapter of the engine of neuido."""

import numpy as np
import rollout
import torch

import neuido
from neuido.physics.laws.classical import NeoHookean
from neuido.physics.mpm.simulator import Simulator
from neuido.types import Body, Scene
from peers import Problem


class Engine:
    """The engine, one call of `Simulator.rollout`.

    Args:
        problem: The problem.
        device: `cpu` or `cuda`.
    """

    differs = ""

    def __init__(self, problem: Problem, device: str) -> None:
        self.problem, self.device = problem, torch.device(device)
        x, v, weight = (torch.from_numpy(t) for t in problem.arrays())
        body = Body(x, v, torch.full((problem.count,), problem.volume, dtype=torch.float64))
        self.sim = Simulator(Scene(cells=problem.side, dt=problem.dt), body, density=problem.density, device=device)
        self.weight = weight.float().to(self.device)
        if problem.law == "networks":
            self.elastic, self.plastic, self.leaves = rollout.invariant(1, self.device)
        else:
            self.leaves = [torch.tensor([problem.young], device=self.device, requires_grad=True)]
            self.elastic, self.plastic = NeoHookean(self.leaves[0], problem.poisson), None
        state = self.sim.state  # C begins as the gradient of the velocity; other codes begin without it
        v = state.v.clone().requires_grad_()
        self.state = state._replace(v=v, C=torch.zeros_like(state.C))

    def version(self) -> str:
        """Return the version of the code."""
        return neuido.__version__

    def move(self) -> torch.Tensor:
        """Return the last positions [m], (P, 3)."""
        steps = self.problem.substeps
        return self.sim.rollout(steps, self.elastic, self.plastic, state=self.state, every=steps, check=False).x[-1]

    def forward(self) -> None:
        """Move the body."""
        with torch.no_grad():
            self.last = self.move()

    def gradient(self) -> None:
        """Differentiate the loss with respect to initial velocities and the parameters of the law."""
        self.found = torch.autograd.grad((self.move() * self.weight).sum(), [self.state.v, *self.leaves])[0]

    def wait(self) -> None:
        """Wait for the device."""
        if self.device.type == "cuda":
            torch.cuda.synchronize()

    def positions(self) -> np.ndarray:
        """Return the last positions of the last forward call [m]."""
        return self.last.cpu().numpy()

    def slopes(self) -> np.ndarray:
        """Return the gradient with respect to the initial velocities."""
        return self.found.cpu().numpy()
