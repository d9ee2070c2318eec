"""The `film` command: signature and help alone, so that `--help` loads no torch."""

from pathlib import Path

from neuido.data.files.writing import check_writable
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
    device: str = "auto",
    batch: int = 0,
    shard: int = 0,
    shards: int = 1,
    progress: bool = True,
) -> None:
    """Film simulated bodies of many materials: training data of the flow VAE and of the projector's warm-up.

    Each clip is a body of a random built-in shape, with a random velocity and texture, that falls onto a floor under a classical law with
    random parameters; it is rendered from random directions, and kept as optical flow, with samples of its law. An interrupted run goes on
    where it stopped when the same command is given again.

    Args:
        out: Folder to write: one .npz file a clip, plan.json at the start and index.json when all are there.
        count: Number of clips; the families take turns.
        families: Parameter ranges, as `neuido trajectories` takes them.
        views: Random views of each clip.
        frames: Frames of a clip.
        frame_steps: Substeps from one frame to the next.
        dts: Substeps to draw from, s; a clip too stiff for its own takes the smallest.
        cells: Grid cells along the unit cube.
        particles: Particles of a body, about.
        width: Width of the images of which the flow is taken, px.
        flow_size: Side of the flow that is kept, px.
        flow_preset: Of DIS: ultrafast, fast, medium.
        samples: Samples of a clip's law.
        seed: Seed; each clip depends on the seed and its number alone.
        device: auto, cpu or cuda.
        batch: Clips simulated in one launch; 0 chooses 1 on the CPU and 16 on a GPU.
        shard: Number of this part of the clips, from 0; parts may be filmed side by side, into one folder.
        shards: Number of parts.
        progress: Show a progress bar.

    Raises:
        UserError: An impossible material, a step above the stability limit, a folder that holds another set-up.
    """
    from neuido.models.video.clip_generation import ClipPlan, generate_clips

    plan = ClipPlan(
        count=count,
        families={family: {name: tuple(bounds) for name, bounds in ranges.items()} for family, ranges in families.items()},
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
    )
    check_writable(Path(out))
    generate_clips(plan, out, device=device, batch=batch, shard=shard, shards=shards, progress=progress)
    there = sum((Path(out) / f"clip-{i:05d}.npz").is_file() for i in range(count))
    print(
        f"{there} of {count} clips are there: {views} views, {frames} frames, flow of {flow_size} x {flow_size} px; {', '.join(families)}"
    )
    print(f"results in {out}: `neuido fit --config flow_vae --data.root {out}` learns from them")
