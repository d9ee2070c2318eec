"""Ceiling: the share of a residual that any further effect could explain, estimated by a small network.

The network is fitted to the residual of the fitted recordings and scored on the held-out ones. A share well above zero there means that
something systematic is left that no candidate describes. The network does not explain it.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from neuido.discrepancy.inference.floors import Part
from neuido.discrepancy.inference.search.attribution import Diagnosis
from neuido.physics.runtime.threads import one_thread_each

WIDTH = 32
"""Neurons per hidden layer."""
ROWS = 12_000
"""Largest number of training samples."""
STEPS = 400
"""Largest number of training steps."""
PATIENCE = 6
"""Checks without improvement that end the training (one check every 20 steps)."""
BLOCK = 0.2
"""Share of each recording, in the middle of its time, that is not trained on and decides when the training stops."""


@dataclass(frozen=True)
class Ceiling:
    """Shares of the mean square residual above noise that the network explains: at most 1, negative where it does harm."""

    fit: float
    """Share of the fitted data."""
    held_out: float
    """Share of the held-out data."""
    steps: int
    """Number of training steps of the network."""


def of(d: Diagnosis, when: str, *, seed: int = 0) -> Ceiling:
    """Estimate the ceiling of the residual `before` or `after` (`when`); NaN where a part of the data is not predicted."""
    floor = d.final[when]
    rows = []
    for part in d.parts:
        n = part.recording
        seen = as_seen(d, when, n)
        if not np.isfinite(seen[part.rows]).all():
            return Ceiling(float("nan"), float("nan"), 0)
        features, target, weight = _samples(d, part, seen, d.problem.recordings[n].y - seen, floor.weight[n])
        rows.append((part.fitted, features, target, weight, floor.noise[n]))
    return train([row[:4] for row in rows], noises=[row[4] for row in rows], seed=seed)


def as_seen(d: Diagnosis, when: str, n: int) -> np.ndarray:
    """Predict the data of recording n, (rows,), `before` or `after` (`when`), as the errors of a diagnosis use them.

    The prediction includes the most probable nuisances, and the differences of other settings in the amounts of the fitted recordings.
    """
    point, floor = {"before": d.before, "after": d.after}[when], d.final[when]
    predicted, y = d.problem.predict([point], n, d.setting)[0], d.problem.recordings[n].y
    out = predicted.copy()
    for part in (*d.parts, *d.sealed):
        if part.recording == n:
            out[part.rows] = (y + floor.settle(predicted - y, part, d.amounts[when]))[part.rows]
    return out


def _samples(
    d: Diagnosis, part: Part, predicted: np.ndarray, left: np.ndarray, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the inputs (n, k), residuals (n, c) and weights (n,) of the network for a part of the data."""
    problem, n = d.problem, part.recording
    r = problem.recordings[n]
    if not getattr(problem, "tracked", hasattr(problem, "motion")):
        velocity = _slope(predicted, r.times, r.groups)
        channels = r.groups[:, None] == np.unique(r.groups)[None]
        features = np.concatenate([r.times[:, None], predicted[:, None], velocity[:, None], channels], axis=1)
        return features[part.rows], left[part.rows, None], weight[part.rows]
    count = problem.coordinates(n)
    x, place, speed = (v.reshape(-1, 3) for v in (predicted[:count], *_body_features(d, n, predicted[:count])))
    features = np.concatenate([place, x, speed, r.times[:count].reshape(-1, 3)[:, :1]], axis=1)
    rows, left, weight = (v[:count].reshape(-1, 3) for v in (part.rows, left, weight))
    rows = rows.all(axis=1)
    return features[rows], left[rows], weight[rows].mean(axis=1)


def _body_features(d: Diagnosis, n: int, predicted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the place in the body at t = 0 [m], relative to its centre, and the predicted velocity [m/s] of the tracked points."""
    r = d.problem.recordings[n]
    first = d.problem.measured[n].x.double().numpy()
    whole = d.problem.measured[n].body.x.double().numpy()
    groups, times = r.groups[: len(predicted)], r.times[: len(predicted)]
    point = groups.reshape(-1, 3)[:, 0] // 3
    start = np.where(np.isfinite(first[0]), first[0], whole.mean(axis=0))
    return (start - whole.mean(axis=0))[point], _slope(predicted, times, groups)


def _slope(values: np.ndarray, times: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """Return the time derivative of values (n,) by finite differences within each series (`groups`)."""
    order = np.lexsort((times, groups))
    v, t, g = values[order], times[order], groups[order]
    out = np.zeros_like(values)
    step = np.where(g[1:] == g[:-1], (v[1:] - v[:-1]) / np.maximum(t[1:] - t[:-1], 1e-12), np.nan)
    ahead, behind = np.append(step, np.nan), np.insert(step, 0, np.nan)
    both = np.where(np.isnan(ahead), behind, np.where(np.isnan(behind), ahead, 0.5 * (ahead + behind)))
    out[order] = np.where(np.isnan(both), 0.0, both)
    return out


def train(parts: list[tuple[bool, np.ndarray, np.ndarray, np.ndarray]], *, noises: list[float], seed: int = 0) -> Ceiling:
    """Fit a network to the fitted parts of the data, and score it on all parts.

    Args:
        parts: For each part whether it is fitted, inputs (n, k), residuals (n, c) and weights (n,), with rows in the order of time.
        noises: Standard deviation of the noise of each part, which no network can explain.
        seed: Seed of the initial weights and of the samples.
    """
    generator = torch.Generator().manual_seed(seed)
    fitted = [p for p in parts if p[0]]
    features = np.concatenate([p[1] for p in fitted])
    mean, std = features.mean(axis=0), features.std(axis=0)
    std = np.where(std > 1e-12, std, 1.0)

    def inputs(f: np.ndarray) -> Tensor:
        return torch.from_numpy(np.clip((f - mean) / std, -4.0, 4.0)).float()

    x, y, w = (
        inputs(features),
        torch.from_numpy(np.concatenate([p[2] for p in fitted])),
        torch.from_numpy(np.concatenate([p[3] for p in fitted])),
    )
    size = float(torch.sqrt((y**2).mean())) or 1.0
    y, w = (y / size).float(), (w / w.mean()).float()
    block = torch.cat([_block(len(p[1])) for p in fitted])
    own, aside = torch.nonzero(~block)[:, 0], torch.nonzero(block)[:, 0]
    own, aside = (i[torch.randperm(len(i), generator=generator)[:ROWS]] for i in (own, aside))
    net, steps = _fit(x, y, w, own, aside, generator)
    shares = []
    for (_, f, r, _), noise in zip(parts, noises, strict=True):
        with torch.no_grad():
            left = r - size * net(inputs(f)).double().numpy()
        over = max(float(np.mean(r**2)) - noise**2, 1e-300)
        shares.append(min((float(np.mean(r**2)) - float(np.mean(left**2))) / max(over, 1e-3 * float(np.mean(r**2))), 1.0))

    def joined(which: bool) -> float:
        own = [(len(p[1]), share) for p, share in zip(parts, shares, strict=True) if p[0] == which]
        return float(np.average([s for _, s in own], weights=[c for c, _ in own])) if own else float("nan")

    return Ceiling(joined(True), joined(False), steps)


def _block(count: int) -> Tensor:
    """Return the mask of the middle fifth (`BLOCK`) of `count` rows."""
    at = torch.arange(count) / max(count, 1)
    return (at - 0.5).abs() < BLOCK / 2


@one_thread_each()
def _fit(x: Tensor, y: Tensor, w: Tensor, own: Tensor, aside: Tensor, generator: torch.Generator) -> tuple[nn.Module, int]:
    """Train the network on the rows `own`, until the loss of the rows `aside` no longer falls; return it with its training steps."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(torch.randint(2**31, (1,), generator=generator)))
        net = nn.Sequential(nn.Linear(x.shape[1], WIDTH), nn.SiLU(), nn.Linear(WIDTH, WIDTH), nn.SiLU(), nn.Linear(WIDTH, y.shape[1]))
    nn.init.zeros_(net[-1].weight)
    nn.init.zeros_(net[-1].bias)
    optimizer = torch.optim.AdamW(net.parameters(), lr=5e-3, weight_decay=1e-2)

    def loss(rows: Tensor) -> Tensor:
        return ((net(x[rows]) - y[rows]).square().mean(dim=1) * w[rows] ** 2).mean()

    best, kept, since, steps = float("inf"), None, 0, 0
    for step in range(STEPS + 1):
        if step % 20 == 0:
            with torch.no_grad():
                value = float(loss(aside))
            if value < best * (1 - 1e-4):
                best, since, steps = value, 0, step
                kept = {name: tensor.clone() for name, tensor in net.state_dict().items()}
            else:
                since += 1
                if since >= PATIENCE:
                    break
        rows = own[torch.randint(len(own), (min(2048, len(own)),), generator=generator)]
        optimizer.zero_grad()
        loss(rows).backward()
        optimizer.step()
    if kept is not None:
        net.load_state_dict(kept)
    return net, steps
