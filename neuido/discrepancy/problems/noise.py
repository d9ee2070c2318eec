"""Estimates of measurement noise from the data alone, by the residual of local polynomials."""

import itertools
import math
from typing import NamedTuple

import numpy as np

LEAST_ROWS = 8
"""Least number of rows for the fit of a surface."""
DEGREES = (3, 5, 7, 9)
"""Degrees of the local polynomials of `high_pass`. A higher one follows a motion of few samples a swing."""
FREEDOM = 3
"""Samples per window beyond the degree of its polynomial, which leaves two degrees of freedom."""
FALLS = 1.5
"""Factor by which a higher degree must lower the estimate to count: a smaller fall is within the scatter of some forty samples."""


def high_pass(pieces: list[tuple[np.ndarray, np.ndarray]]) -> float | None:
    """Estimate the standard deviation of the independent noise of a piecewise smooth series.

    A cubic is fitted to every window of six neighbouring samples. The variance of the noise is the median over the windows of the sum of
    squared residuals, divided by its median for noise of variance one: 2 ln 2, that of chi^2 with two degrees of freedom. Because it is a
    median, a few corners and outliers hardly change it. Where polynomials of higher degree in longer windows leave far less, the cubic has
    left a part of the motion, and they count.

    Args:
        pieces: Abscissae (n,) and values (n,) of each smooth piece, in the order of the abscissae.

    Returns:
        The standard deviation in the unit of the values. None where no piece has six samples.
    """
    best = None
    for degree in DEGREES:
        found = [_window_squares(at, values, degree) for at, values in pieces]
        squares = np.concatenate(found) if found else np.empty(0)
        if not len(squares):
            break
        one = float(np.sqrt(np.median(squares) / (2 * np.log(2))))
        best = one if best is None or one * FALLS < best else best
    return best


def _window_squares(at: np.ndarray, values: np.ndarray, degree: int) -> np.ndarray:
    """Return the sum of squared residuals of a polynomial in each window of neighbouring samples (n,); empty for a short series."""
    width = degree + FREEDOM
    if len(values) < width:
        return np.empty(0)
    x, y = (np.lib.stride_tricks.sliding_window_view(np.asarray(a, dtype=np.float64), width) for a in (at, values))
    span = np.ptp(x, axis=1)
    usable = (span > 0) & (np.sum(np.diff(np.sort(x, axis=1), axis=1) > 0, axis=1) > degree)
    x, y, span = x[usable], y[usable], span[usable]
    if not len(x):
        return np.empty(0)
    basis = np.polynomial.legendre.legvander(2 * (x - x.min(axis=1, keepdims=True)) / span[:, None] - 1, degree)
    q = np.linalg.qr(basis)[0]
    y = y - y.mean(axis=1, keepdims=True)
    left = y - np.einsum("wij,wj->wi", q, np.einsum("wij,wi->wj", q, y))
    return np.sum(left**2, axis=1)


AROUND = 4
"""Samples on either side of one that tell whether it is a stray."""
STRAY = 8.0
"""Distance of a stray from the cubic through its neighbours, in standard deviations of the noise or of what they leave of the cubic. The
largest ratios found without strays are 5.3 at a bounce, 4.3 in 10,000 samples of noise, and 2.3 in a swing of four samples."""
STRAY_SHARE = 0.05
"""Largest share of the samples that may be strays: beyond it the course is not smooth."""


def strays(at: np.ndarray, values: np.ndarray, noise: float) -> np.ndarray:
    """Return which samples of smooth series lie far from their neighbours on both sides, as where a tracker lost its point, (n,).

    Args:
        at: Abscissae (n,), increasing.
        values: Series (n, k).
        noise: Standard deviation of their independent noise.
    """
    n, width = len(at), 2 * AROUND + 1
    out = np.zeros(n, bool)
    if n < width:
        return out
    x = np.lib.stride_tricks.sliding_window_view(at, width)
    y = np.lib.stride_tricks.sliding_window_view(values, width, axis=0).swapaxes(1, 2)  # (windows, width, k)
    every, ends = np.arange(len(x)), range(2, AROUND)
    places = [(every, AROUND), *((every[:1], j) for j in ends), *((every[-1:], width - 1 - j) for j in ends)]
    for windows, j in places:  # each sample is the middle of a window; those near an end are elsewhere in the first or last one
        rows = np.delete(np.arange(width), j)
        near, around = x[windows][:, rows] - x[windows, j, None], y[windows][:, rows] - y[windows, j, None]
        basis = (near / np.ptp(x[windows], axis=1)[:, None])[..., None] ** np.arange(4)
        found = np.linalg.pinv(basis) @ around
        left = np.sqrt(np.sum((around - basis @ found) ** 2, axis=1) / (len(rows) - 4))
        out[windows + j] |= (np.abs(found[:, 0]) > STRAY * np.maximum(left, noise)).any(axis=1)
    return out if out.sum() <= STRAY_SHARE * n else np.zeros(n, bool)


def surface(at: np.ndarray, values: np.ndarray) -> float | None:
    """Estimate the standard deviation of the independent noise of values at scattered places, by a smooth surface through them.

    The surface is a polynomial of total degree one to four with at most half as many terms as there are values. Its degree is the one with
    the least leave-one-out error.

    Args:
        at: Places, (n, d).
        values: Values at the places, (n,).

    Returns:
        The standard deviation in the unit of the values. None for fewer than eight values.
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
"""Largest number of series of a recording from which its noise is estimated."""
ASSUMED = 1e-3
"""Assumed noise where it can be neither read nor estimated, as a share of the variation of the data (`moved`)."""
UNSURE = 9.0
"""Relative standard deviation of an assumed noise: it may be ten times as large."""
OVERLAP = 1.5
"""Relative variance of the estimate of `high_pass`, times the number of data: large, for it is a median of overlapping windows."""


def of_series(values: np.ndarray, groups: np.ndarray, times: np.ndarray) -> float | None:
    """Estimate the noise of a recording: the median over its series of the estimates of `high_pass`.

    Args:
        values: Data, (n,).
        groups: Series that each value belongs to, (n,).
        times: Time of each value, (n,).

    Returns:
        The standard deviation in the unit of the values. None where all series are too short.
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
    """Return the root mean square deviation of values (n,) from the mean of their series.

    `groups` (n,) names the series of each value. The result does not depend on the origin or on the order of the values.
    """
    _, index = np.unique(groups, return_inverse=True)
    means = np.bincount(index, values) / np.bincount(index)
    return float(np.sqrt(np.mean((values - means[index]) ** 2)))


def monotone_pieces(path: np.ndarray) -> list[slice]:
    """Divide a path (n, k) into the longest runs of rows in which every column is monotone."""
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
    """Model of a measurement error with the covariance sigma^2 delta + amplitude^2 exp(-|dt| / time)."""

    sigma: float
    """Standard deviation of the independent noise."""
    amplitude: float
    """Standard deviation of the slow error."""
    time: float
    """Correlation time of the slow error [s]."""

    def covariance(self, t: np.ndarray) -> np.ndarray:
        """Return the covariance matrix (n, n) of samples at times t (n,) [s]."""
        slow = self.amplitude**2 * np.exp(-np.abs(t[:, None] - t[None]) / self.time)
        return slow + self.sigma**2 * np.eye(len(t))


DEGREE = 5
"""Degree of the local polynomials by which the slow error is estimated."""
WINDOW_GROWTH = 4 / 3
"""Ratio of the lengths of successive windows for the slow error."""
LARGEST_GROWTH = 1.6
"""Largest growth of the residual variance from one window length to the next that is attributed to a slow error.

The residual variance of a smooth motion grows by (4/3)^12 = 32 with polynomials of degree five; that of a slow error grows far less.
"""


def correlation(series: list[tuple[np.ndarray, np.ndarray]]) -> SeriesError:
    """Estimate the measurement error of series whose true course is smooth, without a model of the motion.

    The independent noise is the median over the series of the estimates of `high_pass`. The slow error is the residual of polynomials of
    degree five in windows that grow up to the whole series. They grow only while the residual variance does so slowly (`LARGEST_GROWTH`): a
    sudden growth comes from the motion. The correlation time follows from the covariance of neighbouring residuals in the longest window.

    Args:
        series: Times [s] and values of each series, (n,) each.

    Returns:
        The error, with sigma and amplitude in the unit of the values. For series that are too short, sigma is 1e-9 of their range.
    """
    extent = max(float(np.ptp(y)) for _, y in series)
    sigmas = [s for s in (high_pass([piece]) for piece in series) if s is not None]
    sigma = max(float(np.median(sigmas)) if sigmas else 0.0, 1e-9 * extent, 1e-12)
    variance, width, slow = sigma**2, 2 * (DEGREE + 1), None
    longest = max((len(t) for t, _ in series), default=0)
    while longest >= 3 * (DEGREE + 1) and width <= longest:
        wider = _left_by_windows(series, width)
        if wider is None or wider[0] > LARGEST_GROWTH * variance:
            break
        variance, slow = max(wider[0], sigma**2), wider
        width = min(math.ceil(WINDOW_GROWTH * width), longest) if width < longest else longest + 1
    amount = 0.0 if slow is None else slow[0] - sigma**2
    if slow is None or not amount > 0:
        return SeriesError(sigma, 0.0, 1.0)
    gap = float(np.mean([float(np.median(np.diff(t))) for t, _ in series if len(t) > 1]))
    share = float(np.clip(slow[1] / amount, np.exp(-2.0), np.exp(-0.1)))
    return SeriesError(sigma, amount**0.5, -gap / np.log(share))


def _left_by_windows(series: list[tuple[np.ndarray, np.ndarray]], width: int) -> tuple[float, float] | None:
    """Return the variance of the residuals of quintics in windows of `width` samples, and the covariance of neighbouring residuals.

    Both are medians over the windows of a series, averaged over the series. None where all series are too short.
    """
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
