"""The size of one plastic step at many points: yield with hardening, backstresses, rate dependence, and creep.

Stresses are vectors of m components whose squares add up to that of the norm. `plane_kernels` solves the same equation in a kernel.
"""

from collections.abc import Callable
from typing import Any

import torch

EXACT = 1e-12
"""Imbalance of a plastic step that ends its solution, relative to the stress."""
ROUNDS = 60
"""Largest number of iterations for a plastic step; bisection alone needs forty."""
LEAST = 1e-12
"""Least first guess of the size, relative to the largest one, that comes from the slope at zero: a power of the rate has none."""
BACKSTRESSES = 3
"""Most backstresses of `nonlinear_backstress`."""
Value = Callable[[str, str], Any]


class Flow:
    """Parameters of the plastic flow of P points.

    Args:
        row: 2 mu, 1/yield stress (0: no yield), H, s, H_k, eta, as in `coefficients.Tables.flow`, (P,) each.
        value: Gives a parameter of an effect of `point_library`, (P,).
        backstresses: Number K of backstresses that saturate.
    """

    def __init__(self, row: tuple[Any, ...], value: Value, backstresses: int) -> None:
        two_mu, inverse, self.H, self.s, self.H_k, self.eta = row
        self.two_mu = two_mu
        self.yields = inverse > 0
        self.limit = torch.where(self.yields, 1 / torch.where(self.yields, inverse, torch.ones_like(inverse)), torch.zeros_like(inverse))
        self.q, self.b = value("cyclic_hardening", "q"), value("cyclic_hardening", "b")
        self.k, self.n = value("rate_power", "k"), value("rate_power", "n")
        rate, exponent, self.stress = (value("creep", part) for part in ("rate", "exponent", "stress"))
        self.creeps = ~self.yields & (rate > 0)
        self.rate = torch.where(self.creeps, rate, torch.ones_like(rate))
        self.power = 1 / torch.where(exponent > 0, exponent, torch.ones_like(exponent))
        self.able = self.yields | self.creeps
        names = [[value("nonlinear_backstress", f"{key}{i + 1}") for i in range(backstresses)] for key in "hg"]
        self.h, self.g = (torch.stack(own, 1) if own else two_mu[:, None][:, :0] for own in names)


class PlasticStep:
    """One step of P points.

    Args:
        flow: The parameters.
        s: 2 mu dev ln V of the trial state less the backstress that does not saturate [Pa], (P, m).
        backs: The backstresses that saturate [Pa], (P, K, m).
        alpha: Accumulated plastic strain before the step [-], (P,).
        dt: Step [s], (P,).
        scale: Factor on the elastic stress, (P,).
    """

    def __init__(self, flow: Flow, s: Any, backs: Any, alpha: Any, dt: Any, scale: Any) -> None:
        self.flow, self.s, self.backs, self.alpha, self.dt = flow, s, backs, alpha, dt
        self.two_mu = flow.two_mu * scale
        self.soft = torch.exp(-flow.s * alpha)

    def _norm(self, xi: Any) -> Any:
        square = (xi * xi).sum(-1)
        return torch.where(square > 0, torch.sqrt(torch.where(square > 0, square, torch.ones_like(square))), 0.0 * square)

    def along(self, size: Any) -> tuple[Any, Any]:
        """Return the plastic strain of a step of a size (P,), (P, m), and the factors 1/(1 + g size), (P, K)."""
        theta = 1 / (1 + self.flow.g * size[:, None])
        xi = self.s - (theta[:, :, None] * self.backs).sum(1)
        q = self._norm(xi)
        return (size / torch.where(q > 0, q, torch.ones_like(q)))[:, None] * xi, theta

    def excess(self, size: Any) -> tuple[Any, Any]:
        """Return by how much the stress exceeds what a step of a size (P,) bears [Pa], and its derivative by the size, (P,) each."""
        f = self.flow
        resist = self.two_mu + f.H_k
        if f.h.shape[1]:
            theta = 1 / (1 + f.g * size[:, None])
            fading = f.g * theta**2
            xi = self.s - (theta[:, :, None] * self.backs).sum(1)
            q = self._norm(xi)
            slope = (xi * (fading[:, :, None] * self.backs).sum(1)).sum(-1) / torch.where(q > 0, q, torch.ones_like(q))
            resist, slope = resist + (theta * f.h).sum(1), slope + (fading * f.h).sum(1) * size
        else:
            q, slope = self._norm(self.s), 0.0 * size
        gone = torch.exp(-f.b * (self.alpha + size))
        bears = (f.limit + f.H * (self.alpha + size) + f.q * (1 - gone)) * self.soft
        stiffer = torch.where(bears > 0, (f.H + f.q * f.b * gone) * self.soft, 0.0 * bears)
        bears = torch.where(bears > 0, bears, 0.0 * bears)
        speed = size / self.dt + 1e-300
        power = f.k * speed**f.n
        creep = torch.where(f.creeps, f.stress * (speed / f.rate) ** f.power, 0.0 * speed)
        drag = f.eta * speed + power + creep
        steeper = (f.eta + (f.n * power + f.power * creep) / speed) / self.dt
        return q - resist * size - bears - drag, slope - resist - stiffer - steeper

    def solved(self) -> Any:
        """Return the size of the step, (P,), zero where nothing flows."""
        with torch.no_grad():
            size, flows = self._solved()
        over, slope = self.excess(size)  # one more step of Newton's method carries the derivative
        return torch.where(flows, size - over / torch.where(slope < 0, slope, -torch.ones_like(slope)).detach(), torch.zeros_like(size))

    def _solved(self) -> tuple[Any, Any]:
        zero = torch.zeros_like(self.two_mu)
        begun, slope = self.excess(zero)
        flows = self.flow.able & (begun > 0)
        if not bool(flows.any()):
            return zero, flows
        norm = self._norm(self.s)
        if self.backs.shape[1]:
            norm = norm + self._norm(self.backs).sum(-1)
        low, high = zero, torch.where(flows, norm / self.two_mu, zero)
        size = begun / -slope
        near = (size > LEAST * high) & (size < high)
        size = torch.where(flows, torch.where(near, size, begun / (begun + norm) * high), zero)
        for _ in range(ROUNDS):
            over, slope = self.excess(size)
            off = flows & (abs(over) > EXACT * norm)
            if not bool(off.any()):
                break
            low, high = torch.where(over > 0, size, low), torch.where(over > 0, high, size)
            further = size - over / torch.where(slope < 0, slope, -torch.ones_like(slope))
            inside = (slope < 0) & (further > low) & (further < high)
            size = torch.where(off, torch.where(inside, further, 0.5 * (low + high)), size)
        return size, flows
