"""Speed and memory of the differentiable rollout, case by case, beside the goals of the project.

    python benchmarks/rollout.py [--device cuda] [--repeat 20] [--data FOLDER] [--out rollout.csv]

Real bodies come from the data folder (option --data or NEUIDO_DATA); without it balls of as many particles take their
place, and the table says so. Weights of the neural law are random: their values do not change the work.
"""

import argparse
import csv
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch

from neuido.data.scenes import load_scene
from neuido.data.shapes import ball
from neuido.physics.laws import FixedCorotated, NeoHookean
from neuido.physics.mpm import Simulator
from neuido.physics.networks import ObjectiveElastic, ObjectivePlastic
from neuido.types import Body, Scene, Walls

SIX = {"bouncy-ball": 25744, "clay-cat": 23554, "honey-bottle": 20777, "jelly-duck": 23419, "rubber-pawn": 15907, "sand-fish": 24894}
NEUMA = {"forward": 2.1, "both": 4.2, "bytes": 45e9}
"""NeuMA's own loop on one H200, BouncyBall, 400 substeps (measured 2026-11-20) [s], [s], [B]."""


@dataclass
class Case:
    """One row of the table: `goal` in seconds, particle-substeps a second or a ratio, as `unit` says."""

    name: str
    make: Callable[[torch.device, Path | None], tuple[Simulator, tuple, int]]
    gradient: bool
    goal: float | None = None
    unit: str = "s"
    peer: float | None = None
    devices: tuple[str, ...] = ("cuda",)


def bodies(names: list[str], data: Path | None) -> tuple[list[Scene], list[Body]]:
    """The scenes and their bodies, or balls of as many particles where the data folder is missing."""
    if data is not None:
        setups = [load_scene(name, data) for name in names]
        return [s.scene for s in setups], [s.body for s in setups]
    made = []
    for name in names:
        whole = ball(centre=(0.5, 0.4, 0.5), radius=0.25, spacing=0.25 * (4.19 / SIX[name]) ** (1 / 3) * 0.98, velocity=(0.0, -1.94, 0.0))
        made.append(Body(*(t[: SIX[name]] for t in whole[:3])))
    return [Scene(dt=1e-3, walls=Walls("separate", float("inf")))] * len(names), made


def neural(count: int, device: torch.device) -> tuple:
    """Effective networks of `count` materials with random weights about Hencky elasticity and a yield strain of 5 %.

    The last layers are the leaves: they are what Stage II and a latent z reach (the trunks are frozen there).
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


def scene_case(names: list[str], steps: int) -> Callable:
    def make(device: torch.device, data: Path | None):
        sim = Simulator(*bodies(names, data), device=device)
        return sim, neural(len(names), device), steps

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
    Case("bouncy-ball, neural law, forward", scene_case(["bouncy-ball"], 400), False, 16e-3, "s", NEUMA["forward"]),
    Case("bouncy-ball, neural law, forward + backward", scene_case(["bouncy-ball"], 400), True, 50e-3, "s", NEUMA["both"]),
    Case("six scenes at once, neural law, forward", scene_case(list(SIX), 400), False),
    Case("six scenes at once, neural law, forward + backward", scene_case(list(SIX), 400), True, 3.5, "x one scene"),
    Case("1M particles, 70^3, fixed corotated, forward", block_case(100, 70, 100, FixedCorotated), False, 2e9, "p-s/s"),
    Case("bouncy-ball, neural law, forward", scene_case(["bouncy-ball"], 10), False, devices=("cpu",)),
    Case("bouncy-ball, neural law, forward + backward", scene_case(["bouncy-ball"], 10), True, devices=("cpu",)),
    Case("10k particles, 32^3, neo-Hookean (no SVD), forward", block_case(22, 32, 50, NeoHookean), False, 6e6, "p-s/s", devices=("cpu",)),
    Case(
        "10k particles, 32^3, neo-Hookean, forward + backward", block_case(22, 32, 50, NeoHookean), True, 1.8e6, "p-s/s", devices=("cpu",)
    ),
    Case("10k particles, 32^3, fixed corotated, forward", block_case(22, 32, 50, FixedCorotated), False, devices=("cpu",)),
    Case("10k particles, 32^3, fixed corotated, forward + backward", block_case(22, 32, 50, FixedCorotated), True, devices=("cpu",)),
]


def measure(case: Case, device: torch.device, data: Path | None, repeat: int) -> dict:
    """Median seconds, particle-substeps a second and bytes of one case."""
    sim, (elastic, plastic, leaves), steps = case.make(device, data)
    weight = torch.randn(len(sim.mass), 3, device=device)
    cuda = device.type == "cuda"

    def run() -> None:
        with torch.set_grad_enabled(case.gradient):
            frames = sim.rollout(steps, elastic, plastic, every=max(1, steps // 80), check=False)
            if case.gradient:
                torch.autograd.grad((frames.x[-1] * weight).sum(), leaves, retain_graph=True)

    run()
    if cuda:
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
    base = torch.cuda.memory_allocated() if cuda else 0
    times = []
    for _ in range(repeat):
        start = time.perf_counter()
        run()
        if cuda:
            torch.cuda.synchronize()
        times.append(time.perf_counter() - start)
    seconds = statistics.median(times)
    # what a backward pass needs of every substep: x, v, C, F of each particle
    saved = 24 * 4 * len(sim.mass) * (steps + 1) if case.gradient else 0
    peak = torch.cuda.max_memory_allocated() if cuda else 0
    return {"case": case.name, "particles": len(sim.mass), "substeps": steps, "seconds": seconds, "spread": max(times) - min(times),
            "microseconds_per_substep": 1e6 * seconds / steps, "rate": len(sim.mass) * steps / seconds,
            "peak_bytes": peak, "trajectory_bytes": saved, "held_bytes": base}  # fmt: skip


def verdict(case: Case, row: dict, one_scene: float | None) -> tuple[str, str]:
    """The goal as text and the figure that it is compared with, as a ratio (above 1: better than the goal)."""
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
    print(f"{name}, torch {torch.__version__}, median of {options.repeat}, bodies: {'real' if data else 'balls (no data folder)'}\n")
    print("| case | particles | substeps | ms | us/substep | p-substeps/s | trajectory MB | peak MB | goal | better by | peer / ours |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    rows, one_scene = [], None
    for case in CASES:
        if device.type not in case.devices:
            continue
        row = measure(case, device, data, options.repeat)
        if case.gradient and case.name.startswith("bouncy"):
            one_scene = row["seconds"]
        goal, ratio = verdict(case, row, one_scene)
        peer = f"{case.peer / row['seconds']:.0f}" if case.peer else ""
        cells = [case.name, f"{row['particles']:,}", str(row["substeps"]), f"{1e3 * row['seconds']:.1f}",
                 f"{row['microseconds_per_substep']:.0f}", f"{row['rate']:.2e}", f"{row['trajectory_bytes'] / 1e6:.0f}",
                 f"{row['peak_bytes'] / 1e6:.0f}", goal, ratio, peer]  # fmt: skip
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
