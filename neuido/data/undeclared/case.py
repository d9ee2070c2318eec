"""The options of a case with an undeclared effect. No torch at import, so that `--help` stays light."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Case:
    """The fixed part of a case with an undeclared effect; what is left out is drawn from the seed.

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
