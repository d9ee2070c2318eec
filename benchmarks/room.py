"""Compare the memory of a body in a tight domain with that in domains many times larger.

    python benchmarks/room.py [--device cuda] [--particles 1000000] [--factors 1 10 100] [--out runs/room]

The body is a cube on a regular lattice, eight particles a cell, that falls. The tight domain leaves five cells beside it; a factor is the
ratio of the volumes of a domain and the tight one. The tight domain has the grid of the whole domain, the others the one that
`Simulator(grid="auto")` chooses. Memory is the peak of the tensors of a rollout of four substeps, without and with the gradient to
the first velocities. OUT receives `room.md`.
"""

import argparse
import math
from collections.abc import Callable
from pathlib import Path

import torch
from scaling import peak_bytes

from neuido import Body, Scene, Simulator, laws

EDGE, MARGIN, SUBSTEPS = 1.0, 5, 4
"""Edge of the body [m], empty cells beside it, and substeps of a rollout."""


def falling_cube(particles: int, factor: float) -> tuple[Scene, Body]:
    """Return a cube of about `particles` particles in the middle of a domain, `factor` times as large as the tight one."""
    side = 2 * max(1, round(particles ** (1 / 3) / 2))
    cells = math.ceil((side // 2 + 2 * MARGIN) * factor ** (1 / 3))
    dx = 2 * EDGE / side
    line = 0.5 * (cells * dx - EDGE) + EDGE * (torch.arange(side) + 0.5) / side
    x = torch.cartesian_prod(line, line, line)
    v = torch.tensor([0.0, -1.0, 0.0]).expand_as(x).clone()
    return Scene(upper=(cells * dx,) * 3, cells=cells, dt=1e-4), Body(x, v, torch.full((len(x),), (EDGE / side) ** 3))


def rollouts(particles: int, factor: float, device: torch.device) -> tuple[Callable[[], object], Callable[[], object]]:
    """Return two functions for a rollout: the forward pass alone, and forward and backward pass."""
    scene, body = falling_cube(particles, factor)
    body.v.requires_grad_()
    simulator = Simulator(scene, body, device=device, grid="domain" if factor == 1 else "auto")
    law = laws.FixedCorotated(1e5, 0.3)

    def alone() -> None:
        with torch.no_grad():
            simulator.rollout(SUBSTEPS, law, every=SUBSTEPS)

    def both() -> None:
        torch.autograd.grad(simulator.rollout(SUBSTEPS, law, every=SUBSTEPS).x[-1].sum(), body.v, retain_graph=True)

    return alone, both


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--particles", type=int, default=1_000_000)
    parser.add_argument(
        "--factors", type=float, nargs="+", default=[1, 10, 100], help="volumes over that of the tight domain; the first must be 1"
    )
    parser.add_argument("--out", type=Path, default=Path("runs/room"))
    options = parser.parse_args(arguments)
    if options.factors[0] != 1:
        parser.error(f"--factors begins with {options.factors[0]:g}; the first must be 1, which the others are compared with")
    device = torch.device(options.device)
    lines = [
        "| volume over the tight one | cells a side | particles | forward MB | over tight | with gradient MB | over tight |",
        "| --- " * 7 + "|",
    ]
    tight: list[float] = []
    for factor in options.factors:
        scene, body = falling_cube(options.particles, factor)
        peaks = [peak_bytes(lambda k=k, factor=factor: rollouts(options.particles, factor, device)[k], device) / 1e6 for k in range(2)]
        tight = tight or peaks
        cells = " | ".join(f"{peak:,.0f} | {peak / first:.2f}" for peak, first in zip(peaks, tight))
        lines.append(f"| {factor:g} | {scene.cells} | {len(body.x):,} | {cells} |")
        print(lines[-1], flush=True)
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "room.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
