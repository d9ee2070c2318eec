"""Launches on the CPU keep their packed arguments: scalars, places and shapes may change, and threads may share a kernel."""

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
import warp as wp

from neuido.data.shapes import cube
from neuido.physics import device
from neuido.physics.laws import FixedCorotated
from neuido.physics.mpm import Simulator
from neuido.types import Scene

CPU = torch.device("cpu")
device.start_warp()


@wp.kernel(module="neuido.tests.launches", enable_backward=False)
def add(factor: float, shift: int, twice: bool, box: wp.vec3i, x: wp.array(dtype=float), out: wp.array(dtype=float)):
    i = wp.tid()
    y = factor * x[i] + float(shift) + float(box[0])
    if twice:
        y = 2.0 * y
    out[i] = y


def test_scalars_change_and_vectors_are_told_apart():
    x, out = torch.arange(5.0), torch.empty(5)
    for factor, shift, twice, first in [(1.0, 0, False, 0), (2.5, 3, True, 0), (1.0, 0, False, 7), (0.5, -2, True, 7)]:
        device.launch(add, 5, [factor, shift, twice, wp.vec3i(first, 0, 0), x, out], CPU)
        assert torch.equal(out, (2 if twice else 1) * (factor * x + shift + first))


def test_another_tensor_in_the_same_place_is_another_array():
    memory, out = torch.arange(12.0), torch.zeros(4)
    box = wp.vec3i(0, 0, 0)
    device.launch(add, 4, [1.0, 0, False, box, memory[:4], out], CPU)
    assert torch.equal(out, memory[:4])
    device.launch(add, 4, [1.0, 0, False, box, memory.view(4, 3)[:, 0], out], CPU)  # the same address, another stride
    assert torch.equal(out, memory[::3])


def test_nothing_is_launched_for_nothing():
    device.launch(add, 0, [1.0, 0, False, wp.vec3i(0, 0, 0), torch.empty(0), torch.empty(0)], CPU)


def test_threads_that_meet_a_new_kernel_agree():
    def work(n: int) -> bool:
        x, out = torch.full((1000,), float(n)), torch.empty(1000)
        for shift in range(200):
            device.launch(add, 1000, [2.0, shift, False, wp.vec3i(1, 0, 0), x, out], CPU)
            if not bool((out == 2.0 * n + shift + 1).all()):
                return False
        return True

    device._commands.clear()
    with ThreadPoolExecutor(8) as pool:
        assert all(pool.map(work, range(16)))


def test_the_memory_of_launches_is_bounded(monkeypatch):
    monkeypatch.setattr(device, "MOST_COMMANDS", 10)
    x, box, kept = torch.arange(3.0), wp.vec3i(0, 0, 0), []
    for n in range(40):
        kept.append(torch.empty(3))
        device.launch(add, 3, [1.0, n, False, box, x, kept[-1]], CPU)
    assert len(device._commands) <= 12
    assert all(torch.equal(out, x + n) for n, out in enumerate(kept))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_planes_beyond_the_body_do_not_matter(monkeypatch, dtype):
    """A rollout without gradient leaves the planes that no particle touches as they are; with all of them it says the same, bit for bit."""
    body = cube(length=0.2, centre=(0.3, 0.2, 0.5), particles_per_side=6, velocity=(2.5, -2.0, 0.3))

    def frames():
        simulator = Simulator(Scene(cells=16, dt=5e-4), body, dtype=dtype)
        with torch.no_grad():
            return simulator.rollout(240, FixedCorotated(torch.tensor([2e4], dtype=dtype), 0.3), every=40)

    from neuido.physics.rollout import Plan

    few = frames()
    monkeypatch.setattr(Plan, "reach", lambda self, x: slice(None))
    for a, b in zip(few, frames(), strict=True):
        assert torch.equal(a, b)
    assert float(few.x[..., 0].max()) > 0.7  # it went half through the domain
