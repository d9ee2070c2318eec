"""The `film` command: signature and help alone, so that `--help` loads no torch."""

from pathlib import Path

from neuido.commands.engines.outcome import Share
from neuido.data.trajectories.options import FAMILIES, Range


def film(
    out: str,
    *,
    count: int = 1000,
    families: dict[str, dict[str, Range]] = FAMILIES,
    views: int = 2,
    frames: int = 80,
    frame_steps: int = 5,
    dts: list[float] = [1e-3, 5e-4],  # noqa: B006 (read only)
    cells: int = 32,
    particles: int = 8000,
    width: int = 192,
    flow_size: int = 64,
    flow_preset: str = "medium",
    samples: int = 256,
    seed: int = 0,
    rates: list[float] | None = None,
    shapes: str = "seen",
    published: bool = False,
    held_out: float = 0.0,
    speeds: list[float] = [0.5, 3.0],  # noqa: B006 (read only)
    device: str = "auto",
    batch: int = 0,
    shard: int = 0,
    shards: int = 1,
    progress: bool = True,
    engine: str | None = None,
    address: str | None = None,
    cpus: float = 1.0,
    gpus: float = 0.0,
) -> None:
    """Film simulated bodies of many materials, as training data for the flow VAE and for the warm-up of the projector.

    In each clip, a body of random shape, velocity and texture falls onto a floor, with a classical law of random parameters. The clip is
    rendered from random directions and stored as optical flow, with samples of the law. An interrupted run continues if the same command
    is repeated.

    Args:
        out: Output folder: one .npz file per clip, plan.json at the start, and index.json when all clips are complete.
        count: Number of clips; the material families alternate.
        families: Parameter ranges of each family, as for `neuido trajectories`.
        views: Number of random views of each clip.
        frames: Number of frames of a clip.
        frame_steps: Number of substeps between frames.
        dts: Times of a substep to draw from, s; a clip that is too stiff for its own uses the smallest.
        cells: Grid cells along the unit cube.
        particles: Approximate number of particles of a body.
        width: Width of the images from which the flow is computed, px.
        flow_size: Side of the stored flow, px.
        flow_preset: Preset of the DIS optical flow: ultrafast, fast or medium.
        samples: Number of samples of the law of a clip.
        seed: Seed; a clip depends on the seed and its number only.
        rates: Smallest and largest frame rate to draw from, 1/s, in place of frame_steps; a substep is then at most the largest of dts.
            Absent: frame_steps substeps from frame to frame.
        shapes: Group of shapes of the bodies: seen, held-out or unseen; no two groups share a shape.
        published: Use the ten bodies of the literature too; their particles lie in NEUIDO_DATA.
        held_out: Fraction of the clips, the last ones, whose bodies have the shapes held-out while the others' are seen.
        speeds: Smallest and largest downward speed of a throw, m/s. A body shows how it differs from others where it strains.
        device: auto, cpu or cuda.
        batch: Clips simulated in one launch; 0: 1 on the CPU and 16 on a GPU.
        shard: Number of the shard to film, from 0; shards may be filmed at the same time into one folder.
        shards: Number of shards.
        progress: Show a progress bar.
        engine: Run all shards as tasks: local (processes of this machine) or ray (a cluster that sees the folder; extra scale). Absent:
            only this shard, in this process.
        address: Ray cluster: HOST:PORT, ray://HOST:PORT or auto. Absent: RAY_ADDRESS, else a cluster of this machine alone.
        cpus: Cores for each task.
        gpus: GPUs for each task, or a fraction of one; 0: it runs on the CPU.

    Raises:
        UserError: A parameter range is invalid, the substep is above the stability limit, or the folder holds clips of other options.
    """
    from neuido.models.video.clip_generation import ClipPlan, generate_clips

    plan = ClipPlan(
        count=count,
        families={family: {name: (low, high) for name, (low, high) in ranges.items()} for family, ranges in families.items()},
        views=views,
        frames=frames,
        frame_steps=frame_steps,
        dts=tuple(dts),
        cells=cells,
        particles=particles,
        width=width,
        flow_size=flow_size,
        flow_preset=flow_preset,
        samples=samples,
        seed=seed,
        rates=None if rates is None else tuple(rates),  # type: ignore[arg-type]
        shapes=shapes,
        published=published,
        held_out=held_out,
        speeds=tuple(speeds),  # type: ignore[arg-type]
    )
    if engine is None:
        generate_clips(plan, out, device=device, batch=batch, shard=shard, shards=shards, progress=progress)
    else:
        from neuido.commands.engines.shards import run_shards

        options = {"plan": plan, "out": str(Path(out).absolute()), "device": device, "batch": batch, "progress": False}
        run_shards(
            generate_clips,
            options,
            shard=shard,
            shards=shards,
            engine=engine,
            address=address,
            share=Share(cpus, gpus),
            progress=progress,
        )
    there = sum((Path(out) / f"clip-{i:05d}.npz").is_file() for i in range(count))
    print(
        f"{there} of {count} clips are there: {views} views, {frames} frames, flow of {flow_size} x {flow_size} px; {', '.join(families)}"
    )
    print(f"results in {out}: `neuido fit --config flow_vae --data.root {out}` learns from them")
