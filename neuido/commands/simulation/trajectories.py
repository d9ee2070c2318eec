"""The `trajectories` command: the training data of Stage I. `--help` loads no torch."""

from pathlib import Path

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

    Raises:
        UserError: An impossible material, a reversed range, a step above the stability limit, a folder that holds another set-up.
    """
    check_writable(Path(out))
    make_trajectories(
        out,
        families=families,
        instances=instances,
        held_out=held_out,
        seed=seed,
        setup=setup,
        shard=shard,
        shards=shards,
        device=device,
        batch=batch,
        progress=progress,
    )
    print(f"results in {out}")
