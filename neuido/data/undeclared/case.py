"""Options of a case with an undeclared effect. This module does not load torch, so that `--help` stays fast."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Case:
    """Fixed properties of a case with an undeclared effect; the others are drawn at random.

    Args:
        measured: body (an experiment folder), driven (a bar pulled by a clamp, with its forces), material_test, track, or guided (tracks of
            pendulums, springs, axes, planes, bounces, discs).
        kind: An effect of the library, an effect outside the library, `none`, or two effects of the library joined by a plus sign.
        solver: Solver of a body: same (grid and substep that the folder suggests), finer (36 to 44 cells, half the substep) or elements
            (finite elements).
        nuisances: Whether clock, latency, ruler, launch speed and spin of a body are wrong by one to two standard deviations. Default:
            random for a case without an effect, no otherwise.
        separation: RMS distance by which the effect moves the recorded points, in standard deviations of the noise.
        particles: Approximate number of particles of a body; 0: 1500 to 2900.
        seconds: Length of a body's recordings, s; 0: 0.4 to 0.6.
    """

    measured: str = "body"
    kind: str | None = None
    solver: str | None = None
    nuisances: bool | None = None
    separation: float | None = None
    particles: int = 0
    seconds: float = 0.0
