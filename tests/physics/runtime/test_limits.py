"""Simulations that need too much are refused from their shapes alone: no test here allocates what it asks for."""

import pytest
import torch

from neuido.commands.main import main
from neuido.data.undeclared import Case, make_undeclared
from neuido.errors import UserError
from neuido.physics.fem.finite_elements import FiniteElements
from neuido.physics.laws.classical import material
from neuido.physics.mpm.simulator import Simulator
from neuido.physics.runtime import limits
from neuido.types import Body, Scene

ELASTIC = {"law": "fixed_corotated", "young": 1e4, "poisson": 0.3}


def body(side: int = 5) -> Body:
    axis = 0.4 + 0.02 * torch.arange(side)
    x = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).reshape(-1, 3)
    return Body(x, torch.zeros_like(x), torch.full((len(x),), 0.02**3))


def scene(cells: int = 16) -> Scene:
    return Scene(cells=cells, dt=1e-4)


@pytest.fixture
def law():
    return material(ELASTIC, {"law": "identity"})


@pytest.fixture
def little(monkeypatch):
    """A machine with 2 GB free, whatever this one has."""
    monkeypatch.setattr(limits, "free_memory", lambda device: 2 * 10**9)


def test_grid():
    with pytest.raises(
        UserError,
        match=r"1 scene, 125 particles and 1000\d+ x .* grid nodes a scene needs about .* PB of memory, .* lower `cells` .*`grid='window'`",
    ) as error:
        Simulator(scene(10**6), body(), device="cpu", grid="domain")
    assert limits.MEMORY in str(error.value)


def test_frames(little, law):
    simulator = Simulator(scene(), body(), device="cpu")
    words = r"125 particles, 1000000 steps and 1000001 frames needs about 24 GB of memory, cpu has 2 GB free: raise `every`"
    with pytest.raises(UserError, match=words):
        simulator.rollout(10**6, *law, effects=None)
    simulator.rollout(4, *law, every=2)


def test_gradients(little, law):
    simulator = Simulator(scene(), body(), device="cpu")
    start = simulator.state._replace(v=simulator.state.v.clone().requires_grad_())
    with pytest.raises(UserError, match=r"2 frames with gradients .* give `segment`"):
        simulator.rollout(10**6, *law, state=start, every=10**6)


def test_tape_is_used_again(monkeypatch, law):
    simulator = Simulator(scene(), body(), device="cpu")
    monkeypatch.setattr(limits, "UNCHECKED", 0)
    first = simulator.rollout(4, *law).x
    held = simulator.cache.held_bytes()
    assert held >= 5 * 125 * 24 * 4
    monkeypatch.setattr("neuido.physics.mpm.differentiable.UNCHECKED", 0)
    monkeypatch.setattr(limits, "free_memory", lambda device: 2 * 5 * 125 * 24 * 4 - held)  # enough only with what is held
    assert torch.equal(simulator.rollout(4, *law).x, first)


def test_steps(monkeypatch, law):
    for simulator in (Simulator(scene(), body(), device="cpu"), FiniteElements(scene(), body(), device="cpu")):
        with pytest.raises(UserError, match=r"steps is 1000000000000, more than the limit of 10000000: .* NEUIDO_MAX_STEPS"):
            simulator.rollout(10**12, *law, every=10**12)
        monkeypatch.setenv("NEUIDO_MAX_STEPS", "3")
        with pytest.raises(UserError, match="the limit of 3"):
            simulator.rollout(4, *law)
        monkeypatch.delenv("NEUIDO_MAX_STEPS")


def test_finite_elements(little, law):
    solver = FiniteElements(scene(), body(), device="cpu")
    with pytest.raises(UserError, match="125 particles and 1000001 frames needs about 12 GB of memory, cpu has 2 GB free"):
        solver.rollout(10**6, *law)
    with pytest.raises(UserError, match=r"a mesh of 1e\+12 elements needs about 1.5 PB .* lower `elements`"):
        FiniteElements(scene(), body(), device="cpu", elements=10**12)


def test_a_given_limit_stands(monkeypatch, law):
    simulator = Simulator(scene(), body(), device="cpu")
    monkeypatch.setenv(limits.MEMORY, "1000")
    with pytest.raises(UserError, match=f"more than the limit of 1 kB: .* set {limits.MEMORY}"):
        simulator.rollout(4, *law)
    monkeypatch.setenv(limits.MEMORY, "1" + "0" * 17)
    monkeypatch.setattr(limits, "free_memory", lambda device: 0)
    simulator.rollout(4, *law)
    monkeypatch.setenv(limits.MEMORY, "all")
    with pytest.raises(UserError, match="must be a positive whole number, got 'all'"):
        simulator.rollout(4, *law)


def test_free_memory():
    assert limits.free_memory("cpu") is None or limits.free_memory("cpu") > 1 << 20


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["simulate", "nclaw-cube", "--steps", "1000000000000"], "steps is 1000000000000, more than the limit"),
        (["trajectories", "--setup.particles_per_side", "100000"], "NEUIDO_MAX_PARTICLES"),
        (["trajectories", "--setup.steps", "1000000000000"], "NEUIDO_MAX_STEPS"),
        (["trajectories", "--instances", "1000000000000"], "NEUIDO_MAX_TRAJECTORIES"),
        (
            ["trajectories", "--setup.steps", "1000000", "--setup.record_every", "1000000"],
            "lower batch, particles_per_side or record_every",
        ),
        (["undeclared", "--seed", "0", "--particles", "1000000000000"], "NEUIDO_MAX_PARTICLES"),
        (["undeclared", "--seed", "0", "--seconds", "1e12"], "NEUIDO_MAX_STEPS"),
    ],
)
def test_commands(words, line, tmp_path, capsys, little):
    out = tmp_path / "out"
    with pytest.raises(SystemExit) as end:
        main([*words, "--out", str(out), "--device", "cpu"])
    told = capsys.readouterr().err.strip().splitlines()
    assert end.value.code == 2
    assert line in told[-1]
    assert not list(tmp_path.iterdir())


def test_seconds_that_are_not_finite(tmp_path):
    with pytest.raises(UserError, match="seconds = nan 0 or at least"):
        make_undeclared(0, str(tmp_path / "out"), case=Case(seconds=float("nan")), progress=False)
