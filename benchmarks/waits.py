"""Measure what a user waits for: start-up, reading a law, adaptation, reconstruction, a picture; and where the time goes.

    python benchmarks/waits.py [--device cuda] [--only few-shot,render] [--scenes 6] [--steps 100] [--seconds 600] [--out waits.md]

All scenes are made by the script: balls of about 25,000 particles with textures, filmed in 80 frames from ten views at 400 x 400 px. A row
that is too long for `--seconds` is left out, and says so. `--small` measures the same on tiny scenes, as the test does; its figures mean
nothing. The parts of a row are measured in a run of their own, in which the device is waited for at the ends of each part; parts may lie in
one another. (The engine alone is measured by `rollout.py` and `scaling.py`, the renderer in batches by `render.py`.)
"""

import argparse
import contextlib
import functools
import io
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import render as render_benchmark
import torch
from parts import Row, operations, parts

from neuido.commands.main import main as command
from neuido.data.scenes.film_options import Film
from neuido.models.render import splatting

ROOT = Path(__file__).parents[1]


@dataclass
class Size:
    """Size of the made scenes and of the pictures."""

    spacing: float
    """Distance of the particles in a ball of radius 0.25 m [m]."""
    cells: int
    dt: float
    film: Film
    gaussians: int
    pictures: tuple[tuple[int, int], ...]
    """Numbers of Gaussians and sides [px] of single pictures."""
    steps: int
    """Optimiser steps of a reconstruction."""


FULL = Size(0.0138, 32, 1e-3, Film(), 8000, ((25_000, 400), (250_000, 800), (1_000_000, 800)), 2000)
SMALL = Size(0.08, 16, 2e-3, Film(views=3, held_out=(2,), width=48, height=48, frames=6, substeps=3), 200, ((300, 32),), 4)
GOALS = {
    "few-shot": "6 s for 100 steps", "test": "20 s for six scenes", "reconstruct": "20 s", "law": "0.15 s; 0.025 s a further scene",
    "picture 25,000": "0.0006 s", "picture 250,000": "0.0012 s", "first rollout": "15 s (GPU), 20 s (CPU)",
}  # fmt: skip


class Bench:
    """Options, made scenes and the clock of a run.

    Args:
        options: Parsed options.
        folder: Folder for what is made.
    """

    def __init__(self, options: argparse.Namespace, folder: Path) -> None:
        self.options, self.folder, self.begun = options, folder, time.perf_counter()
        self.device, self.size = torch.device(options.device), SMALL if options.small else FULL

    def wait(self) -> None:
        """Wait for the device."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)

    def left(self) -> float:
        """Return the time that is left [s]."""
        return self.options.seconds - (time.perf_counter() - self.begun)

    def times(self, run: Callable[[], object], repeat: int) -> list[float]:
        """Return the times of `repeat` calls after one that compiles, captures and allocates [s]."""
        found = []
        for _ in range(repeat + 1):
            self.wait()
            start = time.perf_counter()
            run()
            self.wait()
            found.append(time.perf_counter() - start)
        return found[1:]

    @functools.cached_property
    def scenes(self) -> list[Path]:
        """Folders of filmed scenes with a stand-in of a reconstruction: the known particles, some of which carry Gaussians."""
        from neuido.data.files.writing import write_arrays
        from neuido.data.scenes.filmed_scene import read_setting, read_truth, write_setting
        from neuido.data.scenes.synthetic import make_scenes
        from neuido.models.render.gaussians import attach_gaussians, save_gaussians

        made = sorted((self.folder / "scenes").glob("Ball*"))
        if len(made) >= self.options.scenes:
            return made[: self.options.scenes]
        entries = []
        for i in range(self.options.scenes):
            entries.append({
                "name": f"Ball{i}",
                "scene": {"domain": [[0.0] * 3, [1.0] * 3], "gravity": [0.0, -9.8, 0.0],
                          "walls": {"contact": "separate", "friction": float("inf"), "inset": 0.0}},
                "discretisation": {"grid": self.size.cells, "dt": self.size.dt},
                "model": {"density": 1000.0, "elasticity": {"law": "fixed_corotated", "young": 3e4 + 1e4 * i, "poisson": 0.25}},
                "body": {"shape": "ball", "centre": [0.5, 0.35, 0.5], "radius": 0.25, "spacing": self.size.spacing, "jitter": 0.5,
                         "velocity": [0.1 * i, -1.9, 0.0]},
            })  # fmt: skip
        folders = make_scenes(
            entries, self.size.film, self.folder / "scenes", draw=splatting.rasterize, device=self.device.type, progress=False
        )
        for folder in folders:
            truth, own = read_truth(folder), folder / "reconstruction"
            assert truth is not None
            own.mkdir()
            v = np.tile(np.array([0.0, -1.9, 0.0], np.float32), (len(truth.x0), 1))
            write_arrays(own / "body.npz", {"x0": truth.x0.numpy(), "v0": v, "volume": truth.volume.numpy()}, compressed=False)
            write_setting(read_setting(folder / "experiment.yaml"), own / "scene.yaml")
            picked = torch.linspace(0, len(truth.x0) - 1, min(self.size.gaussians, len(truth.x0))).long()
            share = truth.volume[picked] * len(truth.x0) / len(picked)
            colours = torch.rand(len(picked), 3, generator=torch.Generator().manual_seed(0))
            save_gaussians(own / "gaussians.ply", attach_gaussians(truth.x0[picked], share, colours, spread=0.5))
        return folders

    def neuido(self, *arguments: str) -> None:
        """Run a command of neuido in this process; its output is shown only if it fails."""
        output = io.StringIO()
        try:
            with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
                command(list(arguments))
        except SystemExit as stop:
            if stop.code not in (None, 0):
                raise RuntimeError(f"neuido {' '.join(arguments)} ended with {stop.code}:\n{output.getvalue()[-2000:]}") from None

    def training(self, name: str) -> list[str]:
        """Return the options that `fit` and `test` share: scenes, folders and device."""
        names = ", ".join(f"{folder.name}" for folder in self.scenes)
        options = ["--data.root", str(self.scenes[0].parent), "--data.scenes", f"[{names}]", "--model.cache", "null"]
        options += [
            "--model.out",
            str(self.folder / name),
            "--trainer.logger.init_args.save_dir",
            str(self.folder),
            "--trainer.devices",
            "1",
        ]
        return [*options, "--trainer.accelerator", "gpu" if self.device.type == "cuda" else "cpu"]


def in_a_process(code: str, **environment: str) -> tuple[float, str]:
    """Run Python code in a process of its own; return its time [s] and its output."""
    paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    surroundings = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), **environment}
    start = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=surroundings)
    if done.returncode:
        raise RuntimeError(done.stderr[-2000:])
    return time.perf_counter() - start, done.stdout + done.stderr


def imports(bench: Bench) -> list[Row]:
    """Time processes that import the package and show help."""
    repeat = 1 if bench.options.small else 3
    cases = {
        "import neuido": "import neuido", "import torch": "import torch",
        "import neuido.physics": "import neuido.physics; neuido.physics.Simulator",
        "neuido fit --help": "import sys; from neuido.commands.main import main; main(['fit', '--help'])",
    }  # fmt: skip
    return [Row(name, statistics.median(in_a_process(code)[0] for _ in range(repeat)), repeat) for name, code in cases.items()]


FIRST = """
import time; begun = time.perf_counter()
import torch, warp as wp
from neuido.data.bodies.shapes import ball
from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
from neuido.physics.laws.classical import FixedCorotated
from neuido.physics.mpm.simulator import Simulator
from neuido.types import Scene
print("#imports", time.perf_counter() - begun)
body = ball(centre=(0.5, 0.4, 0.5), radius=0.25, spacing={spacing}, velocity=(0.0, -1.0, 0.0))
simulator = Simulator(Scene(cells={cells}, dt=2e-4), body, device="{device}")
wp.config.log_level = wp.LOG_INFO
young = torch.tensor([1e5], device="{device}", requires_grad=True)
operator = IntrinsicDynamicsOperator.load("pretrained").to("{device}").eval()
z = operator.latents.mean(0).to("{device}").requires_grad_()
laws = operator.laws(z) if "{law}" == "learned" else (FixedCorotated(young, 0.3), None)
start = time.perf_counter()
with torch.no_grad():
    print("#moved", float(simulator.rollout(5, *laws, check=False).x[-1].sum()) != 0)
print("#forward", time.perf_counter() - start)
start = time.perf_counter()
simulator.rollout(5, *laws, check=False).x.sum().backward()
print("#gradient", time.perf_counter() - start)
"""


def first(bench: Bench) -> list[Row]:
    """Time a first rollout in a process of its own, with an empty cache of kernels."""
    rows = []
    for law in ("fixed corotated",) if bench.options.small else ("fixed corotated", "learned"):
        with tempfile.TemporaryDirectory() as cache:
            code = FIRST.format(spacing=bench.size.spacing, cells=bench.size.cells, device=bench.device.type, law=law)
            total, output = in_a_process(code, WARP_CACHE_PATH=cache)
        found = {line.split()[0][1:]: line.split()[1] for line in output.splitlines() if line.startswith("#")}
        own = {name: [float(found[name])] for name in ("imports", "forward", "gradient")}
        modules = [line.strip() for line in output.splitlines() if "took" in line]
        note = "process, imports and forward"
        rows.append(Row(f"first rollout, {law}", total - own["gradient"][0], 1, note, own, "\n".join(modules)))
    return rows


def pictures(bench: Bench) -> list[Row]:
    """Time one image, forward and backward: called, and captured with a known capacity of the lists."""
    rows = []
    for gaussians, pixels in bench.size.pictures:
        name = f"picture {gaussians:,} at {pixels}^2"
        draw = picture(render_benchmark.scene(render_benchmark.Case(gaussians, pixels), bench.device), pixels)
        for way, gradient in (("forward", False), ("forward + backward", True)):
            times = bench.times(functools.partial(draw, gradient), bench.options.repeat)
            rows.append(Row(f"{name}, {way}", statistics.median(times), len(times)))
        if bench.device.type == "cuda":
            run = functools.partial(draw, True, capacity=splatting.room_of(1, gaussians))
            run()
            graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(graph):
                run()
            times = bench.times(graph.replay, bench.options.repeat)
            rows.append(Row(f"{name}, forward + backward, captured", statistics.median(times), len(times)))
        rows[-1].table = operations(functools.partial(draw, True))
    return rows


def picture(tensors: list[torch.Tensor], pixels: int) -> Callable[..., None]:
    """Return a function that draws one image, and differentiates it with respect to means and covariances if it is asked to."""
    weight = torch.randn(1, 1, pixels, pixels, 3, device=tensors[0].device)
    leaves = tensors[:2]

    def draw(gradient: bool, **options: Any) -> None:
        for leaf in leaves:
            leaf.requires_grad_(gradient)
        shown = splatting.rasterize(*tensors, pixels, pixels, **options)[0]
        if gradient:
            torch.autograd.grad(shown, leaves, weight)

    return draw


def law(bench: Bench) -> list[Row]:
    """Time the way from two views of a scene to a law: decoding, then from memory by each method of flow, then several scenes together."""
    from neuido.data.scenes.filmed_scene import load_visual_scene
    from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
    from neuido.models.operator.law_properties import p_wave_modulus
    from neuido.models.video import encoder as encoder_module
    from neuido.models.video import flow

    open_two = functools.partial(load_visual_scene, views=("0", "1"))
    repeat = max(2, bench.options.repeat // 4)
    times = bench.times(functools.partial(open_two, bench.scenes[0]), 2)
    rows = [Row("decode 80 frames x 2 views", statistics.median(times), len(times), f"{os.cpu_count()} cores")]
    scenes = [open_two(folder) for folder in bench.scenes]
    operator = IntrinsicDynamicsOperator.load("pretrained").to(bench.device).eval()
    encoder = encoder_module.DynamicsEncoder.load("pretrained").to(bench.device).eval()

    @torch.no_grad()
    def read(count: int, method: str) -> torch.Tensor:
        seen = [encoder.measure_flow(scene.batch, [0, 1], scene.body.x.mean(0), method=method) for scene in scenes[:count]]
        interval, cell = (torch.cat(parts) for parts in zip(*((torch.full((2,), one.frame_interval), one.cell) for one in seen)))
        volume, conditions = encoder.embed_flow(torch.cat([one.flow for one in seen]), interval, cell, batch=2 * count)
        z = torch.stack([encoder(*pair) for pair in zip(volume.split(2), conditions.split(2))])
        for one in z:
            for part in operator.laws(one):
                part.tensors()
        return z

    wanted = {"flow of all pairs": (flow, "optical_flow"), "brightness": (flow, "_brightness"), "parallel flow": (flow, "parallel_flow"),
              "crop": (flow, "_crop_flow"), "VAE": (encoder_module.DynamicsEncoder, "embed_flow"),
              "projector": (encoder_module.DynamicsEncoder, "forward"),
              "law": (IntrinsicDynamicsOperator, "laws")}  # fmt: skip
    moduli = {}
    for method in flow.METHODS:
        times = bench.times(functools.partial(read, 1, method), repeat)
        with parts(wanted, bench.wait) as found:
            read(1, method)
        moduli[method] = p_wave_modulus(operator, read(len(scenes), method))
        rows.append(Row(f"law from 80 frames x 2 views in memory, {method}", statistics.median(times), repeat, "alone", found))
        if len(scenes) > 1:
            together = statistics.median(bench.times(functools.partial(read, len(scenes), method), repeat))
            further = (together - rows[-1].seconds) / (len(scenes) - 1)
            rows.append(Row(f"law of a further scene, {method}", further, repeat, f"{len(scenes)} scenes {together:.3f} s"))
    ratios = (moduli["parallel"] / moduli["opencv"]).log().abs().exp()
    rows[
        -1
    ].note += f"; moduli read by both methods differ by {float(ratios.max()) - 1:.2%} at most, {float(ratios.median()) - 1:.2%} median"
    return rows


def few_shot(bench: Bench) -> list[Row]:
    """Time the steps of an adaptation, then measure the parts of a step."""
    from lightning.pytorch import LightningModule
    from lightning.pytorch.strategies import Strategy

    from neuido.models.fewshot.fit_progress import Progress
    from neuido.models.fewshot.scene_fit import SceneFit
    from neuido.models.inference import pipeline, prepared_scene
    from neuido.models.stages import adapt, image_module, scene_ranks

    given = ["fit", "--config", str(ROOT / "configs" / "adapt.yaml"), *bench.training("fit"), "--data.scenes", f"[{bench.scenes[0].name}]"]
    given += ["--trainer.callbacks", "null"]
    steps, times, seen = bench.options.steps, [], []
    original = adapt.AdaptModule.optimizer_step

    def step(self: Any, *arguments: Any, **options: Any) -> None:
        bench.wait()
        start = time.perf_counter()
        original(self, *arguments, **options)
        bench.wait()
        times.append(time.perf_counter() - start)

    def profiled(self: Any, *arguments: Any, **options: Any) -> None:
        run = functools.partial(original, self, *arguments, **options)
        seen.append(operations(run, calls=1, rows=24)) if self.global_step == few - 2 else run()

    try:
        adapt.AdaptModule.optimizer_step = step
        bench.neuido(*given, "--model.steps", str(steps))
        adapt.AdaptModule.optimizer_step = profiled
        few = min(steps, 12)
        parts_of = {
            "step": (adapt.AdaptModule, "training_step"), "rollout": (SceneFit, "rollout"), "images and losses": (adapt, "image_losses"),
            "render with deformation": (image_module, "render_motion"), "deformation": (pipeline, "deform"),
            "regulariser": (SceneFit, "regulariser"), "backward": (Strategy, "backward"), "bind": (prepared_scene, "bind"),
            "copy of the parameters": (Progress, "record_success"), "clip": (LightningModule, "configure_gradient_clipping"),
            "check of the gradient": (adapt.AdaptModule, "on_before_optimizer_step"), "log": (scene_ranks.SharesScenes, "_log"),
            "all but the waiting": (LightningModule, "optimizer_step"),
        }  # fmt: skip
        with parts(parts_of, bench.wait) as found:
            bench.neuido(*given, "--model.steps", str(few), "--model.curriculum", "[]", "--model.out", str(bench.folder / "fit2"))
    finally:
        adapt.AdaptModule.optimizer_step = original
    note = f"{steps} steps together {sum(times):.2f} s; the longest, which captures, {max(times):.2f} s"
    return [Row(f"few-shot, {steps} steps", sum(times), 1, note, {name: own[2:] for name, own in found.items()}, "\n".join(seen))]


def test(bench: Bench) -> list[Row]:
    """Time `neuido test` of all scenes, zero-shot, in this process, and its parts."""
    from neuido.data.scenes import filmed_scene_module
    from neuido.models.inference import prepared_scene
    from neuido.models.scoring import motion_scores
    from neuido.models.stages import align
    from neuido.models.video import encoder as encoder_module

    wanted = {
        "read the scenes": (filmed_scene_module, "load_visual_scene"), "prepare": (align, "prepare"),
        "measure flow": (encoder_module.DynamicsEncoder, "measure_flow"), "embed": (encoder_module.DynamicsEncoder, "embed"),
        "bind": (prepared_scene, "bind"), "bytes": (prepared_scene, "as_bytes"), "z": (align, "infer_latent"),
        "rollout": (align, "rollout_with_retries"), "score particles": (motion_scores, "score_motion"),
        "floor": (motion_scores, "floor_per_frame"),
        "score images": (motion_scores, "score_images"), "render": (motion_scores, "render_motion"), "write": (align, "write_frame_scores"),
    }  # fmt: skip
    given = ["test", "--config", str(ROOT / "configs" / "stage2.yaml"), *bench.training("test"), "--model.flow_method", bench.options.flow]
    process = f"from neuido.commands.main import main; main({given!r})"
    seconds = [in_a_process(process)[0] for _ in range(2)]
    with parts(wanted, bench.wait) as found:
        start = time.perf_counter()
        bench.neuido(*given)
        here = time.perf_counter() - start
    note = f"process of its own, the second; {seconds[0]:.2f} s the first, {here:.2f} s in this process; flow by {bench.options.flow}"
    return [Row(f"test, {len(bench.scenes)} scenes", seconds[1], 1, note, found)]


def reconstruct(bench: Bench) -> list[Row]:
    """Time `neuido reconstruct` of one scene, and its parts."""
    from neuido.commands import reconstruct as room
    from neuido.models.reconstruct import gaussian_fit

    module = gaussian_fit.ReconstructModule
    wanted = {"optimise": (room, "_optimise"), "setup": (module, "setup"), "fill": (room, "_fill"), "score": (room, "_score"),
              "compare": (room, "_compare"), "draw": (room, "_draw")}  # fmt: skip
    given = ["reconstruct", str(bench.scenes[0]), "--device", bench.device.type, "--steps", str(bench.size.steps), "--progress", "false"]
    if bench.options.small:
        given += ["--start", "100", "--gaussians", "200", "--particles", "300", "--resolution", "16", "--views", "2"]
    with parts(wanted, bench.wait) as found:
        start = time.perf_counter()
        bench.neuido(*given, "--out", str(bench.folder / "reconstruction"))
        seconds = time.perf_counter() - start
    seen: list[str] = []
    original = module.optimizer_step
    at = bench.size.steps // 2

    def profiled(self: Any, *arguments: Any, **options: Any) -> None:
        run = functools.partial(original, self, *arguments, **options)
        seen.append(operations(run, calls=1, rows=24)) if self.global_step == at else run()

    try:
        module.optimizer_step = profiled
        short = ["--steps", str(min(bench.size.steps, 200))] if not bench.options.small else []
        at = 2 if bench.options.small else 150
        bench.neuido(*given, *short, "--out", str(bench.folder / "reconstruction2"))
    finally:
        module.optimizer_step = original
    return [Row(f"reconstruct, {bench.size.steps} steps", seconds, 1, "", found, "\n".join(seen))]


ROWS = {"imports": imports, "first": first, "render": pictures, "law": law, "few-shot": few_shot, "test": test, "reconstruct": reconstruct}


def report(bench: Bench, rows: list[Row]) -> str:
    """Return the tables as markdown."""
    name = torch.cuda.get_device_name(bench.device) if bench.device.type == "cuda" else f"{platform.processor() or platform.machine()}"
    threads = f"{os.cpu_count()} cores, {torch.get_num_threads()} threads{', small' if bench.options.small else ''}"
    text = [f"{name}, torch {torch.__version__}, {threads}", ""]
    text += ["| what | seconds | median of | goal | note |", "| --- | --- | --- | --- | --- |"]
    for row in rows:
        goal = next((goal for key, goal in GOALS.items() if row.name.startswith(key)), "")
        text.append(f"| {row.name} | {row.seconds:.5g} | {row.count} | {goal} | {row.note} |")
    for row in rows:
        if row.parts or row.table:
            text += ["", f"## {row.name}", ""]
        if row.parts:
            text += ["| part | median [s] | calls | together [s] |", "| --- | --- | --- | --- |"]
            text += [f"| {part} | {statistics.median(t):.5f} | {len(t)} | {sum(t):.3f} |" for part, t in row.parts.items() if t]
        if row.table:
            text += ["", "```", row.table, "```"]
    return "\n".join(text) + "\n"


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu", choices=("cpu", "cuda"))
    parser.add_argument("--only", default=",".join(ROWS), help="rows to measure, separated by commas; default: all")
    parser.add_argument("--scenes", type=int, default=6)
    parser.add_argument("--steps", type=int, default=100, help="steps of the adaptation")
    parser.add_argument("--repeat", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=600.0, help="no further row begins after this time")
    parser.add_argument("--flow", default="opencv", choices=("opencv", "parallel"), help="method of optical flow of the row `test`")
    parser.add_argument("--folder", type=Path, help="folder for the scenes, which are taken from there if it has them")
    parser.add_argument("--json", type=Path, help="JSON file of the rows")
    parser.add_argument("--small", action="store_true", help="tiny scenes")
    parser.add_argument("--out", type=Path, help="markdown file")
    options = parser.parse_args(arguments)
    unknown = set(options.only.split(",")) - set(ROWS)
    if unknown:
        parser.error(f"--only {','.join(sorted(unknown))}: known are {', '.join(ROWS)}")
    with tempfile.TemporaryDirectory() as folder:
        bench, rows = Bench(options, options.folder or Path(folder)), []
        for name in options.only.split(","):
            if bench.left() <= 0:
                rows.append(Row(name, float("nan"), 0, "left out: no time"))
                continue
            try:
                rows += ROWS[name](bench)
            except Exception:  # a row that fails must not cost the others
                rows.append(Row(name, float("nan"), 0, "failed", table=traceback.format_exc()))
            text = report(bench, rows)
            if options.out:
                options.out.write_text(text)
            if options.json:
                options.json.write_text(json.dumps([row.figures() for row in rows], indent=1))
            print(f"{name}: {time.perf_counter() - bench.begun:.0f} s since the start", file=sys.stderr, flush=True)
        print(report(bench, rows))


if __name__ == "__main__":
    main()
