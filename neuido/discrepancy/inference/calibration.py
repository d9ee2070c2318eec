"""How far the true model was behind the best one in cases whose truth is known: the table that evidences are judged by.

`calibration.csv` has a row for each case that ran through a whole diagnosis, search included: nulls, and experiments with effects of the
library whose true set was fitted near its optimum. `benchmarks/calibrate.py` remakes it. A quantile of n such rows is a conformal one:
of the next case, drawn as they were, the true model is at most so far behind with a probability of at least 1 - alpha (Vovk, Gammerman and
Shafer, Algorithmic Learning in a Random World, 2005), if alpha is 1 / (n + 1) or more; below that the largest value stands for it.
"""

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

TABLE = Path(__file__).with_name("calibration.csv")
ALPHA = 0.05
"""Probability of naming anything where nothing is missing, and of a class that lacks the true set."""


@dataclass(frozen=True)
class Calibration:
    """How far true models were behind, differences of evidence."""

    nulls: tuple[float, ...]
    """The declared model, where nothing is missing: what the best other one leads by."""
    effects: tuple[float, ...]
    """The true set of effects."""
    beyond: tuple[float, ...] = ()
    """Of all these true models, what a free scale of the patterns adds to the log-density: `evidence.Evidence.beyond`."""

    def least_lead(self, alpha: float = ALPHA) -> float:
        """Return what a model must lead the declared one by to be named."""
        return quantile(self.nulls, alpha)

    def apart(self, alpha: float = ALPHA) -> float:
        """Return how far behind the best set one is told from it."""
        return quantile(self.effects, alpha)

    def foreign(self, alpha: float = ALPHA) -> float:
        """Return what a free scale must add for something unknown to be there.

        Where the scale is what the settings leave, the mean of the ratio of densities is one, and one of 1 / alpha is as rare as alpha
        (Markov's inequality).
        """
        return max(quantile(self.beyond, alpha) if self.beyond else 0.0, -math.log(alpha))

    def p_value(self, lead: float) -> float:
        """Return the share of nulls with such a lead or a larger one, the present case counted among them."""
        return (1 + sum(own >= lead for own in self.nulls)) / (1 + len(self.nulls))


def quantile(values: Sequence[float], alpha: float) -> float:
    """Return the conformal quantile of values: infinite without any, the largest where they are too few for the level."""
    if not values:
        return math.inf
    return sorted(values)[min(math.ceil((len(values) + 1) * (1.0 - alpha)), len(values)) - 1]


def calibration_of(rows: Sequence[Mapping[str, Any]]) -> Calibration:
    """Return the calibration of rows of the table."""
    behind = {missing: tuple(float(r["behind"]) for r in rows if (r["kind"] != "none") == missing) for missing in (False, True)}
    return Calibration(behind[False], behind[True], tuple(float(r["beyond"]) for r in rows))


@cache
def calibration(table: Path = TABLE) -> Calibration:
    """Return the calibration that a table holds."""
    with table.open(newline="") as stream:
        return calibration_of(list(csv.DictReader(stream)))
