"""Thresholds for the model evidence, calibrated on blind cases whose true effects are known.

Each row of `calibration.csv` is one case that went through a whole diagnosis, search included. It holds how far the evidence of the true
model was behind that of the best one. The cases are nulls, and experiments with effects of the library whose true set was fitted near
its optimum. `benchmarks/calibrate.py` writes the table. Thresholds are conformal quantiles of its n rows: in a further case, drawn like
these, the true model is no further behind with a probability of at least 1 - alpha, if alpha >= 1 / (n + 1). For a smaller alpha the
largest value is used. Source: Vovk, Gammerman and Shafer, Algorithmic Learning in a Random World, 2005.
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
"""Accepted probability of a false alarm (an effect is named, but none is missing), and of a class without the true set of effects."""


@dataclass(frozen=True)
class Calibration:
    """Differences of log-evidence between the best and the true model, in cases whose truth is known."""

    nulls: tuple[float, ...]
    """Lead of the best model over the declared one in each null."""
    effects: tuple[float, ...]
    """Lead of the best model over the true set of effects in each case with effects."""
    beyond: tuple[float, ...] = ()
    """`evidence.Evidence.beyond` of the true model in each case."""

    def least_lead(self, alpha: float = ALPHA) -> float:
        """Return the lead over the declared model, as a difference of log-evidence, above which a model is named."""
        return quantile(self.nulls, alpha)

    def class_margin(self, alpha: float = ALPHA) -> float:
        """Return the difference of log-evidence above which the data distinguish a set of effects from the best one."""
        return quantile(self.effects, alpha)

    def unknown_threshold(self, alpha: float = ALPHA) -> float:
        """Return the value of `evidence.Evidence.beyond` above which an unknown effect is missing.

        It is never below log(1 / alpha). If nothing is missing, the ratio of densities with a free and with the least scale has mean one,
        so that it exceeds 1 / alpha with a probability of at most alpha (Markov's inequality).
        """
        return max(quantile(self.beyond, alpha) if self.beyond else 0.0, -math.log(alpha))

    def p_value(self, lead: float) -> float:
        """Return the share of nulls whose lead is at least this large; the present case counts as one of them."""
        return (1 + sum(own >= lead for own in self.nulls)) / (1 + len(self.nulls))


def quantile(values: Sequence[float], alpha: float) -> float:
    """Return the conformal quantile of values at level 1 - alpha: infinite without values, the largest of them if they are too few."""
    if not values:
        return math.inf
    return sorted(values)[min(math.ceil((len(values) + 1) * (1.0 - alpha)), len(values)) - 1]


def calibration_of(rows: Sequence[Mapping[str, Any]]) -> Calibration:
    """Return the calibration from rows of the table, as dictionaries by column."""
    behind = {missing: tuple(float(r["behind"]) for r in rows if (r["kind"] != "none") == missing) for missing in (False, True)}
    return Calibration(behind[False], behind[True], tuple(float(r["beyond"]) for r in rows))


@cache
def calibration(table: Path = TABLE) -> Calibration:
    """Read the calibration from a CSV file; the result is cached."""
    with table.open(newline="") as stream:
        return calibration_of(list(csv.DictReader(stream)))
