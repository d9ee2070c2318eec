"""Time to export a motion of many particles, format by format: `python benchmarks/export.py --particles 20000 --frames 100`."""

import argparse
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np

import neuido


def motion(particles: int, frames: int) -> SimpleNamespace:
    """A ball that falls and is stretched, as float32 arrays."""
    spacing = (4 / 3 * np.pi * 0.2**3 / particles) ** (1 / 3)
    body = neuido.shapes.ball(centre=(0.5, 0.6, 0.5), radius=0.2, spacing=spacing)
    rest, steps = body.x.numpy(), np.linspace(0, 1, frames, dtype=np.float32)
    F = np.tile(np.eye(3, dtype=np.float32), (frames, len(rest), 1, 1))
    F[:, :, 0, 0] += 0.2 * steps[:, None]
    x = np.einsum("kpij,pj->kpi", F, rest).astype(np.float32)
    x[..., 1] -= 0.3 * steps[:, None] ** 2
    v = np.gradient(x, 0.01, axis=0).astype(np.float32)
    return SimpleNamespace(x=x, v=v, C=np.zeros_like(F), F=F, times=0.01 * np.arange(frames))


def main() -> None:
    """Print one line for each format."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--particles", type=int, default=20000)
    parser.add_argument("--frames", type=int, default=100)
    options = parser.parse_args()
    made = motion(options.particles, options.frames)
    law = neuido.laws.FixedCorotated(1e5, 0.3)
    cases = [
        ("usd", {}),
        ("usd", {"law": law}),
        ("usd", {"surface": True}),
        ("glb", {}),
        ("pvd", {}),
        ("ply", {}),
        ("abc", {}),
        ("npz", {}),
    ]
    with tempfile.TemporaryDirectory() as folder:
        neuido.export(motion(200, 2), Path(folder) / "warm.usd", law=law, surface=True)  # kernels are built once
        print(f"{made.x.shape[1]} particles, {options.frames} frames")
        for number, (ending, more) in enumerate(cases):
            place = Path(folder) / f"case{number}"
            begun = time.perf_counter()
            neuido.export(made, place / f"motion.{ending}", **more)
            seconds = time.perf_counter() - begun
            size = sum(path.stat().st_size for path in place.rglob("*") if path.is_file()) / 1e6
            print(f"{ending:<4} {', '.join(more) or 'particles and fields':<22} {seconds:6.1f} s {size:8.1f} MB")


if __name__ == "__main__":
    main()
