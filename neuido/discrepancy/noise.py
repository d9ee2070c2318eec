"""How noisy a series is, from itself: what a local cubic leaves over."""

from typing import NamedTuple

import numpy as np

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
"""Of the polynomial that stands for a whole motion, whatever moves it."""


def correlation(series: list[tuple[np.ndarray, np.ndarray]]) -> SeriesError:
    """The error of series whose true course is smooth: what a polynomial of degree five leaves of each.

    The independent part is that of `high_pass` (the median over the series); the rest of the variance is the slow part, whose time comes
    from the covariance of neighbouring samples. No model of the motion enters. What is slower than the polynomial does not show.

    Args:
        series: Times [s] and values of each, (n,).

    Returns:
        Sigma and amplitude in the unit of the values. Series too short for either count as exact to 1e-9 of their extent.
    """
    extent = max(float(np.ptp(y)) for _, y in series)
    sigmas = [s for s in (high_pass([piece]) for piece in series) if s is not None]
    sigma = max(float(np.median(sigmas)) if sigmas else 0.0, 1e-9 * extent, 1e-12)
    squares, products, gaps = [], [], []
    for t, y in series:
        if len(t) < 3 * (DEGREE + 1):
            continue
        basis = np.polynomial.legendre.legvander(2 * (t - t[0]) / (t[-1] - t[0]) - 1, DEGREE)
        left = y - basis @ np.linalg.lstsq(basis, y, rcond=None)[0]
        squares.append(float(left @ left) / (len(t) - DEGREE - 1))
        products.append(float(left[1:] @ left[:-1]) / (len(t) - DEGREE - 2))
        gaps.append(float(np.median(np.diff(t))))
    slow = max(float(np.mean(squares)) - sigma**2, 0.0) if squares else 0.0
    if not slow > 0:
        return SeriesError(sigma, 0.0, 1.0)
    gap = float(np.mean(gaps))
    share = float(np.clip(np.mean(products) / slow, np.exp(-2.0), np.exp(-0.1)))
    return SeriesError(sigma, slow**0.5, -gap / np.log(share))
