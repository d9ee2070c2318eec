"""The demonstration's visual half: small filmed scenes, reconstruction, Stage II, the law of an unseen body, and its adaptation."""

import csv
from pathlib import Path
from typing import Any, NamedTuple

TRAINING, UNSEEN = ("elastic-0", "elastic-4"), ("elastic-9",)
RECONSTRUCTION: dict[str, Any] = {"steps": 120, "start": 1000, "gaussians": 1500, "particles": 700, "resolution": 32}


class SceneResult(NamedTuple):
    """Zero-shot figures of one scene."""

    name: str
    unseen: bool
    scores: dict[str, float]
    """cd and floor (times 1e4, unit cube), rmse [m], psnr [dB], ssim, and their crops, on held-out views; those that there are."""
    seconds: float
    """Inference, from flow latents to the law [s]."""
    picture: Path
    """Recorded frames above predicted ones, from a view that was held out."""
    video: Path


class Adapted(NamedTuple):
    """Few-shot adaptation of the unseen scene: scores on the view that was held out, before and after."""

    name: str
    before: dict[str, float]
    """As `SceneResult.scores`."""
    after: dict[str, float]
    steps: int
    seconds: float
    """Of the steps [s]."""
    picture: Path


class VideoResult(NamedTuple):
    """What the demonstration shows."""

    scenes: tuple[SceneResult, ...]
    losses: tuple[float, ...]
    """Stage II's image loss at each step that saw whole recordings; 1 explains nothing of the motion."""
    encoder: Path
    """The encoder after Stage II."""
    adapted: Adapted | None = None


def demo_video(
    out: str = "runs/demo/video", *, epochs: int = 8, init_from: str | None = "pretrained-small", adaptation_steps: int = 25
) -> VideoResult:
    """Train the video encoder on two filmed bodies, and read the law of a third from its video.

    Films three small bodies, trains Stage II on two of them, predicts the law of the third in one pass, and then adapts this law to the
    images of the third. Takes minutes on a CPU core. Scenes and reconstructions in the folder are used again.

    Args:
        out: Folder for scenes, training run and results.
        epochs: Epochs of Stage II, two steps each.
        init_from: Weights of the encoder at the start. None: the projector starts untrained.
        adaptation_steps: Steps of the adaptation to the third body.

    Returns:
        The scores and pictures of each scene, and the losses of the training.
    """
    import yaml

    from neuido.commands.cli.config_files import find_config
    from neuido.commands.cli.trainer import run_lightning
    from neuido.commands.reconstruct import reconstruct
    from neuido.data.scenes.film_options import Film
    from neuido.data.scenes.synthetic import make_scenes
    from neuido.models.render.splatting import rasterize

    folder = Path(out)
    settings = yaml.safe_load(Path(find_config("scenes/ten_small")).read_text())
    chosen = [scene for scene in settings["scenes"] if scene["name"] in (*TRAINING, *UNSEEN)]
    print("[video 1/5] filming three small bodies", flush=True)
    film: dict[str, Any] = {key: tuple(value) if isinstance(value, list) else value for key, value in settings["film"].items()}
    make_scenes(chosen, Film(**film), folder / "scenes", draw=rasterize, device="cpu")
    print("[video 2/5] reconstructing them from their first frame", flush=True)
    for name in (*TRAINING, *UNSEEN):
        reconstruct(str(folder / "scenes" / name), device="cpu", **RECONSTRUCTION)
    print("[video 3/5] Stage II: learning from the images of two", flush=True)
    encoder, results = folder / "encoder.safetensors", folder / "results"
    data = ["--data.root", str(folder / "scenes"), "--data.scenes", _listed(TRAINING), "--data.unseen", _listed(UNSEEN)]
    common = ["--config", find_config("stage2_small"), *data, "--model.cache", str(folder / "flow"), "--model.out", str(results)]
    common += ["--trainer.default_root_dir", str(folder), "--trainer.logger.init_args.save_dir", str(folder)]
    common += ["--trainer.log_every_n_steps", "1"]
    start = ["--model.init_from", init_from or "null", "--model.save_to", str(encoder)]
    length = ["--trainer.max_epochs", str(epochs), "--trainer.limit_val_batches", "0"]
    fitted = run_lightning(["fit", *common, *start, *length])
    assert fitted.trainer.log_dir is not None  # the configuration has a logger that writes CSV
    with (Path(fitted.trainer.log_dir) / "metrics.csv").open() as file:
        steps = [row for row in csv.DictReader(file) if row.get("train/loss")]
    most = max((float(row["train/frames"]) for row in steps), default=0.0)  # the curriculum begins with fewer
    losses = tuple(float(row["train/loss"]) for row in steps if float(row["train/frames"]) == most)
    print("[video 4/5] zero-shot: the law of each video in one pass", flush=True)
    trained = ["--model.init_from", str(encoder), "--model.baselines", "0"]
    run_lightning(["predict", *common, *trained])
    run_lightning(["test", *common, *trained])
    with (results / "scores.csv").open() as file:
        scenes = tuple(_result(row, results) for row in csv.DictReader(file))
    for scene in scenes:
        print(f"{scene.name}: law in {1e3 * scene.seconds:.1f} ms from its flow latents{' (unseen)' if scene.unseen else ''}")
    print("[video 5/5] few-shot: the law of the unseen one, adapted to its images", flush=True)
    return VideoResult(scenes, losses, encoder, _adapt(folder, encoder, adaptation_steps))


def _adapt(folder: Path, encoder: Path, steps: int) -> Adapted:
    from neuido.commands.cli.config_files import find_config
    from neuido.commands.cli.trainer import run_lightning

    results = folder / "adapted"
    common = ["--config", find_config("adapt_small"), "--data.root", str(folder / "scenes"), "--data.scenes", _listed(UNSEEN)]
    common += ["--model.method.init_args.init_from", str(encoder), "--model.cache", str(folder / "flow"), "--model.out", str(results)]
    common += ["--trainer.default_root_dir", str(folder), "--trainer.logger.init_args.save_dir", str(folder)]
    run_lightning(["fit", *common, "--model.steps", str(steps)])
    run_lightning(["predict", *common, "--model.adapter", str(results)])
    with (results / "scores.csv").open() as file:
        before, after = csv.DictReader(file)
    first, last = _scores(before), _scores(after)
    picture = results / after["scene"] / "prediction.png"
    print(f"{after['scene']}: held-out PSNR {first['psnr']:.2f} dB before, {last['psnr']:.2f} dB after {after['steps']} steps")
    return Adapted(after["scene"], first, last, int(after["steps"]), float(after["seconds"]), picture)


def _listed(names: tuple[str, ...]) -> str:
    return f"[{', '.join(names)}]"


def _result(row: dict[str, str], results: Path) -> SceneResult:
    folder = results / row["scene"]
    picture, video = folder / "prediction.png", folder / "prediction.mp4"
    return SceneResult(row["scene"], row["unseen"] == "1", _scores(row), float(row["seconds"]), picture, video)


def _scores(row: dict[str, str]) -> dict[str, float]:
    words = ("scene", "method", "stage", "unseen", "seconds", "failed")
    return {name: float(value) for name, value in row.items() if value and name not in words}
