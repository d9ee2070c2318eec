"""What the tests themselves say: their noise, the scatter of specimens, the stiffness, and which effects they can tell at all.

The shares below were halved and doubled on 57 folders, nine of them real (research/log, 28 November 2026). `COMMON`, `RESTS` and `STRAINED`
changed no candidate and no repeat, but for double compressions beyond `COMMON` = 0.9. `SAME_PACE` between 1.25 and 2 changed the repeats of
three. `FIRST` changes the modulus that a loading shows by a fifth to a half, on which only starts of fits and a warning rest.
"""

import math
from collections.abc import Sequence

import numpy as np

from neuido.data.measured.material_test import CURVES, MaterialTest, MaterialTests
from neuido.discrepancy.problems.noise import high_pass, monotone_pieces, surface

COMMON = 0.5
"""Share of its range that two tests must have in common to count as repeats."""
SAME_PACE = 1.5
"""Ratio of the mean rates of two tests up to which they are repeats, and from which they show the rate."""
SAME_STRESS = 0.05
"""Mean difference of two prescribed stresses, as a share of their size, up to which tests under them are repeats."""
COMPARED = 50
"""Strains at which repeats are compared."""
RESTS = 0.2
"""Share of the fastest rate of a test below which it holds its strain."""
STRAINED = 0.2
"""Share of the largest strain from which a hold or a return tells something."""
FIRST = 0.1
"""Share of the range of a loading from whose rows its slope at the start is taken."""
LEAST_ROWS = 3
"""Least number of rows of a hold, of a loading and of a test: a straight line leaves one degree of freedom of them."""


def strain_of(test: MaterialTest) -> np.ndarray:
    """Return logarithmic stretches, shears, or the logarithms of frequencies and shear rates, (n, w)."""
    return test.path if test.mode == "simple_shear" else np.log(test.path)


def noise_of(test: MaterialTest) -> float | None:
    """Estimate the standard deviation of the independent noise of what was measured, by local cubics (`noise.high_pass`).

    A stress is followed along its path; a strain under a prescribed stress along the time, evenly in its logarithm. Where no monotone part
    of the path is long enough, as in a grid of biaxial states or a curve in disorder, a curve is sorted by strain and states are fitted
    with a smooth surface. The estimate is at least 1e-4 of the largest value, the rounding of three or four digits in a file. None where
    there are too few rows.
    """
    if test.noise is not None:
        return test.noise
    y = test.measured.reshape(len(test.path), -1)
    if test.control == "stress":
        at = np.arange(len(y), dtype=float) if test.time is None else np.log(test.time - test.time[0] + np.diff(test.time).min())
        found, least = high_pass([(at, y[:, 0])]), 1e-4 * float(np.ptp(y))
        return None if found is None else max(found, least)
    e = strain_of(test)
    pieces = []
    for rows in monotone_pieces(e):
        steps = np.linalg.norm(np.diff(e[rows], axis=0), axis=1)
        if test.time is not None:  # a hold has no path: its rows follow the clock
            steps = steps / max(steps.sum(), 1e-300) + 1.0 / len(e)
        at = np.concatenate([[0.0], np.cumsum(steps)])
        pieces += [(at, channel) for channel in y[rows].T]
    found = high_pass(pieces)
    if found is None and e.shape[1] == 1:
        order = np.argsort(e[:, 0], kind="stable")
        found = high_pass([(e[order, 0], channel) for channel in y[order].T])
    if found is None:
        each = [one for channel in y.T if (one := surface(e, channel)) is not None]
        found = math.sqrt(np.mean(np.square(each))) if each else None
    largest = 1.0 if test.mode in CURVES else float(np.abs(y).max())
    return None if found is None else max(found, 1e-4 * largest)


def are_repeats(a: MaterialTest, b: MaterialTest) -> bool:
    """Return whether two tests are of the same kind, over much the same range, and as fast, or under the same stress."""
    same = all(getattr(a, key) == getattr(b, key) for key in ("mode", "direction", "control", "true_stress", "periodic"))
    if not same or a.path.shape[1] > 1 or (a.time is None) != (b.time is None):
        return False
    (x, _), (y, _) = _curve(a), _curve(b)
    low, high = max(x[0], y[0]), min(x[-1], y[-1])
    if high - low < COMMON * max(np.ptp(x), np.ptp(y)) or min(len(x), len(y)) < LEAST_ROWS:
        return False
    if a.control == "stress":
        at = np.linspace(low, high, COMPARED)
        one, other = (np.interp(at, _clock(t), t.stress[:, 0]) for t in (a, b))
        return float(np.abs(one - other).mean()) < SAME_STRESS * float(np.abs(one).mean())
    if a.time is None or a.mode in CURVES:
        return True
    pace = math.log(mean_rate(a) / mean_rate(b))
    return abs(pace) < math.log(SAME_PACE)


def mean_rate(test: MaterialTest) -> float:
    """Return the mean rate of the strain over the first loading of a test [1/s]."""
    n = _first_loading(test)
    return max(float(np.ptp(strain_of(test)[:n, 0])) / max(float(np.ptp(test.time[:n])), 1e-300), 1e-300)  # type: ignore[index]


def _first_loading(test: MaterialTest) -> int:
    """Return the number of rows before a path turns back or rests for the first time."""
    e = strain_of(test)
    stop = max(monotone_pieces(e)[0].stop or len(e), 1)
    if test.time is None:
        return stop
    rests = np.convolve(_holds(test), np.ones(LEAST_ROWS), "valid") == LEAST_ROWS  # from this step on
    return min(stop, int(rests.argmax()) + 1) if rests.any() else stop


def _holds(test: MaterialTest) -> np.ndarray:
    """Return whether each step of a path in time holds a large strain, (n - 1,)."""
    e = strain_of(test)
    size = np.abs(e).max(axis=1)
    speed = np.abs(np.diff(e, axis=0)).max(axis=1) / np.diff(test.time)  # type: ignore[arg-type]
    return (speed < RESTS * speed.max()) & (size[1:] > STRAINED * size.max())


def scatter(tests: MaterialTests) -> dict[int, float]:
    """Estimate how much repeats differ: the standard deviation about their mean, in the unit of what was measured, by test.

    Specimens of one material differ by some percent, and so does a machine from day to day; no effect explains that, and no fit should.
    A test that was not repeated counts with the share by which the others differ. Empty where no test was repeated.
    """
    chained = {i for chain in tests.histories() if len(chain) > 1 for i in chain}
    groups: list[list[int]] = []
    for i, test in enumerate(tests.tests):
        if i in chained or test.path.shape[1] > 1:
            continue
        own = next((g for g in groups if are_repeats(tests.tests[g[0]], test)), None)
        groups.append([i]) if own is None else own.append(i)
    found, shares = {}, []
    for group in (group for group in groups if len(group) > 1):
        curves = [_curve(tests.tests[i]) for i in group]
        low, high = max(c[0][0] for c in curves), min(c[0][-1] for c in curves)
        at = np.linspace(low, high, COMPARED)
        values = np.stack([[np.interp(at, x, channel) for channel in y] for x, y in curves])
        one = float(np.sqrt(np.mean(values.var(axis=0, ddof=1))))
        found |= dict.fromkeys(group, one)
        shares.append(one / _size(values, tests.tests[group[0]]))
    for (i,) in (group for group in groups if len(group) == 1 and shares):
        found[i] = float(np.sqrt(np.mean(np.square(shares)))) * _size(_curve(tests.tests[i])[1], tests.tests[i])
    return found


def _size(values: np.ndarray, test: MaterialTest) -> float:
    """Return the root mean square of what was measured; 1 of logarithms, whose scatter is a share already."""
    return 1.0 if test.mode in CURVES else max(float(np.sqrt(np.mean(values**2))), 1e-300)


def _clock(test: MaterialTest) -> np.ndarray:
    """Return the times of a test from its first row [s], or the numbers of its rows."""
    return np.arange(len(test.path), dtype=np.float64) if test.time is None else test.time - test.time[0]


def _curve(test: MaterialTest) -> tuple[np.ndarray, np.ndarray]:
    """Return abscissae (n,), increasing, and what was measured at them, (w, n), over the first loading of a test.

    The abscissa is a strain; of a test under a prescribed stress it is the time of the whole test, of a curve its frequency or rate.
    """
    values = test.measured.reshape(len(test.path), -1)
    if test.control == "stress":
        return _clock(test), values.T
    n = len(values) if test.mode in CURVES else _first_loading(test)
    e = strain_of(test)[:n, 0]
    order = np.argsort(e, kind="stable")
    return e[order], values[:n][order].T


def stiffness(tests: Sequence[MaterialTest], poisson: float) -> float | None:
    """Return the largest Young's modulus that the fitted tests show at rest or where they turn back [Pa]; None where too few rows do.

    It is the slope of the first rows of each loading. A law that yields or relaxes has no larger slope anywhere.
    """
    found = []
    for test in tests:
        if test.mode in CURVES or test.control == "stress" or test.path.shape[1] > 1 or test.periodic:
            continue
        e, s = strain_of(test)[:, 0], test.stress[:, 0]
        factor = {"simple_shear": 2 * (1 + poisson), "equibiaxial": 1 - poisson, "pure_shear": 1 - poisson**2}.get(test.mode, 1.0)
        for rows in monotone_pieces(e[:, None]):
            x, y = e[rows], s[rows]
            if len(x) < 2 * LEAST_ROWS or np.ptp(x) < STRAINED * np.ptp(e):
                continue
            near = np.abs(x - x[0]) <= FIRST * np.ptp(x)
            if near.sum() < LEAST_ROWS:
                near[:LEAST_ROWS] = True
            slope = np.polyfit(x[near], y[near], 1)[0] * factor
            found.append(float(slope))
    return float(np.median(sorted(found)[-3:])) if found and max(found) > 0 else None


def shows_time(tests: Sequence[MaterialTest]) -> bool:
    """Return whether tests can show an effect of time or rate: a hold, a way back, two rates, a prescribed stress, or an oscillation.

    One loading at one rate cannot: what a relaxation takes from it, another elastic law takes as well.
    """
    timed = [t for t in tests if t.time is not None]
    if any(t.mode == "oscillation" for t in tests) or any(t.control == "stress" for t in timed):
        return True
    for test in timed:
        if _holds(test).sum() >= LEAST_ROWS or turns_back(test):
            return True
    for i, a in enumerate(timed):
        for b in timed[:i]:
            same = a.mode == b.mode and a.direction == b.direction and a.control == b.control and a.path.shape[1] == 1
            if same and a.mode not in CURVES and abs(math.log(mean_rate(a) / mean_rate(b))) > math.log(SAME_PACE):
                return True
    return False


def shows_ageing(tests: Sequence[MaterialTest]) -> bool:
    """Return whether a stiffness that changes in time would show beside a relaxation: the specimen is loaded anew at a later time."""
    for test in tests:
        if test.time is None or test.mode in CURVES or test.control == "stress":
            continue
        size = np.abs(strain_of(test)).max(axis=1)
        rises = [np.ptp(size[rows]) for rows in monotone_pieces(size[:, None]) if size[rows][-1] > size[rows][0]]
        if sum(rise > 0.3 * size.max() for rise in rises) > 1:
            return True
    return False


def turns_back(test: MaterialTest) -> bool:
    """Return whether more than a fifth of the length of a path runs back over what was passed before, in every column."""
    e = strain_of(test)
    return len(e) > 2 and bool((np.ptp(e, axis=0) < 0.8 * np.abs(np.diff(e, axis=0)).sum(axis=0)).all())
