"""Measure the kernels of a substep side by side, in one process: whole substeps, transfers by warp, and the slow twin.

    python benchmarks/substep.py [--device cuda] [--seconds 100] [--data FOLDER] [--out substep.md]

Each case is a rollout under each option `fusion` of the simulator. The table has the median time of up to 20 runs, the ratio to the twin
(`separate`), and the agreement with it: the norm of the difference of the motion and of the gradients over their own norms. A second
table has the time of each kernel. Cases that do not begin within `--seconds` are left out, and named.

The learned law is that of the published weights or, with `--law random`, that of `rollout.py`. Bodies are as there: real ones from the
data folder, else balls of their size, or of `--particles` for a quick look on a CPU:

    python benchmarks/substep.py --device cpu --particles 500 --substeps 10 --repeat 3
"""

import argparse
import gc
import os
import statistics
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from rollout import SIX, block_case, bodies, neural, timed

from neuido.data.bodies.shapes import ball
from neuido.data.files.writing import write_text
from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
from neuido.physics.laws.classical import FixedCorotated
from neuido.physics.mpm import passes
from neuido.physics.mpm.kernels.tile_source import ROLLED, UNROLLED
from neuido.physics.mpm.simulator import Simulator
from neuido.types import Body, Scene, Walls

CHOICES = ("separate", "transfers", "transfers-rolled", "fused", "fused-rolled", "fused-half")
"""Values of `fusion`, the twin first.

`rolled`: with loops over the nodes that are not written out, less code to fetch; `half`: 16 particles a warp where networks run inside.
"""


@dataclass
class Case:
    """One rollout: `make` returns scenes, bodies, substeps, and a function that returns laws and the leaves of the gradient."""

    name: str
    make: Callable[[], tuple]
    gradient: bool
    repeat: int = 20


def learned(count: int, device: torch.device, law: str) -> Callable[[], tuple]:
    """Return a function that returns the laws of `count` scenes, and their last layers as leaves of the gradient."""
    if law == "random":
        return lambda: neural(count, device)
    operator = IntrinsicDynamicsOperator.load().to(device)
    z = torch.stack([operator.latent(("jelly", "plasticine", "sand")[s % 3]) for s in range(count)])

    def laws() -> tuple:
        with torch.no_grad():
            pair = operator.laws(z)
        leaves = []
        for one in pair:
            *hidden, W3, b3 = (t.detach().clone() for t in one.weights)
            one.weights = (*hidden, W3.requires_grad_(), b3.requires_grad_())
            leaves += [W3, b3]
        return *pair, leaves

    return laws


def scene_case(names: list[str], options: argparse.Namespace, device: torch.device) -> Callable[[], tuple]:
    def make() -> tuple:
        if options.particles:
            spacing = 0.2 * (4.19 / options.particles) ** (1 / 3) * 0.98
            x, v, volume, *_ = ball(centre=(0.5, 0.22, 0.5), radius=0.2, spacing=spacing, velocity=(0.0, -1.94, 0.0))
            count = options.particles
            scenes = [Scene(dt=1e-3, walls=Walls("separate", float("inf")))] * len(names)
            made = [Body(x[:count], v[:count], volume[:count])] * len(names)
        else:
            scenes, made = bodies(names, options.data)
        return scenes, made, options.substeps, learned(len(names), device, options.law)

    return make


def block(options: argparse.Namespace, device: torch.device) -> Callable[[], tuple]:
    """Return the case of a million particles of fixed corotated elasticity, or of `--particles`."""
    per_side = round(options.particles ** (1 / 3)) if options.particles else 100

    def make() -> tuple:
        sim, (law, _, leaves), steps = block_case(per_side, 16 if options.particles else 70, min(100, options.substeps), FixedCorotated)(
            device, None
        )
        body = sim.bodies[0].bodies[0]
        turned = torch.tensor([[1.02, 0.03, 0.0], [0.0, 0.98, 0.01], [0.02, 0.0, 0.99]], dtype=torch.float64)
        body = Body(body.x, body.v, body.volume, turned.expand(len(body.x), 3, 3))  # at rest gradients are rounding errors
        return list(sim.scenes), [body], steps, lambda: (law, None, leaves)

    return make


def difference(a: list[torch.Tensor], b: list[torch.Tensor]) -> float:
    """Return the largest norm of the difference of two lists of tensors, relative to the second."""
    return max(float((p - q).double().norm() / q.double().norm().clamp(min=1e-30)) for p, q in zip(a, b))


def kernel_times(run: Callable[[], object], steps: int) -> dict[str, float]:
    """Return the time of each kernel per substep [us] of one run on a GPU."""
    from torch.profiler import ProfilerActivity, profile

    with profile(activities=[ProfilerActivity.CUDA]) as recorded:
        run()
        torch.cuda.synchronize()
    times: dict[str, float] = defaultdict(float)
    for event in recorded.key_averages():
        times[event.key.split("(")[0][:60]] += event.self_device_time_total / steps
    return dict(sorted(times.items(), key=lambda item: -item[1])[:9])


def prepared(case: Case, fusion: str, device: torch.device) -> tuple[Simulator, int, Callable[[], tuple[list, list]]]:
    """Return the simulator and the substeps of a case, and a function that returns its motion and its gradients."""
    scenes, made, steps, laws = case.make()
    passes.TURNS = ROLLED if fusion.endswith("rolled") else UNROLLED
    passes.PER_WARP = 16 if fusion.endswith("half") else 32
    sim = Simulator(scenes, made, device=device, fusion=fusion.split("-")[0])
    elastic, plastic, leaves = laws()
    weight = torch.randn(len(sim.mass), 3, generator=torch.Generator().manual_seed(1)).to(device)
    every = 5 if steps % 5 == 0 else 1

    def run() -> tuple[list, list]:
        with torch.set_grad_enabled(case.gradient):
            x = sim.rollout(steps, elastic, plastic, every=every, check=False).x
            grads = torch.autograd.grad((x[-1] * weight).sum(), leaves, retain_graph=True) if case.gradient else ()
        return [x.detach() - x[0].detach()], list(grads)

    return sim, steps, run


def measure(case: Case, options: argparse.Namespace, device: torch.device, until: float) -> tuple[list[list[str]], list[list[str]]]:
    """Return the rows of both tables for a case."""
    rows, kernels = [], []
    twin, base = None, 0.0
    for choice in options.fusion:
        gc.collect()
        if device.type == "cuda":
            torch.cuda.empty_cache()
        start = time.perf_counter()
        sim, steps, run = prepared(case, choice, device)
        try:
            result = tuple([t.clone() for t in part] for part in run())
        except Exception as error:  # the other kernels are measured all the same
            rows.append([case.name, choice, f"failed: {str(error)[:200]}", *[""] * 6])
            print("| " + " | ".join(rows[-1]) + " |", flush=True)
            continue
        ready = time.perf_counter() - start
        seconds = statistics.median(timed(run, device, min(options.repeat, case.repeat)))
        apart = ["", ""]
        if twin is None:
            twin, base = result, seconds
        else:
            apart = [f"{difference(a, b):.1e}" if a else "" for a, b in zip(result, twin)]
        figures = [
            f"{1e3 * seconds:.1f}",
            f"{1e6 * seconds / steps:.1f}",
            f"{len(sim.mass) * steps / seconds:.2e}",
            f"{base / seconds:.2f}",
        ]
        rows.append([case.name, choice, *figures, *apart, f"{ready:.0f}"])
        print("| " + " | ".join(rows[-1]) + " |", flush=True)
        if device.type == "cuda" and time.perf_counter() < until:
            listed = ", ".join(f"{name} {us:.1f}" for name, us in kernel_times(run, steps).items())
            kernels.append([case.name, choice, listed])
            print(f"  {choice}: {listed}", flush=True)
        del sim, run
    return rows, kernels


def table(head: list[str], rows: list[list[str]]) -> str:
    """Return a table in markdown."""
    return "\n".join("| " + " | ".join(row) + " |" for row in (head, ["---"] * len(head), *rows))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--particles", type=int, help="particles of each body, in place of the real number")
    parser.add_argument("--substeps", type=int, default=400)
    parser.add_argument("--repeat", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=100.0)
    parser.add_argument("--fusion", nargs="+", default=list(CHOICES), choices=CHOICES, help="which kernels; the first is the reference")
    parser.add_argument("--law", default="pretrained", choices=("pretrained", "random"), help="random: the networks of `rollout.py`")
    parser.add_argument("--cases", nargs="+", help="parts of the names of the cases to run")
    parser.add_argument("--data", type=Path, default=os.environ.get("NEUIDO_DATA"))
    parser.add_argument("--out", type=Path, help="also write the tables to this file")
    options = parser.parse_args()
    device = torch.device(options.device)
    begun = time.perf_counter()
    one, six = scene_case(["bouncy-ball"], options, device), scene_case(list(SIX), options, device)
    million = block(options, device)
    cases = [
        Case("bouncy-ball, learned law, forward", one, False),
        Case("bouncy-ball, learned law, with gradient", one, True),
        Case("a million, fixed corotated, forward", million, False, 10),
        Case("a million, fixed corotated, with gradient", million, True, 5),
        Case("six scenes, learned law, forward", six, False, 10),
        Case("six scenes, learned law, with gradient", six, True, 10),
    ]
    if options.cases:
        cases = [case for case in cases if any(part in case.name for part in options.cases)]
    rows, kernels, left = [], [], []
    for case in cases:
        if time.perf_counter() - begun > options.seconds:
            left.append(case.name)
            continue
        more, times = measure(case, options, device, begun + options.seconds)
        rows += more
        kernels += times
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"
    text = f"{name}, torch {torch.__version__}, {'real bodies' if options.data and not options.particles else 'balls'}\n\n"
    text += table(["case", "kernels", "ms", "us/substep", "particle-substeps/s", "x twin", "motion", "gradients", "ready [s]"], rows)
    if kernels:
        text += "\n\n" + table(["case", "kernels", "us a substep"], kernels)
    if left:
        text += f"\n\nNot begun within {options.seconds:g} s: {'; '.join(left)}."
    print("\n" + text)
    if options.out:
        write_text(options.out, text + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
