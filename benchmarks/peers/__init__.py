"""The common problem of `side_by_side.py`, and the codes that solve it."""

from dataclasses import dataclass

import numpy as np

PEERS = {
    "neuido": "peers.engine:Engine",
    "NeuMA-like": "peers.loops:NeumaLike",
    "MASIV-like": "peers.loops:MasivLike",
    "taichi": "peers.taichi_mpm:TaichiMpm",
}
"""Names of the codes and their classes; the first is the one that the others are compared with."""


@dataclass(frozen=True)
class Problem:
    """A block of `side`^3 particles, eight in a cell, in a grid of `side`^3 cells in the unit cube."""

    side: int
    substeps: int
    law: str
    """`neo-hookean`, or `networks` for those of NCLaw."""
    dt: float = 1e-4
    young: float = 1e5
    poisson: float = 0.3
    density: float = 1000.0

    @property
    def count(self) -> int:
        """The number of particles."""
        return self.side**3

    @property
    def volume(self) -> float:
        """The volume of a particle [m^3]."""
        return 0.5**3 / self.count

    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return positions [m], velocities [m/s] and the weights of the loss, (P, 3) each."""
        axis = 0.25 + (np.arange(self.side) + 0.5) * 0.5 / self.side
        x = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
        spread = np.array([[2.0, 1.0, 0.0], [0.0, -2.0, 0.5], [0.5, 0.0, 1.0]])
        v = np.array([0.0, -1.0, 0.0]) + (x - 0.5) @ spread.T
        return x, v, np.random.default_rng(1).standard_normal(x.shape)
