"""How noisy a series is, from itself: what a local cubic leaves over."""

import itertools
import math
from typing import NamedTuple

import numpy as np

LEAST_ROWS = 8
"""Rows that a surface is fitted to, at the least."""
WINDOW = 6
"""Samples in a window; a cubic leaves two degrees of freedom."""


def high_pass(pieces: list[tuple[np.ndarray, np.ndarray]]) -> float | None:
    """Standard deviation of the independent noise of a series that is smooth in pieces.

    A cubic is fitted to every run of six neighbouring samples; the median of the squared residuals, over the median of the same for
    unit noise (that of chi^2 with two degrees of freedom, 2 ln 2), is the variance. Corners and outliers are few and hardly move it.

    Args:
        pieces: Abscissae and values of each smooth piece, (n,) each, in order.

    Returns:
        In the unit of the values; none where no piece has six samples.
    """
    squares = []
    for at, values in pieces:
        for i in range(len(values) - WINDOW + 1):
            x = at[i : i + WINDOW]
            width = np.ptp(x)
            if len(np.unique(x)) < 5 or width <= 0:
                continue
            basis = np.vander((x - x.mean()) / width, 4)
            y = values[i : i + WINDOW]
            squares.append(float(np.sum((y - basis @ np.linalg.lstsq(basis, y, rcond=None)[0]) ** 2)))
    return float(np.sqrt(np.median(squares) / (2 * np.log(2)))) if squares else None


def surface(at: np.ndarray, values: np.ndarray) -> float | None:
    """Standard deviation of the independent noise of rows in any order, from what a polynomial of their place leaves.

    Polynomials of total degree up to four with at most half as many terms as there are rows; the one that counts foretells best the rows
    that it was fitted without.

    Args:
        at: Places, (n, d).
        values: (n,).

    Returns:
        In the unit of the values; none for fewer than eight rows.
    """
    n, d = at.shape
    if n < LEAST_ROWS:
        return None
    span = np.ptp(at, axis=0)
    x = (at - at.mean(axis=0)) / np.where(span > 0, span, 1.0)
    best = None
    for degree in range(1, 5):
        powers = [p for p in itertools.product(range(degree + 1), repeat=d) if sum(p) <= degree]
        basis = np.stack([np.prod(x ** np.array(p), axis=1) for p in powers], axis=1)
        u, s, _ = np.linalg.svd(basis, full_matrices=False)
        u = u[:, s > 1e-9 * s[0]]
        if 2 * u.shape[1] > n:
            break
        left = values - u @ (u.T @ values)
        foretold = float(np.sum((left / np.maximum(1.0 - np.sum(u**2, axis=1), 1e-6)) ** 2))
        if best is None or foretold < best[0]:
            best = foretold, math.sqrt(float(left @ left) / (n - u.shape[1]))
    return best[1] if best else None


MOST_SERIES = 300
"""Series of a recording that its noise is read from, at the most."""
ASSUMED = 1e-3
"""Noise where nothing says what it is, as a share of how far the data move."""
UNSURE = 9.0
"""Relative standard deviation of a noise that is assumed: it may be ten times as large."""
OVERLAP = 1.5
"""Over the number of data: the square of the relative deviation of `high_pass`, whose windows overlap and which is a median."""


def of_series(values: np.ndarray, groups: np.ndarray, times: np.ndarray) -> float | None:
    """Noise of a recording from its own series: the median over the groups of what `high_pass` finds; none where all are too short.

    Args:
        values: All data, (n,).
        groups: Which series each belongs to, (n,).
        times: (n,).
    """
    names = np.unique(groups)
    found = []
    for name in names[:: max(len(names) // MOST_SERIES, 1)]:
        own = np.flatnonzero(groups == name)
        own = own[np.argsort(times[own], kind="stable")]
        one = high_pass([(times[own], values[own])])
        found += [] if one is None else [one]
    return float(np.median(found)) if found else None


def moved(values: np.ndarray, groups: np.ndarray) -> float:
    """Root mean square of how far the data of each series lie from its mean: independent of the origin and of the order of rows."""
    _, index = np.unique(groups, return_inverse=True)
    means = np.bincount(index, values) / np.bincount(index)
    return float(np.sqrt(np.mean((values - means[index]) ** 2)))


def monotone_pieces(path: np.ndarray) -> list[slice]:
    """The longest runs of rows along which no column of a path (n, k) turns round."""
    out, start, sign = [], 0, np.zeros(path.shape[1])
    for i in range(1, len(path)):
        step = np.sign(path[i] - path[i - 1])
        if (step * sign < 0).any():
            out.append(slice(start, i))
            start, sign = i, np.zeros(path.shape[1])
        else:
            sign = np.where(step != 0, step, sign)
    return [*out, slice(start, len(path))]


class SeriesError(NamedTuple):
    """Error of a series: independent noise and a slow part, covariance sigma^2 delta + amplitude^2 exp(-|dt| / time)."""

    sigma: float
    amplitude: float
    time: float
    """[s]"""

    def covariance(self, t: np.ndarray) -> np.ndarray:
        """Of samples at times t (n,), (n, n)."""
        slow = self.amplitude**2 * np.exp(-np.abs(t[:, None] - t[None]) / self.time)
        return slow + self.sigma**2 * np.eye(len(t))


DEGREE = 5
"""Of the local polynomials that the slow part is read from."""
WIDER = 4 / 3
"""Ratio of the lengths of successive windows that are tried for it."""
AT_ONCE = 1.6
"""Largest growth of the variance from one window to the next that is an error's. What a smooth motion leaves of a polynomial of degree five
grows by (4/3)^12 = 32, that of an error by the share of its slow part at the most."""


def correlation(series: list[tuple[np.ndarray, np.ndarray]]) -> SeriesError:
    """The error of series whose true course is smooth, from what local polynomials leave; no model of the motion enters.

    The independent part is that of `high_pass`, the median over the series. The slow part is read from quintics in ever longer windows, up
    to the whole series, for as long as what they leave grows slowly: a motion that turns round leaves suddenly more, and that is no error.
    Its time comes from the covariance of neighbouring samples in the longest of these windows.

    Args:
        series: Times [s] and values of each, (n,).

    Returns:
        Sigma and amplitude in the unit of the values. Series too short for either count as exact to 1e-9 of their extent.
    """
    extent = max(float(np.ptp(y)) for _, y in series)
    sigmas = [s for s in (high_pass([piece]) for piece in series) if s is not None]
    sigma = max(float(np.median(sigmas)) if sigmas else 0.0, 1e-9 * extent, 1e-12)
    variance, width, slow = sigma**2, 2 * (DEGREE + 1), None
    longest = max((len(t) for t, _ in series), default=0)
    while longest >= 3 * (DEGREE + 1) and width <= longest:
        wider = _left_by_windows(series, width)
        if wider is None or wider[0] > AT_ONCE * variance:
            break
        variance, slow = max(wider[0], sigma**2), wider
        width = min(math.ceil(WIDER * width), longest) if width < longest else longest + 1
    amount = 0.0 if slow is None else slow[0] - sigma**2
    if slow is None or not amount > 0:
        return SeriesError(sigma, 0.0, 1.0)
    gap = float(np.mean([float(np.median(np.diff(t))) for t, _ in series if len(t) > 1]))
    share = float(np.clip(slow[1] / amount, np.exp(-2.0), np.exp(-0.1)))
    return SeriesError(sigma, amount**0.5, -gap / np.log(share))


def _left_by_windows(series: list[tuple[np.ndarray, np.ndarray]], width: int) -> tuple[float, float] | None:
    """Variance, and covariance of neighbours, of what quintics in windows of so many samples leave: medians of windows, means of series."""
    found = []
    for t, y in series:
        n = min(width, len(t))
        if len(t) < 3 * (DEGREE + 1):
            continue
        squares, products = [], []
        for i in range(0, len(t) - n + 1, max(n // 6, 1)):
            x, v = t[i : i + n], y[i : i + n]
            basis = np.polynomial.legendre.legvander(2 * (x - x[0]) / (x[-1] - x[0]) - 1, DEGREE)
            left = v - basis @ np.linalg.lstsq(basis, v, rcond=None)[0]
            squares.append(float(left @ left) / (n - DEGREE - 1))
            products.append(float(left[1:] @ left[:-1]) / (n - DEGREE - 2))
        found.append((float(np.median(squares)), float(np.median(products))))
    if not found:
        return None
    variance, covariance = np.mean(found, axis=0)
    return float(variance), float(covariance)
