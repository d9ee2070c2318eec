"""The `trajectories` command: the training data of Stage I. `--help` loads no torch."""

from collections import Counter
from pathlib import Path

from neuido.commands.engines.outcome import Share
from neuido.data.files.writing import check_writable
from neuido.data.trajectories.options import FAMILIES, Range, Throw, make_trajectories


def trajectories(
    out: str,
    *,
    families: dict[str, dict[str, Range]] = FAMILIES,
    instances: int = 30,
    held_out: int = 10,
    seed: int = 0,
    setup: Throw = Throw(),  # noqa: B008 (frozen)
    shard: int = 0,
    shards: int = 1,
    device: str = "auto",
    batch: int = 0,
    progress: bool = True,
    engine: str | None = None,
    address: str | None = None,
    cpus: float = 1.0,
    gpus: float = 0.0,
) -> None:
    """Simulate the constitutive trajectories of Stage I: a spinning cube thrown into a box, for many materials.

    The set-up is NCLaw's; its three published materials are instance 0 of their families. A run that was interrupted goes on
    where it stopped when the same command is given again. On the CPU the files are equal byte for byte however they are sharded.

    Args:
        out: Folder to write: one .npy file per trajectory, plan.json at the start and index.json when all are there.
        families: Parameter ranges of each family (elastic, plasticine, sand): young and yield_stress in Pa (log-uniform),
            poisson and friction_angle in degrees (uniform).
        instances: Training instances of each family.
        held_out: Further instances of each family that are never trained on.
        seed: Seed of the parameters; each trajectory's depend on the seed, its family and its number alone.
        setup: The cube, its throw, the box and the substeps.
        shard: Which share of the trajectories to simulate, counted from 0.
        shards: Number of shares; trajectory i belongs to share i mod shards.
        device: auto, cpu or cuda.
        batch: Trajectories simulated in one launch; 0 chooses 1 on the CPU and 10 on a GPU.
        progress: Show a progress bar.
        engine: Run all shards as tasks: local (processes of this machine) or ray (a cluster that sees the folder; extra scale). Absent:
            only this shard, in this process.
        address: Ray cluster: HOST:PORT, ray://HOST:PORT or auto. Absent: RAY_ADDRESS, else a cluster of this machine alone.
        cpus: Cores for each task.
        gpus: GPUs for each task, or a fraction of one; 0: it runs on the CPU.

    Raises:
        UserError: An impossible material, a reversed range, a step above the stability limit, a folder that holds another set-up.
    """
    check_writable(Path(out))
    options = {
        "families": families,
        "instances": instances,
        "held_out": held_out,
        "seed": seed,
        "setup": setup,
        "device": device,
        "batch": batch,
    }
    if engine is None:
        make_trajectories(out, shard=shard, shards=shards, progress=progress, **options)
    else:
        from neuido.commands.engines.shards import run_shards

        options |= {"out": str(Path(out).absolute()), "progress": False}
        run_shards(
            make_trajectories,
            options,
            shard=shard,
            shards=shards,
            engine=engine,
            address=address,
            share=Share(cpus, gpus),
            progress=progress,
        )
    print("\n".join(_summary(Path(out))))
    print(f"results in {out}: `neuido fit --config stage1 --data.root {out}` learns from them")


def _summary(folder: Path) -> list[str]:
    """Return what a folder of trajectories holds; of one that other shards still write only how much."""
    from neuido.data.files.parsing import read_json

    index = folder / "index.json"
    entries = read_json(index if index.is_file() else folder / "plan.json")["trajectories"]
    if not index.is_file():
        there = sum((folder / f"{entry['name']}.npy").is_file() for entry in entries)
        return [f"{there} of {len(entries)} trajectories are there; index.json comes with the last"]
    setup = read_json(index)["setup"]
    counts = Counter(entry["family"] for entry in entries)
    held, frames = sum(entry["split"] == "held_out" for entry in entries), setup["steps"] // setup["record_every"]
    stress = sorted(entry["stress_rms"] for entry in entries)
    return [
        f"{len(entries)} trajectories ({', '.join(f'{n} {family}' for family, n in counts.items())}), {held} of them held out: "
        f"{frames} frames {1e3 * setup['dt'] * setup['record_every']:g} ms apart, {setup['particles_per_side'] ** 3} particles",
        f"Kirchhoff stress, RMS: {stress[0]:.3g} to {stress[-1]:.3g} Pa",
    ]
