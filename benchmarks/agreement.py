"""Compare the fast path (captured CUDA graph, fused networks) with its slow reference over 400 substeps of BouncyBall.

    python benchmarks/agreement.py [--device cuda] [--steps 400] [--data FOLDER]

The reference is the same rollout run eagerly: networks use the BLAS of torch, and only the states are stored. Two float32 runs of a
body in contact diverge by more than rounding. The table therefore also compares the reference with itself after a perturbation of the
initial state by one ulp, and both with the reference in float64. Differences are norms over all frames, relative to the norm of the
motion (x - x0) and of the gradient.
"""

import argparse
import os
from pathlib import Path

import torch
from rollout import bodies, neural

from neuido.physics.laws.base import Engine
from neuido.physics.mpm.simulator import Simulator


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--data", type=Path, default=os.environ.get("NEUIDO_DATA"))
    options = parser.parse_args()
    device = torch.device(options.device)
    scenes, body = bodies(["bouncy-ball"], None if options.data is None else Path(options.data))
    weight = torch.randn(len(body[0].x), 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64).to(device)

    def run(fast: bool, dtype: torch.dtype = torch.float32, ulp: bool = False) -> list[torch.Tensor]:
        sim = Simulator(scenes, body, device=device, dtype=dtype, graphs=fast, store="auto" if fast else "state")
        elastic, plastic, leaves = neural(1, device)
        if not fast:
            for law in (elastic, plastic):
                law.engine = lambda tensors, particles, law=law: Engine(law, tensors, particles)
        state = sim.state
        if ulp:
            up = torch.full_like(state.x, 2.0)
            state = state._replace(x=torch.nextafter(state.x, torch.where(torch.rand_like(state.x) < 0.5, up, -up)))
        every = max(1, options.steps // 20)
        x = sim.rollout(options.steps, elastic, plastic, state=state, every=every, check=False).x
        gradients = torch.autograd.grad((x[-1] * weight.to(dtype)).sum(), leaves)
        return [(x - x[0]).double().detach(), *(g.double() for g in gradients)]

    runs = {
        "fast": run(True),
        "slow": run(False),
        "slow, start moved by one ulp": run(False, ulp=True),
        "slow, float64": run(False, torch.float64),
    }
    pairs = [("fast", "slow"), ("slow, start moved by one ulp", "slow"), ("fast", "slow, float64"), ("slow", "slow, float64")]
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"
    print(f"{options.steps} substeps, {len(body[0].x):,} particles, {name}\n")
    print("| run | against | motion | elastic W3 | elastic b3 | plastic W3 | plastic b3 |\n| --- | --- | --- | --- | --- | --- | --- |")
    for a, b in pairs:
        cells = [f"{float((p - q).norm() / q.norm().clamp(min=1e-30)):.1e}" for p, q in zip(runs[a], runs[b])]
        print(f"| {a} | {b} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
