"""Experiments whose model lacks an effect, with a sealed key that says which: options alone, so that `--help` loads no torch."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path


@dataclass(frozen=True)
class Case:
    """What is drawn; everything left out is drawn from the seed.

    Args:
        measured: body (an experiment folder), material_test or track.
        kind: An effect of the vocabulary, one that is outside it, `none`, or two of them joined by a plus sign.
        solver: Of a body: same (the grid and step that the folder suggests), finer (36 to 44 cells, half the step) or elements
            (finite elements).
        nuisances: Whether clock, latency, ruler, launch speed and spin of a body are off by one to two standard deviations; drawn
            for a case without an effect, else no.
        separation: How far the effect moves the recorded points, in standard deviations of the noise.
        particles: About how many particles a body has; 0: 1500 to 3000.
        seconds: Length of a body's recordings, s; 0: 0.4 to 0.6.
    """

    measured: str = "body"
    kind: str | None = None
    solver: str | None = None
    nuisances: bool | None = None
    separation: float | None = None
    particles: int = 0
    seconds: float = 0.0


def make_undeclared(seed: int, out: str, *, case: Case = Case(), device: str = "auto", progress: bool = True) -> "Path":
    """Make one folder to diagnose, and its key at `<out>/../keys/<name>.yaml`; the folder's README has the key's SHA-256.

    On the CPU the same seed and options give the same folder, byte for byte. Nothing that diagnoses reads the key.

    Args:
        seed: Of everything that is drawn.
        out: The folder to make; its name is the name of the case.
        case: What is not to be drawn.
        device: auto, cpu or cuda.
        progress: Show a progress bar.

    Returns:
        The key.

    Raises:
        UserError: An unknown kind or option, a kind that does not fit the others, or a folder that holds something else.
    """
    from neuido.data.undeclared.case import make

    return make(seed, out, case=case, device=device, progress=progress)
