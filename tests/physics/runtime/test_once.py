"""What several threads ask for at once is made once, whole, and in a fresh process does not bring it down."""

import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from neuido.data.bodies.shapes import cube
from neuido.physics.laws.classical import NeoHookean
from neuido.physics.mpm.simulator import Simulator
from neuido.physics.runtime.once import BUILDING, cached
from neuido.physics.runtime.threads import one_thread_each, scene_pool
from neuido.types import Scene

BUILD = """
import faulthandler, sys, threading
faulthandler.dump_traceback_later(800, exit=True)  # some five times what the slowest process took on a busy machine
import torch
from neuido.data.bodies.shapes import cube
from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
from neuido.physics.laws.classical import NeoHookean, VonMises
from neuido.physics.mpm.simulator import Simulator
from neuido.types import Scene

body = cube(length=0.2, centre=(0.5, 0.13, 0.5), particles_per_side=3)
operator = IntrinsicDynamicsOperator.load()
learned = operator.laws(torch.stack([operator.latent("plasticine")] * 2))
start, errors, found = threading.Barrier(8), [], {}

def work(i):
    try:
        start.wait()
        dtype = torch.float32 if i % 2 else torch.float64
        laws = learned if i < 4 else (NeoHookean(1e4, 0.3), VonMises(300.0, 1e4, 0.3))
        scenes = 2 if i < 4 else 1
        with torch.no_grad():
            sim = Simulator([Scene(cells=12, dt=5e-4)] * scenes, [body] * scenes, dtype=dtype if i >= 4 else torch.float32, device="cpu")
            found.setdefault(i if i >= 4 else "learned", []).append(sim.rollout(4, *laws, every=4).x)
    except BaseException as error:
        errors.append(repr(error))

threads = [threading.Thread(target=work, args=(i,)) for i in range(8)]
for t in threads: t.start()
for t in threads: t.join()
assert not errors, errors
faulthandler.cancel_dump_traceback_later()
assert len(found["learned"]) == 4 and all(torch.equal(x, found["learned"][0]) for x in found["learned"])
print("whole")
"""


def processes(count: int) -> None:
    for _ in range(count):
        done = subprocess.run([sys.executable, "-c", BUILD], capture_output=True, text=True)
        assert done.returncode == 0 and done.stdout.strip() == "whole", (done.returncode, done.stderr[-6000:])


@pytest.mark.slow
def test_eight_threads_of_fresh_processes_build_the_kernels_at_once():
    processes(2)


@pytest.mark.slow
def test_fifty_fresh_processes_of_eight_threads():
    processes(50)


def forked(work):
    """Return the exit status of a fork that does some work, and ends after ten seconds whatever it waits for."""
    child = os.fork()
    if child == 0:
        signal.alarm(10)
        status = 1
        try:
            status = 0 if work() else 2
        finally:
            os._exit(status)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def test_a_fork_has_threads_of_its_own():
    pool = scene_pool()
    assert [pool.submit(abs, -i).result(10) for i in range(4)] == list(range(4))
    assert forked(lambda: [pool.submit(abs, -i).result() for i in range(4)] == list(range(4))) == 0
    assert pool.submit(abs, -5).result(10) == 5


def test_a_fork_waits_until_no_thread_builds():
    building, end = threading.Event(), threading.Event()

    def build():
        with BUILDING:
            building.set()
            end.wait(0.2)

    thread = threading.Thread(target=build)
    thread.start()
    building.wait()
    assert forked(lambda: BUILDING.acquire(timeout=5.0)) == 0
    thread.join()


def test_threads_get_the_one_result_of_a_slow_function():
    made = []

    @cached
    def slow(key):
        made.append(key)
        time.sleep(0.02)
        return object()

    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(slow, [1, 2] * 8))
    assert sorted(made) == [1, 2] and len(set(map(id, found))) == 2


def test_the_least_recently_used_result_is_dropped():
    made = []
    keep = cached(lambda key: made.append(key) or key, limit=2)
    for key in (1, 2, 1, 3, 1, 2):
        keep(key)
    assert made == [1, 2, 3, 2]
    keep.cache_clear()
    keep(1)
    assert made[-1] == 1 and len(made) == 5


def test_a_function_that_fails_is_asked_again():
    calls = []

    @cached
    def fails():
        calls.append(1)
        if len(calls) == 1:
            raise OSError("once")
        return "made"

    with pytest.raises(OSError):
        fails()
    assert fails() == "made"


def test_threads_that_share_a_simulator_get_their_own_motion():
    body = cube(length=0.2, centre=(0.5, 0.13, 0.5), particles_per_side=4)
    simulator = Simulator(Scene(cells=12, dt=5e-4), body, device="cpu")
    stiffness = [1e4 * (1 + i) for i in range(4)]

    def motion(young, simulator=simulator):
        law = NeoHookean(torch.tensor([young], requires_grad=True), 0.3)
        x = simulator.rollout(40, law, every=40).x
        x[-1].square().sum().backward()
        return x.detach()

    alone = [motion(young, Simulator(Scene(cells=12, dt=5e-4), body, device="cpu")) for young in stiffness]
    with ThreadPoolExecutor(8) as pool:
        together = list(pool.map(motion, stiffness * 2))
    assert all(torch.equal(a, b) for a, b in zip(alone * 2, together, strict=True))


def test_rollouts_at_once_leave_the_threads_of_torch_as_they_were():
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        entered, leave = threading.Barrier(2), threading.Event()

        def other():
            with one_thread_each():
                entered.wait()
                leave.wait()

        thread = threading.Thread(target=other)
        thread.start()
        entered.wait()
        with one_thread_each():
            leave.set()
            thread.join()
            assert torch.get_num_threads() == 1
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
