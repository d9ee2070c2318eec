"""Small bodies and scenes for the tests of the simulator."""

import os

import torch

from neuido.types import Body, Box, Plane, Scene, Walls

DEVICE = os.environ.get("NEUIDO_TEST_DEVICE", "cpu")
"""Where tests run that are not repeated for each device; `make test-gpu` sets it to cuda."""
DEVICES = [DEVICE] if "NEUIDO_TEST_DEVICE" in os.environ else ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]


def block(lower, upper, counts, velocity=(0.0, 0.0, 0.0), spin=(0.0, 0.0, 0.0)) -> Body:
    """A regular block of counts[0] x counts[1] x counts[2] particles at cell centres, in rigid motion; float64."""
    axes = [l + (torch.arange(n, dtype=torch.float64) + 0.5) * (u - l) / n for l, u, n in zip(lower, upper, counts)]
    x = torch.cartesian_prod(*axes)
    v = torch.tensor(velocity, dtype=torch.float64) + torch.linalg.cross(
        torch.tensor(spin, dtype=torch.float64).expand_as(x), x - x.mean(dim=0)
    )
    size = 1.0
    for l, u in zip(lower, upper):
        size *= u - l
    return Body(x.to(DEVICE), v.to(DEVICE), torch.full((len(x),), size / len(x), dtype=torch.float64, device=DEVICE))


def cloud(count, lower, upper, velocity, seed) -> Body:
    """Random particles with random velocities about a mean; float64."""
    g = torch.Generator().manual_seed(seed)
    x = torch.rand(count, 3, generator=g, dtype=torch.float64) * (upper - lower) + lower
    v = torch.tensor(velocity, dtype=torch.float64) + 0.5 * torch.randn(count, 3, generator=g, dtype=torch.float64)
    return Body(x.to(DEVICE), v.to(DEVICE), torch.full((count,), (upper - lower) ** 3 / count, dtype=torch.float64, device=DEVICE))


def busy_scenes() -> tuple[list[Scene], list[Body]]:
    """Two scenes that between them have every contact, a clamp, a tilted plane, friction, two steps and two domains."""
    scenes = [
        Scene(
            cells=8,
            dt=2e-3,
            colliders=(Plane((0.0, 0.2, 0.0), (0.1, 1.0, 0.2), "separate", 0.3), Plane((0.1, 0.2, 0.0), (1.0, 0.0, 0.0), "slip")),
            walls=Walls("separate", 0.2),
        ),
        Scene(upper=(1.0, 0.9, 0.8), cells=8, dt=1e-3, walls=Walls("sticky"), clamps=(Box((0.1, 0.5, 0.1), (0.5, 0.6, 0.6)),)),
    ]
    return scenes, [cloud(24, 0.1, 0.4, (0.0, -2.0, 1.0), 0), cloud(32, 0.05, 0.6, (0.3, -1.0, 0.0), 1)]


def same(a, b) -> bool:
    """Equal to the bit; on a GPU, where sums of floats come in any order, to rounding."""
    if a.device.type == "cpu":
        return torch.equal(a, b)
    rounding = 1e-9 if a.dtype == torch.float64 else 1e-4
    return torch.allclose(a, b, rtol=rounding, atol=rounding)
