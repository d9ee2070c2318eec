"""Measure the speed of differentiable splatting, and compare it with the goals of the project.

    python benchmarks/render.py [--device cuda] [--repeat 20] [--backend warp] [--out render.csv]

The body is a ball filled with touching Gaussians of opacity 0.3 to 1, so the front ones saturate every pixel. Unless stated otherwise,
gradients are those of Stage II: means and covariances only. The time of a whole call, including the tile lists, is divided by the number
of its images.
"""

import argparse
import csv
import math
import platform
import statistics
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import torch

from neuido.models.render.splatting import rasterize


@dataclass
class Case:
    """One row of the table; `goal` is the time of forward and backward pass [ms per image]."""

    gaussians: int
    pixels: int
    frames: int = 1
    views: int = 1
    fill: float = 0.35
    appearance: bool = False
    goal: float | None = None
    devices: tuple[str, ...] = ("cuda",)


CASES = [
    Case(25_000, 400),
    Case(25_000, 400, frames=10, views=2, goal=0.5),
    Case(25_000, 400, frames=80, views=2, goal=0.5),
    Case(25_000, 400, frames=80, views=2, appearance=True),
    Case(25_000, 400, frames=80, views=2, fill=0.9),
    Case(25_000, 512, frames=80, views=2),
    Case(250_000, 800, views=2),
    Case(5_000, 128, devices=("cpu",)),
    Case(5_000, 128, frames=8, views=2, devices=("cpu",)),
    Case(20_000, 128, fill=0.6, goal=32.0, devices=("cpu",)),
    Case(25_000, 400, devices=("cpu",)),
]


def scene(case: Case, device: torch.device) -> list[torch.Tensor]:
    """Return the arguments of `rasterize` for F frames; the ball covers the fraction `fill` of each image."""
    g = torch.Generator().manual_seed(0)
    n = case.gaussians
    directions = torch.nn.functional.normalize(torch.randn(n, 3, generator=g), dim=1)
    means = directions * torch.rand(n, 1, generator=g) ** (1 / 3)
    A = (0.6 * (4.19 / n) ** (1 / 3)) * (torch.eye(3) + 0.3 * torch.randn(n, 3, 3, generator=g))
    moves = 0.02 * torch.randn(case.frames, 1, 3, generator=g)
    viewmats = torch.eye(4).repeat(case.views, 1, 1)
    for j in range(case.views):
        a = 2 * math.pi * j / case.views
        viewmats[j, :3, :3] = torch.tensor([[math.cos(a), 0, math.sin(a)], [0, 1, 0], [-math.sin(a), 0, math.cos(a)]])
        viewmats[j, 2, 3] = 5.0
    f = case.pixels * 5.0 * math.sqrt(case.fill / math.pi)
    Ks = torch.tensor([[f, 0, case.pixels / 2], [0, f, case.pixels / 2], [0, 0, 1]]).repeat(case.views, 1, 1)
    opacities, colours = 0.3 + 0.7 * torch.rand(n, generator=g), torch.rand(n, 3, generator=g)
    parts = [means + moves, (A @ A.mT).expand(case.frames, n, 3, 3).contiguous(), opacities, colours, viewmats, Ks]
    return [part.to(device) for part in parts]


def measure(case: Case, device: torch.device, backend: str, repeat: int) -> dict:
    """Return the row of a case: median times of the forward pass and of both passes [ms per image], and peak device memory."""
    tensors = scene(case, device)
    leaves = tensors[: 4 if case.appearance else 2]
    images = case.frames * case.views
    weight = torch.randn(case.frames, case.views, case.pixels, case.pixels, 3, device=device)
    cuda = device.type == "cuda"

    def run(gradient: bool) -> None:
        for leaf in leaves:
            leaf.requires_grad_(gradient)
        shown = rasterize(*tensors, case.pixels, case.pixels, backend=backend)[0]
        if gradient:
            torch.autograd.grad(shown, leaves, weight)

    row = {"gaussians": case.gaussians, "pixels": case.pixels, "frames": case.frames, "views": case.views, "fill": case.fill,
           "gradients": "all" if case.appearance else "means, covariances"}  # fmt: skip
    for name, gradient in (("forward_ms", False), ("both_ms", True)):
        run(gradient)
        run(gradient)
        if cuda:
            torch.cuda.synchronize()
            torch.cuda.reset_peak_memory_stats()
        times = []
        for _ in range(repeat):
            start = time.perf_counter()
            run(gradient)
            if cuda:
                torch.cuda.synchronize()
            times.append(time.perf_counter() - start)
        row[name] = 1e3 * statistics.median(times) / images
    row["spread_ms"] = 1e3 * (max(times) - min(times)) / images
    row["peak_mb"] = torch.cuda.max_memory_allocated() / 1e6 if cuda else 0.0
    row["goal_ms"] = case.goal
    row["better_by"] = case.goal / row["both_ms"] if case.goal else None
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--repeat", type=int, default=20)
    parser.add_argument("--backend", default="warp", choices=("warp", "gsplat"))
    parser.add_argument("--out", type=Path, help="also write the rows to this CSV file")
    options = parser.parse_args()
    device = torch.device(options.device)
    if device.type == "cpu":
        torch.set_num_threads(1)
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else f"{platform.processor() or platform.machine()}, one thread"
    print(f"{name}, torch {torch.__version__}, back end {options.backend}, median of {options.repeat}, ms an image\n")
    print("| Gaussians | image | frames x views | fill | gradients | forward | forward + backward | spread | peak MB | goal | better by |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    rows = []
    for case in CASES:
        if device.type not in case.devices:
            continue
        row = measure(case, device, options.backend, options.repeat)
        goal, ratio = (f"{row['goal_ms']:g}", f"{row['better_by']:.2f}") if case.goal else ("", "")
        times = " | ".join(f"{row[name]:.3f}" for name in ("forward_ms", "both_ms", "spread_ms"))
        shape = f"{case.pixels}^2 | {case.frames} x {case.views} | {case.fill:.0%} | {row['gradients']}"
        print(f"| {case.gaussians:,} | {shape} | {times} | {row['peak_mb']:.0f} | {goal} | {ratio} |")
        sys.stdout.flush()
        rows.append(row)
    if options.out and rows:
        with options.out.open("w", newline="") as file:
            writer = csv.DictWriter(file, rows[0])
            writer.writeheader()
            writer.writerows(rows)


if __name__ == "__main__":
    main()
