"""Launches on the CPU keep their packed arguments: scalars, places and shapes may change, and threads may share a kernel."""

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
import warp as wp

from neuido.data.bodies.shapes import cube
from neuido.physics.effects.parameters import Effects
from neuido.physics.fem.finite_elements import FiniteElements
from neuido.physics.laws.classical import FixedCorotated, Sigma, VonMises
from neuido.physics.mpm.simulator import Simulator
from neuido.physics.runtime import device
from neuido.physics.runtime.launches import LaunchRecordings
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


@pytest.fixture(params=["launch", "launch_recorded"])
def launch(request):
    """Return the launch of the CPU, and that of a GPU, which runs on the CPU too."""
    return getattr(device, request.param)


def test_scalars_change_and_vectors_are_told_apart(launch):
    x, out = torch.arange(5.0), torch.empty(5)
    for factor, shift, twice, first in [(1.0, 0, False, 0), (2.5, 3, True, 0), (1.0, 0, False, 7), (0.5, -2, True, 7)]:
        launch(add, 5, [factor, shift, twice, wp.vec3i(first, 0, 0), x, out], CPU)
        assert torch.equal(out, (2 if twice else 1) * (factor * x + shift + first))


def test_another_tensor_in_the_same_place_is_another_array(launch):
    memory, out = torch.arange(12.0), torch.zeros(4)
    box = wp.vec3i(0, 0, 0)
    launch(add, 4, [1.0, 0, False, box, memory[:4], out], CPU)
    assert torch.equal(out, memory[:4])
    launch(add, 4, [1.0, 0, False, box, memory.view(4, 3)[:, 0], out], CPU)  # the same address, another stride
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

    device.forget_launches()
    with ThreadPoolExecutor(8) as pool:
        assert all(pool.map(work, range(16)))


def test_the_memory_of_launches_is_bounded(monkeypatch, launch):
    monkeypatch.setattr(device, "COMMAND_CAPACITY", 10)
    monkeypatch.setattr(device, "RECORDED_CAPACITY", 10)
    device.forget_launches()
    x, box, kept = torch.arange(3.0), wp.vec3i(0, 0, 0), []
    for n in range(40):
        kept.append(torch.empty(3))
        launch(add, 3, [1.0, n, False, box, x, kept[-1]], CPU)
    assert device.packed_launches() <= 12
    assert all(torch.equal(out, x + n) for n, out in enumerate(kept))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_planes_beyond_the_body_do_not_matter(monkeypatch, dtype):
    """A rollout without gradient leaves the planes that no particle touches as they are; with all of them it says the same, bit for bit."""
    body = cube(length=0.2, centre=(0.3, 0.2, 0.5), particles_per_side=6, velocity=(2.5, -2.0, 0.3))

    def frames():
        simulator = Simulator(Scene(cells=16, dt=5e-4), body, dtype=dtype, device="cpu")
        with torch.no_grad():
            return simulator.rollout(240, FixedCorotated(torch.tensor([2e4], dtype=dtype), 0.3), every=40)

    from neuido.physics.mpm import rollout

    few = frames()
    monkeypatch.setattr(rollout, "node_range", lambda plan, x: slice(None))
    for a, b in zip(few, frames(), strict=True):
        assert torch.equal(a, b)
    assert float(few.x[..., 0].max()) > 0.7  # it went half through the domain


@wp.kernel(module="neuido.tests.launches", enable_backward=False)
def stamp(out: wp.array(dtype=float), shift: float, step: int):
    out[wp.tid()] = out[wp.tid()] + float(step) + shift


def test_a_recorded_stretch_is_repeated_with_its_own_arguments():
    a, b = torch.zeros(3), torch.zeros(3)

    def stretch():
        device.launch(stamp, 3, [a, 0.5, 10], CPU)
        device.launch(stamp, 2, [b[:2], 100.0, 10], CPU)

    recordings = LaunchRecordings()
    recordings.run("a", stretch, 10)
    device.launch(stamp, 3, [a, -0.5, 0], CPU)  # the same memory with other scalars
    for step in (20, 30):
        recordings.run("a", lambda: pytest.fail("it ran again"), step)
    assert a.tolist() == [61.0] * 3
    assert b.tolist() == [360.0, 360.0, 0.0]


def test_what_is_more_than_launches_runs_again():
    a, out = torch.ones(3), torch.zeros(3)

    def stretch():
        device.launch(stamp, 3, [out, 0.0, 1], CPU)
        a.mul_(2.0)

    recordings = LaunchRecordings()
    for _ in range(3):
        recordings.run("a", stretch)
    assert recordings.recordings == {"a": None}
    assert out.tolist() == [3.0] * 3 and a.tolist() == [8.0] * 3


def test_threads_record_their_own_launches():
    def work(n: int) -> list[float]:
        out, recordings = torch.zeros(2), LaunchRecordings()
        for step in range(50):
            recordings.run(n, lambda: device.launch(stamp, 2, [out, float(n), step], CPU), step)  # noqa: B023 (run at once)
        return out.tolist()

    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(work, range(8))) == [[1225.0 + 50 * n] * 2 for n in range(8)]


@pytest.mark.parametrize("solver", [Simulator, FiniteElements])
@pytest.mark.parametrize("law", ["elastic", "plastic", "relaxing"])
def test_repeated_launches_give_the_motion_of_fresh_ones(solver, law, monkeypatch):
    body = cube(length=0.2, particles_per_side=5, centre=(0.5, 0.16, 0.5), velocity=(0.3, -2.0, 0.1))
    scene = Scene(cells=16, dt=4e-4)
    effects = Effects(maxwell_ratio=0.5, maxwell_time=0.02) if law == "relaxing" else None
    elastic, plastic = (Sigma(1e5, 0.3), VonMises(1e3, 1e5, 0.3)) if law == "plastic" else (FixedCorotated(1e5, 0.3), None)

    def roll():
        with torch.no_grad():
            return solver(scene, body).rollout(200, elastic, plastic, every=5, effects=effects)

    repeated = roll()
    monkeypatch.setattr(LaunchRecordings, "run", lambda self, key, stretch, step=0: stretch())
    for a, b in zip(repeated, roll()):
        assert torch.equal(a, b)
    assert float((repeated.x[-1] - repeated.x[0]).abs().max()) > 0.02
