"""Measure how time and memory of the differentiable rollout scale with particles, substeps, scenes and grid.

    python benchmarks/scaling.py [--device cuda] [--repeat 5] [--out runs/scaling] [--quick]

One quantity is varied at a time; the others keep the base values in the first line of the table. OUT receives `scaling.md`, the table with
the fitted exponents, and `scaling.png`, a log-log plot. The bodies are cubes of evenly spaced particles with the neural law of
`rollout.py`. `--quick` uses few small values, to try the script.

The exponent is the slope in the log-log plot by least squares over all values. The slope between the last two values is given in brackets,
because a constant part of the time lowers the slope at small values. The size of the grid is its number of cells along a side, so an
exponent of 3 means growth with the number of nodes. Memory is the peak memory of torch tensors during a call, including those of the
simulator and, on CUDA, of the captured graphs.
"""

import argparse
import dataclasses
import gc
import math
import platform
import statistics
import weakref
from collections.abc import Callable
from pathlib import Path

import torch
from matplotlib.figure import Figure
from rollout import neural, timed
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from neuido.physics.mpm.simulator import Simulator
from neuido.types import Body, Scene

FIGURES = ("forward ms", "forward + backward ms", "forward MB", "forward + backward MB")


@dataclasses.dataclass(frozen=True)
class Size:
    """Size of a rollout; `particles` is the number per scene, `grid` the number of cells along a side."""

    particles: int
    substeps: int
    scenes: int
    grid: int


BASE = {"cuda": Size(100_000, 40, 1, 32), "cpu": Size(3_000, 10, 1, 32), "quick": Size(1_000, 4, 1, 16)}
VALUES = {
    "cuda": {
        "particles": (10_000, 30_000, 100_000, 300_000, 1_000_000),
        "substeps": (10, 40, 160, 640),
        "scenes": (1, 2, 4, 8, 16),
        "grid": (16, 24, 32, 48, 64, 96),
    },
    "cpu": {
        "particles": (1_000, 3_000, 10_000, 30_000),
        "substeps": (5, 10, 20, 40),
        "scenes": (1, 2, 4, 8, 16),
        "grid": (16, 24, 32, 48, 64, 96),
    },
    "quick": {"particles": (500, 2_000), "substeps": (2, 6), "scenes": (1, 3), "grid": (12, 24)},
}


def cube(count: int) -> Body:
    """Return a body of `count` particles on a regular lattice in the centre of the domain, falling at 1 m/s."""
    side = math.ceil(count ** (1 / 3) - 1e-9)
    line = 0.25 + 0.5 * (torch.arange(side, dtype=torch.float64) + 0.5) / side
    x = torch.cartesian_prod(line, line, line)[:count]
    v = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64).expand_as(x)
    return Body(x, v, torch.full((count,), (0.5 / side) ** 3, dtype=torch.float64))


def rollout_of(size: Size, device: torch.device) -> tuple[Callable[[], object], Callable[[], object]]:
    """Return two functions for a rollout of this size: the forward pass alone, and forward and backward pass."""
    sim = Simulator([Scene(cells=size.grid, dt=2e-4)] * size.scenes, [cube(size.particles)] * size.scenes, device=device)
    elastic, plastic, leaves = neural(size.scenes, device)

    def forward() -> torch.Tensor:
        return sim.rollout(size.substeps, elastic, plastic, every=size.substeps, check=False).x

    def alone() -> None:
        with torch.no_grad():
            forward()

    def both() -> None:
        torch.autograd.grad(forward()[-1].sum(), leaves, retain_graph=True)

    return alone, both


class Ledger(TorchDispatchMode):
    """Track the memory of all tensors that operators create or read while the mode is active, until they are freed."""

    def __init__(self) -> None:
        super().__init__()
        self.known: set[int] = set()
        self.older = self.now = self.most = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.older += self._enter((args, kwargs))  # created earlier, and alive throughout
        out = func(*args, **(kwargs or {}))
        self.now += self._enter(out, self._leave)
        self.most = max(self.most, self.now)
        return out

    def _enter(self, tree: object, freed: Callable[[int], None] = lambda size: None) -> int:
        """Return the total size of the storages that are new [B]."""
        total = 0
        for leaf in tree_leaves(tree):
            if isinstance(leaf, torch.Tensor) and leaf.untyped_storage()._cdata not in self.known:
                storage = leaf.untyped_storage()
                total += storage.nbytes()
                self.known.add(storage._cdata)
                weakref.finalize(storage, self.known.discard, storage._cdata)
                weakref.finalize(storage, freed, storage.nbytes())
        return total

    def _leave(self, size: int) -> None:
        self.now -= size

    @property
    def peak(self) -> int:
        return self.older + self.most


def peak_bytes(prepare: Callable[[], Callable[[], object]], device: torch.device) -> int:
    """Return the peak memory of a call [B]: on CUDA of all allocations since `prepare`, on the CPU of the tensors that the call uses."""
    gc.collect()
    if device.type == "cuda":
        before = torch.cuda.memory_allocated(device)
        run = prepare()
        torch.cuda.reset_peak_memory_stats(device)
        run()
        return torch.cuda.max_memory_allocated(device) - before
    run = prepare()
    run()  # allocate the buffers that laws share between rollouts, so that they do not count
    with Ledger() as ledger:
        run()
    return ledger.peak


def measure(size: Size, device: torch.device, repeat: int) -> tuple[float, ...]:
    """Return the four FIGURES of a size."""
    peaks = [peak_bytes(lambda k=k: rollout_of(size, device)[k], device) / 1e6 for k in range(2)]
    gc.collect()
    times = [1e3 * statistics.median(timed(run, device, repeat)) for run in rollout_of(size, device)]
    return (*times, *peaks)


def exponent(values: list[float], figures: list[float]) -> float:
    """Return the slope of log(figure) over log(value) by least squares; NaN for fewer than two positive figures."""
    pairs = [(math.log(v), math.log(f)) for v, f in zip(values, figures) if f > 0]
    if len(pairs) < 2:
        return math.nan
    x, y = (torch.tensor(column, dtype=torch.float64) for column in zip(*pairs))
    x = x - x.mean()
    return float((x * y).sum() / (x * x).sum())


def table(title: str, base: Size, rows: dict[str, list[tuple[float, tuple[float, ...]]]]) -> str:
    """Return a table in Markdown with the figures of each quantity, followed by their exponents."""
    lines = [title, "", "Base: " + ", ".join(f"{name} {value:,}" for name, value in dataclasses.asdict(base).items()) + ".", ""]
    lines += ["| quantity | value | " + " | ".join(FIGURES) + " |", "| --- " * (2 + len(FIGURES)) + "|"]
    for name, measured in rows.items():
        values = [value for value, _ in measured]
        lines += [f"| {name} | {value:,} | " + " | ".join(f"{figure:.4g}" for figure in figures) + " |" for value, figures in measured]
        slopes = []
        for column in range(len(FIGURES)):
            figures = [row[column] for _, row in measured]
            slopes.append(f"{exponent(values, figures):.2f} ({exponent(values[-2:], figures[-2:]):.2f})")
        lines.append(f"| {name} | exponent | " + " | ".join(slopes) + " |")
    return "\n".join(lines) + "\n"


def picture(title: str, rows: dict[str, list[tuple[float, tuple[float, ...]]]], path: Path) -> None:
    """Plot time (top) and memory (bottom) with a column for each quantity."""
    figure = Figure(figsize=(3.2 * len(rows), 6.0), layout="constrained")  # without pyplot, which may open a window
    axes = figure.subplots(2, len(rows), squeeze=False, sharey="row")
    for column, (name, measured) in enumerate(rows.items()):
        values = [value for value, _ in measured]
        for row in range(2):
            ax = axes[row][column]
            for label, colour, k in (("forward", "tab:blue", 2 * row), ("forward + backward", "tab:orange", 2 * row + 1)):
                figures = [figures[k] for _, figures in measured]
                ax.plot(values, figures, "o-", color=colour, label=f"{label}, slope {exponent(values, figures):.2f}")
            ax.set(xscale="log", yscale="log", xlabel=name)
            ax.set_xticks(values, [f"{value:,}" for value in values], rotation=45)
            ax.minorticks_off()
            ax.grid(alpha=0.3)
            ax.legend(fontsize="small", frameon=False)
        axes[0][0].set_ylabel("time [ms]")
        axes[1][0].set_ylabel("memory [MB]")
    figure.suptitle(title)
    figure.savefig(path, dpi=120)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--out", type=Path, default=Path("runs/scaling"))
    parser.add_argument("--quick", action="store_true", help="use few small values, without repetitions")
    options = parser.parse_args(arguments)
    device = torch.device(options.device)
    if device.type == "cpu":
        torch.set_num_threads(1)
    kind, repeat = ("quick", 1) if options.quick else (device.type, options.repeat)
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else f"{platform.processor() or platform.machine()}, one thread"
    title = f"{name}, torch {torch.__version__}, neural law, median of {repeat}"
    rollout_of(BASE["quick"], device)[1]()  # compile and load the kernels before measuring
    rows: dict[str, list[tuple[float, tuple[float, ...]]]] = {}
    for quantity, values in VALUES[kind].items():
        rows[quantity] = []
        for value in values:
            figures = measure(dataclasses.replace(BASE[kind], **{quantity: value}), device, repeat)
            rows[quantity].append((value, figures))
            print(f"{quantity} {value:,}: " + ", ".join(f"{label} {figure:.4g}" for label, figure in zip(FIGURES, figures)), flush=True)
    options.out.mkdir(parents=True, exist_ok=True)
    text = table(title, BASE[kind], rows)
    (options.out / "scaling.md").write_text(text)
    picture(title, rows, options.out / "scaling.png")
    print("\n" + text)


if __name__ == "__main__":
    main()
