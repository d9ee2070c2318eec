"""Measure speed and memory of the differentiable rollout, and compare them with the goals of the project.

    python benchmarks/rollout.py [--device cuda] [--repeat 20] [--data FOLDER] [--out rollout.csv]

Real bodies are read from the data folder (option --data or NEUIDO_DATA). Without it, they are replaced by balls of the same number of
particles, which the table states. The weights of the neural law are random, as their values do not affect the cost.

Each case is compared with a lower bound from rates measured in the same run (`floor`). The neural BouncyBall cases are also compared with a
plain re-implementation of the published loops (`plain.py`), measured on fewer substeps and scaled.
"""

import argparse
import csv
import gc
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import plain
import torch

from neuido.data.bodies.scene_files import load_scene
from neuido.data.bodies.shapes import ball
from neuido.physics.laws.classical import FixedCorotated, NeoHookean
from neuido.physics.laws.neural.invariants import InvariantElastic, InvariantPlastic
from neuido.physics.laws.neural.networks import ObjectiveElastic, ObjectivePlastic
from neuido.physics.mpm.simulator import Simulator
from neuido.types import Body, Scene, Walls

SIX = {"bouncy-ball": 25744, "clay-cat": 23554, "honey-bottle": 20777, "jelly-duck": 23419, "rubber-pawn": 15907, "sand-fish": 24894}
NEUMA = {"forward": 2.1, "both": 4.2, "bytes": 45e9}
"""The original loop of NeuMA on one H200: BouncyBall, 400 substeps (measured 2026-11-20) [s], [s], [B]."""

STATE = 24 * 4
"""Size of x, v, C and F of a particle in float32 [B]."""

KEPT = 2 * 9 * 4
"""Size of stress and trial deformation gradient of a particle, if the tape stores them [B]."""

PLAIN_REPEAT = 5
"""Maximum number of repetitions of the plain rollout, whose times spread little."""


@dataclass
class Case:
    """One row of the table; `unit` tells whether `goal` is in seconds, particle-substeps per second, or a ratio."""

    name: str
    make: Callable[[torch.device, Path | None], tuple[Simulator, tuple, int]]
    gradient: bool
    goal: float | None = None
    unit: str = "s"
    peer: float | None = None
    devices: tuple[str, ...] = ("cuda",)
    plain: int = 0
    """Number of substeps of the plain rollout to compare with; 0: no comparison."""


@dataclass
class Rates:
    """Measured peak rates of the device: copies (bytes read and written per second) and matrix products (FLOPs per second)."""

    copy: float
    fp32: float
    tf32x3: float = 0.0
    """A third of the TF32 rate on CUDA: like the fused networks, three TF32 products give one of fp32 accuracy."""


def best(run: Callable[[], object], device: torch.device, repeat: int = 10) -> float:
    """Return the minimum time of a call after a warm-up call [s]."""
    return min(timed(run, device, repeat))


def timed(run: Callable[[], object], device: torch.device, repeat: int) -> list[float]:
    """Return the times of `repeat` calls [s], after a warm-up call that compiles, captures and allocates."""
    cuda = device.type == "cuda"
    times = []
    for _ in range(repeat + 1):
        if cuda:
            torch.cuda.synchronize(device)
        start = time.perf_counter()
        run()
        if cuda:
            torch.cuda.synchronize(device)
        times.append(time.perf_counter() - start)
    return times[1:]


def measure_rates(device: torch.device) -> Rates:
    """Measure the rates of a copy that exceeds all caches, and of square matrix products."""
    cuda = device.type == "cuda"
    source = torch.ones((1 << 28) if cuda else (1 << 25), device=device)  # 1 GiB, 128 MiB
    target = torch.empty_like(source)
    copy = 2 * 4 * source.numel() / best(lambda: target.copy_(source), device)
    n = 8192 if cuda else 1024
    a, b, out = (torch.randn(n, n, device=device) for _ in range(3))
    rates = []
    before = torch.backends.cuda.matmul.allow_tf32
    for tf32 in (False, True) if cuda else (False,):
        torch.backends.cuda.matmul.allow_tf32 = tf32
        rates.append(2 * n**3 / best(lambda: torch.mm(a, b, out=out), device))
    torch.backends.cuda.matmul.allow_tf32 = before
    return Rates(copy, rates[0], rates[1] / 3 if cuda else 0.0)


def network_flops(weights: tuple, gradient: bool) -> int:
    """Return the FLOPs of the three layers for one particle and substep (a multiply-add counts as two); `weights` as in `tensors()`.

    A backward pass recomputes the layers, as reading stored activations would take longer. It needs the same FLOPs again for the gradient
    of the input, and those of the last layer for the gradient of its weights.
    """
    first, second, last = (2 * W.shape[-2] * W.shape[-1] for W in weights if W.ndim == 3)
    layers = first + second + last
    return 3 * layers + last if gradient else layers


def floor(particles: int, flops: int, gradient: bool, kept: int, rates: Rates) -> tuple[float, str]:
    """Return a lower bound of the time of a substep [s], and the limiting resource: `bytes` or `FLOPs`.

    The bytes comprise the state of each particle, read and written once in a substep. The backward pass reads the state, and reads and
    writes its adjoint; it also writes and reads what the tape stores in addition (`kept` bytes per substep). The FLOPs are those of the two
    networks at the higher of the measured rates. The work of the transfers and the memory traffic of the grid are not included. A body that
    fits into a cache may be faster than the bound of the bytes.
    """
    moved = particles * STATE * (5 if gradient else 2) + (2 * kept if gradient else 0)
    times = {"bytes": moved / rates.copy, "FLOPs": particles * flops / max(rates.fp32, rates.tf32x3)}
    binding = max(times, key=times.__getitem__)
    return times[binding], binding


def bodies(names: list[str], data: Path | None) -> tuple[list[Scene], list[Body]]:
    """Return the scenes and their bodies; without the data folder, the bodies are balls of the same number of particles."""
    if data is not None:
        setups = [load_scene(name, data) for name in names]
        return [s.scene for s in setups], [s.body for s in setups]
    made = []
    for name in names:
        whole = ball(centre=(0.5, 0.4, 0.5), radius=0.25, spacing=0.25 * (4.19 / SIX[name]) ** (1 / 3) * 0.98, velocity=(0.0, -1.94, 0.0))
        made.append(Body(*(t[: SIX[name]] for t in whole[:3])))
    return [Scene(dt=1e-3, walls=Walls("separate", float("inf")))] * len(names), made


def neural(count: int, device: torch.device) -> tuple:
    """Return effective networks of `count` materials, with random weights around Hencky elasticity and a yield strain of 5 %.

    Only the last layers are leaves, as in Stage II, whose gradients reach z through the last layers while the trunks are frozen.
    """
    g = torch.Generator().manual_seed(0)

    def draw(*shape: int, scale: float) -> torch.Tensor:
        return (scale * torch.randn(*shape, generator=g)).to(device)

    def network(kind: type, bias: list[float]):
        hidden = 64
        shared = [draw(1, hidden, 9, scale=0.5), draw(1, hidden, scale=0.5), draw(1, hidden, hidden, scale=0.1), draw(1, hidden, scale=0.1)]
        last = draw(count, len(bias), hidden, scale=2e-3).requires_grad_()
        offset = torch.tensor(bias).expand(count, -1).clone().to(device).requires_grad_()
        return kind(*shared, last, offset), [last, offset]

    elastic, leaves = network(ObjectiveElastic, [0.5, 1.0, 0.0, 0.0])
    plastic, more = network(ObjectivePlastic, [5.0, 0.0, 100.0])
    return elastic, plastic, leaves + more


def invariant(count: int, device: torch.device) -> tuple:
    """Return networks of the shapes of NCLaw with small random weights, all of which are leaves, as for LoRA on every layer."""
    g = torch.Generator().manual_seed(0)
    shapes = ((64, 13, 0.3), (64, 64, 0.1), (9, 64, 1.0), (64, 13, 0.3), (64, 64, 0.1), (9, 64, 0.1))
    leaves = [(scale * torch.randn(1, m, n, generator=g)).to(device).requires_grad_() for m, n, scale in shapes]
    return InvariantElastic(*leaves[:3]), InvariantPlastic(*leaves[3:]), leaves


def scene_case(names: list[str], steps: int, laws: Callable = neural) -> Callable:
    def make(device: torch.device, data: Path | None):
        sim = Simulator(*bodies(names, data), device=device)
        return sim, laws(len(names), device), steps

    return make


def block_case(per_side: int, cells: int, steps: int, law: Callable) -> Callable:
    def make(device: torch.device, data: Path | None):
        side = torch.linspace(0.2, 0.8, per_side, dtype=torch.float64)
        x = torch.cartesian_prod(side, side - 0.15, side)
        v = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64).expand_as(x)
        body = Body(x, v, torch.full((len(x),), 0.6**3 / len(x), dtype=torch.float64))
        stiffness = torch.tensor([1e5], device=device, requires_grad=True)
        sim = Simulator(Scene(cells=cells, dt=2e-4), body, device=device)
        return sim, (law(stiffness, 0.3), None, [stiffness]), steps

    return make


CASES = [
    Case("bouncy-ball, neural law, forward", scene_case(["bouncy-ball"], 400), False, 16e-3, "s", NEUMA["forward"], plain=100),
    Case("bouncy-ball, neural law, forward + backward", scene_case(["bouncy-ball"], 400), True, 50e-3, "s", NEUMA["both"], plain=100),
    Case("six scenes at once, neural law, forward", scene_case(list(SIX), 400), False),
    Case("six scenes at once, neural law, forward + backward", scene_case(list(SIX), 400), True, 3.5, "x one scene"),
    Case("NCLaw's networks, bouncy-ball, forward", scene_case(["bouncy-ball"], 400, invariant), False, 0.1, "s", NEUMA["forward"]),
    Case("NCLaw's networks, bouncy-ball, forward + backward", scene_case(["bouncy-ball"], 400, invariant), True, 0.3, "s", NEUMA["both"]),
    Case("NCLaw's networks, bouncy-ball, forward + backward", scene_case(["bouncy-ball"], 10, invariant), True, devices=("cpu",)),
    Case("1M particles, 70^3, fixed corotated, forward", block_case(100, 70, 100, FixedCorotated), False, 2e9, "p-s/s"),
    Case("bouncy-ball, neural law, forward", scene_case(["bouncy-ball"], 10), False, devices=("cpu",), plain=3),
    Case("bouncy-ball, neural law, forward + backward", scene_case(["bouncy-ball"], 10), True, devices=("cpu",), plain=3),
    Case("10k particles, 32^3, neo-Hookean (no SVD), forward", block_case(22, 32, 50, NeoHookean), False, 6e6, "p-s/s", devices=("cpu",)),
    Case(
        "10k particles, 32^3, neo-Hookean, forward + backward", block_case(22, 32, 50, NeoHookean), True, 1.8e6, "p-s/s", devices=("cpu",)
    ),
    Case("10k particles, 32^3, fixed corotated, forward", block_case(22, 32, 50, FixedCorotated), False, devices=("cpu",)),
    Case("10k particles, 32^3, fixed corotated, forward + backward", block_case(22, 32, 50, FixedCorotated), True, devices=("cpu",)),
]


def measure(case: Case, device: torch.device, data: Path | None, repeat: int, rates: Rates) -> dict:
    """Return the row of a case: median time, particle-substeps per second, memory, lower bound, and the plain rollout if measured."""
    gc.collect()  # a simulator and its stored rollouts refer to each other
    if device.type == "cuda":
        torch.cuda.empty_cache()
    sim, (elastic, plastic, leaves), steps = case.make(device, data)
    weight = torch.randn(len(sim.mass), 3, device=device)
    cuda = device.type == "cuda"

    def differentiated(positions: Callable[[], torch.Tensor]) -> Callable[[], None]:
        def run() -> None:
            with torch.set_grad_enabled(case.gradient):
                x = positions()
                if case.gradient:
                    torch.autograd.grad((x[-1] * weight).sum(), leaves, retain_graph=True)

        return run

    def figures(run: Callable[[], None], repeat: int) -> tuple[list[float], int, int]:
        """Return the times, the peak memory, and the memory held between calls [B]."""
        run()
        if cuda:
            torch.cuda.reset_peak_memory_stats(device)
        held = torch.cuda.memory_allocated(device) if cuda else 0
        times = timed(run, device, repeat)
        return times, torch.cuda.max_memory_allocated(device) if cuda else 0, held

    ours = differentiated(lambda: sim.rollout(steps, elastic, plastic, every=5, check=False).x)
    times, peak, held = figures(ours, repeat)
    seconds = statistics.median(times)
    # the backward pass needs x, v, C and F of each particle after every substep
    saved = STATE * len(sim.mass) * (steps + 1) if case.gradient else 0
    row = {"case": case.name, "particles": len(sim.mass), "substeps": steps, "seconds": seconds, "spread": max(times) - min(times),
           "microseconds_per_substep": 1e6 * seconds / steps, "rate": len(sim.mass) * steps / seconds,
           "peak_bytes": peak, "trajectory_bytes": saved, "held_bytes": held}  # fmt: skip
    flops = sum(network_flops(law.tensors(), case.gradient) for law in (elastic, plastic) if hasattr(law, "weights"))
    kept = (len(sim.mass) * (KEPT if plastic else KEPT // 2) + 16 * sim.setup.room.count) if sim.setup.keep_grid else 0
    least, binding = floor(len(sim.mass), flops, case.gradient, kept, rates)
    row |= {"floor_microseconds": 1e6 * least, "floor_of": binding, "over_floor": seconds / steps / least}
    row |= {"plain_substeps": case.plain, "plain_microseconds": "", "plain_over_ours": "", "plain_peak_bytes": ""}
    if case.plain:
        peer, peak, _ = figures(differentiated(lambda: plain.rollout(sim, case.plain, elastic, plastic)), min(repeat, PLAIN_REPEAT))
        each = statistics.median(peer) / case.plain
        row |= {"plain_microseconds": 1e6 * each, "plain_over_ours": each * steps / seconds, "plain_peak_bytes": peak}
    return row


def verdict(case: Case, row: dict, one_scene: float | None) -> tuple[str, str]:
    """Return the goal as text, and the ratio to the goal as text (above 1: better than the goal)."""
    if case.goal is None:
        return "", ""
    if case.unit == "s":
        return f"{1e3 * case.goal:.0f} ms", f"{case.goal / row['seconds']:.2f}"
    if case.unit == "p-s/s":
        return f"{case.goal:.1e} p-s/s", f"{row['rate'] / case.goal:.2f}"
    if one_scene is None:
        return f"<= {case.goal}x one scene", ""
    return f"<= {case.goal}x one scene", f"{case.goal * one_scene / row['seconds']:.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--repeat", type=int, default=20)
    parser.add_argument("--data", type=Path, default=os.environ.get("NEUIDO_DATA"))
    parser.add_argument("--out", type=Path, help="also write the rows to this CSV file")
    options = parser.parse_args()
    device = torch.device(options.device)
    data = Path(options.data) if options.data else None
    if device.type == "cpu":
        torch.set_num_threads(1)
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else f"{platform.processor() or platform.machine()}, one thread"
    rates = measure_rates(device)
    chosen = [case for case in CASES if device.type in case.devices]
    short = max(case.plain for case in chosen)
    print(f"{name}, torch {torch.__version__}, median of {options.repeat}, bodies: {'real' if data else 'balls (no data folder)'}")
    print(f"measured: copy {rates.copy / 1e9:.0f} GB/s, fp32 {rates.fp32 / 1e12:.3g} TFLOP/s"
          + (f", TF32 in three products {rates.tf32x3 / 1e12:.3g} TFLOP/s" if rates.tf32x3 else ""))  # fmt: skip
    print(f"plain: a re-implementation of the published loops, no part of neuido; {short} substeps, median of "
          f"{min(options.repeat, PLAIN_REPEAT)}, scaled to one substep\n")  # fmt: skip
    head = ["case", "particles", "substeps", "ms", "us/substep", "p-substeps/s", "trajectory MB", "peak MB", "goal", "better by",
            "NeuMA / ours", "floor us/substep", "ours / floor", "plain us/substep", "plain / ours"]  # fmt: skip
    print("| " + " | ".join(head) + " |\n| " + " | ".join("---" for _ in head) + " |")
    rows, one_scene = [], None
    for case in chosen:
        row = measure(case, device, data, options.repeat, rates)
        if case.gradient and case.name.startswith("bouncy"):
            one_scene = row["seconds"]
        goal, ratio = verdict(case, row, one_scene)
        peer = f"{case.peer / row['seconds']:.0f}" if case.peer else ""
        cells = [case.name, f"{row['particles']:,}", str(row["substeps"]), f"{1e3 * row['seconds']:.1f}",
                 f"{row['microseconds_per_substep']:.0f}", f"{row['rate']:.2e}", f"{row['trajectory_bytes'] / 1e6:.0f}",
                 f"{row['peak_bytes'] / 1e6:.0f}", goal, ratio, peer,
                 f"{row['floor_microseconds']:.3g} ({row['floor_of']})", f"{row['over_floor']:.1f}",
                 *((f"{row['plain_microseconds']:.0f}", f"{row['plain_over_ours']:.1f}") if case.plain else ("", ""))]  # fmt: skip
        print("| " + " | ".join(cells) + " |")
        sys.stdout.flush()
        rows.append(row | {"goal": goal, "better_by": ratio, "peer_over_ours": peer})
    if options.out and rows:
        with options.out.open("w", newline="") as file:
            writer = csv.DictWriter(file, rows[0])
            writer.writeheader()
            writer.writerows(rows)


if __name__ == "__main__":
    main()
