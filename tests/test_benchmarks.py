"""The benchmarks measure what they say: the plain rollout is the same physics, floors are arithmetic, tables get written."""

import sys
from pathlib import Path

import matplotlib.image
import pytest
import torch

from neuido.data.bodies.shapes import ball
from neuido.errors import UserError
from neuido.physics.mpm.simulator import Simulator
from neuido.types import Body, Scene, Walls

FOLDER = Path(__file__).parents[1] / "benchmarks"
if not FOLDER.is_dir():
    pytest.skip("the benchmarks do not come with the installed package", allow_module_level=True)
sys.path.insert(0, str(FOLDER))

import cases  # noqa: E402
import plain  # noqa: E402
import rollout  # noqa: E402
import room  # noqa: E402
import scaling  # noqa: E402
import waits  # noqa: E402
from peers import Problem  # noqa: E402
from peers.engine import Engine  # noqa: E402
from peers.loops import MasivLike, NeumaLike  # noqa: E402


def simulator(friction: float, dt: float = 1e-3) -> Simulator:
    """A ball that meets the floor at an angle."""
    x, v, volume, *_ = ball(centre=(0.5, 0.145, 0.5), radius=0.14, spacing=0.025, velocity=(1.0, -3.0, 0.4))
    return Simulator(Scene(cells=24, dt=dt, walls=Walls("separate", friction)), Body(x, v, volume), device="cpu")


@pytest.mark.parametrize("friction", [0.0, float("inf")])
def test_plain_rollout_is_the_same_physics(friction):
    sim = simulator(friction)
    elastic, plastic, leaves = rollout.neural(1, sim.device)
    weight = torch.randn(len(sim.mass), 3, generator=torch.Generator().manual_seed(1))
    results = []
    for x in (sim.rollout(20, elastic, plastic, check=False).x, plain.rollout(sim, 20, elastic, plastic)):
        results.append((x.detach(), torch.autograd.grad((x[-1] * weight).sum(), leaves)))
    (x, gradients), (x_plain, gradients_plain) = results
    assert (x[-1] - x[0]).abs().max() > 0.01
    torch.testing.assert_close(x_plain, x, rtol=0, atol=1e-5)
    for ours, other in zip(gradients, gradients_plain):
        assert ours.norm() > 0
        assert (ours - other).norm() <= 1e-3 * ours.norm()


def test_each_shared_case_names_its_test():
    assert [case.number for case in cases.CASES] == list(range(1, 32))
    for case in cases.CASES:
        file, _, name = case.test.partition("::")
        assert f"def {name}(" in (FOLDER.parent / file).read_text(), case.test


def test_plain_rollout_refuses_what_it_does_not_do():
    with pytest.raises(UserError, match="plain rollout"):
        plain.Transfers(simulator(0.3))


@pytest.mark.parametrize("law", ["neo-hookean", "networks"])
def test_loops_of_others_solve_the_common_problem(law):
    problem = Problem(12, 20, law)
    own, *others = (kind(problem, "cpu") for kind in (Engine, NeumaLike, MasivLike))
    start = torch.from_numpy(problem.arrays()[0])
    for peer in (own, *others):
        peer.forward()
        peer.gradient()
    moved = torch.from_numpy(own.positions()) - start
    assert moved.abs().max() > 1e-3
    for peer in others:
        assert (torch.from_numpy(peer.positions() - own.positions())).norm() < 1e-4 * moved.norm()
        assert (torch.from_numpy(peer.slopes() - own.slopes())).norm() < 1e-3 * torch.from_numpy(own.slopes()).norm()


def test_floor():
    """10,000 particles: 192 bytes forward, 480 and twice the tape with the backward pass; FLOPs at the better rate."""
    rates = rollout.Rates(copy=1e12, fp32=1e13, tf32x3=4e13)
    seconds, binding = rollout.floor(10_000, 0, False, kept=10**6, rates=rates)
    assert binding == "bytes" and seconds == pytest.approx(1.92e-6)
    seconds, binding = rollout.floor(10_000, 0, True, kept=10**6, rates=rates)
    assert binding == "bytes" and seconds == pytest.approx(6.8e-6)
    seconds, binding = rollout.floor(10_000, 40_000, False, kept=0, rates=rates)
    assert binding == "FLOPs" and seconds == pytest.approx(1e-5)


def test_network_flops():
    elastic, plastic, _ = rollout.neural(2, torch.device("cpu"))
    layers = 2 * (9 * 64 + 64 * 64 + 64 * 4)
    assert rollout.network_flops(elastic.tensors(), False) == layers
    assert rollout.network_flops(elastic.tensors(), True) == 3 * layers + 2 * 64 * 4
    assert rollout.network_flops(plastic.tensors(), False) == layers - 2 * 64


def test_rates_are_measured():
    rates = rollout.measure_rates(torch.device("cpu"))
    assert 1e8 < rates.copy < 1e13 and 1e8 < rates.fp32 < 1e15
    assert rates.tf32x3 == 0


def test_ledger_counts_what_is_alive():
    before = torch.ones(1000)

    def run():
        a = before.view(10, 100) + 1  # 4000 bytes beside those of `before`; the view costs nothing
        b = torch.cat([a, a])  # 8000 more
        del a
        return b.add_(1) + 1  # 8000 more, the first 4000 gone

    assert scaling.peak_bytes(lambda: run, before.device) == 4000 + 16000


def test_exponent():
    assert scaling.exponent([1, 2, 4], [3, 12, 48]) == pytest.approx(2.0)
    assert scaling.exponent([1, 2], [0.0, 1.0]) != scaling.exponent([1, 2], [0.0, 1.0])  # NaN


@pytest.mark.slow
def test_scaling_writes_its_table_and_its_picture(tmp_path, capsys):
    scaling.main(["--device", "cpu", "--quick", "--out", str(tmp_path / "out")])
    text = (tmp_path / "out" / "scaling.md").read_text()
    assert text.strip() in capsys.readouterr().out
    rows = [line for line in text.splitlines() if line.startswith("| ")][2:]
    assert len(rows) == 4 * 3
    for row in rows:
        cells = [cell.strip() for cell in row.strip("|").split("|")]
        if cells[1] != "exponent":
            assert all(float(cell) > 0 for cell in cells[2:])
    slope = float(next(row for row in rows if row.startswith("| particles | exponent")).split("|")[-2].split("(")[0])
    assert slope == pytest.approx(1.0, abs=0.3)  # memory is counted, not sampled; the grid's share does not grow
    picture = matplotlib.image.imread(tmp_path / "out" / "scaling.png")
    assert picture.std() > 0.05


@pytest.mark.slow
def test_memory_in_a_large_domain_follows_the_body(tmp_path):
    room.main(["--device", "cpu", "--particles", "20000", "--factors", "1", "1000000", "8000000", "--out", str(tmp_path)])
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in (tmp_path / "room.md").read_text().splitlines()[2:]]
    assert [int(row[1]) for row in rows] == [24, 2400, 4800]
    assert len({row[3] for row in rows[1:]}) == 1  # eight times the room, the same memory
    assert len({row[5] for row in rows[1:]}) == 1


@pytest.mark.slow
def test_waits_are_measured_with_their_parts(tmp_path, capsys):
    out = tmp_path / "waits.md"
    few = ["--scenes", "1", "--steps", "3", "--repeat", "2", "--only", "imports,first,law,few-shot,test,reconstruct,render"]
    waits.main(["--small", "--device", "cpu", *few, "--out", str(out)])
    text = out.read_text()
    assert text.strip() in capsys.readouterr().out and "failed" not in text
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line.startswith("| ")]
    seconds = {cells[0]: float(cells[1]) for cells in lines if cells[0] not in ("what", "part", "---")}
    assert all(value >= 0 for value in seconds.values())
    whole = next(value for name, value in seconds.items() if name.startswith("test, "))
    assert 0 < seconds["score images"] < seconds["prepare"] + seconds["score images"] < 10 * whole
    assert {"rollout", "backward", "deformation", "measure flow", "optimise"} <= seconds.keys()


def test_waits_refuse_unknown_rows(capsys):
    with pytest.raises(SystemExit):
        waits.main(["--only", "few-shot,nothing"])
    assert "nothing: known are" in capsys.readouterr().err
