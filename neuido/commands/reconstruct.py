"""The `reconstruct` command: images of a body's first frame become Gaussians and a body full of particles. `--help` loads no torch."""

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from neuido.data.files.writing import write_arrays
from neuido.errors import UserError

if TYPE_CHECKING:
    from torch import Tensor

    from neuido.data.scenes.filmed_scene import SceneSetting, Truth
    from neuido.models.reconstruct.gaussian_fit import ReconstructModule
    from neuido.types import Body, Gaussians, MultiViewBatch, Vector

RESUME, SETUP, REPORT = "resume.ckpt", "setup.json", "report.json"


def reconstruct(
    folder: str,
    *,
    out: str | None = None,
    recording: str | None = None,
    setting: str | None = None,
    scale: float = 1.0,
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0),
    up: str = "y",
    velocity: tuple[float, float, float] | None = None,
    angular_velocity: tuple[float, float, float] | None = None,
    width: int | None = None,
    frame_interval: float | None = None,
    steps: int = 2000,
    start: int = 5000,
    gaussians: int = 25000,
    views: int = 4,
    lr: float = 1.0,
    resolution: int = 96,
    particles: int = 25000,
    spacing: float | None = None,
    filling: str = "voxel",
    save_every: int = 500,
    seed: int = 0,
    device: str = "auto",
    progress: bool = True,
) -> None:
    """Reconstruct a filmed body: Gaussians of its first frame, and particles that fill it.

    The Gaussians start on the visual hull of the masks and are optimised on the images of the views that are not held out, with
    densification; the particles fill the volume that they enclose. Images without masks need a plain background, whose colour then
    says what the object is. A run that was interrupted goes on where it stopped when the same command is given again.

    Args:
        folder: An experiment's folder, or any recording of several views (Nerfstudio's transforms.json, NeuMA, ...).
        out: Folder to write; `reconstruction` in the folder where absent.
        recording: Which recording of an experiment with several.
        setting: For a recording that is no experiment: YAML with the domain, gravity, colliders, grid, step and material, laid out like
            the scene.yaml that this command writes; a unit cube with a rough floor and 1000 kg/m^3 where absent.
        scale: From the recording's unit of length to metres: x -> scale R x + shift.
        shift: From the recording's origin to the domain's, m.
        up: Which axis of the recording points upwards, y, -y, z or -z; R turns it to +y.
        velocity: Velocity of the body at t = 0, m/s; that of motion.yaml or particles.npz in the folder where absent, else zero.
        angular_velocity: Angular velocity about its centre at t = 0, rad/s; likewise.
        width: Width to which images are reduced, px.
        frame_interval: Seconds from one frame to the next, where the recording has no times.
        steps: Optimiser steps.
        start: Gaussians at the start.
        gaussians: Most Gaussians.
        views: Views of a step.
        lr: Factor on all learning rates.
        resolution: Grid cells along the body, for hull and filling.
        particles: About how many particles.
        spacing: Or their distance, m, which takes precedence.
        filling: voxel (a jittered lattice) or poisson (Poisson disks).
        save_every: Steps between checkpoints.
        seed: Of all that is drawn.
        device: auto, cpu or cuda.
        progress: Show a progress bar.

    Raises:
        UserError: What readers refuse, masks that do not meet, or a folder that holds another reconstruction.
    """
    options = dict(locals())

    import torch

    from neuido.data.files.output_folder import claimed_folder
    from neuido.data.files.writing import check_writable, write_json
    from neuido.data.scenes.filmed_scene import RECONSTRUCTION, load_views, read_truth, write_setting
    from neuido.physics.runtime.device import choose_device
    from neuido.types import Gaussians

    source = Path(folder).expanduser()
    target = Path(out).expanduser() if out is not None else source / RECONSTRUCTION
    check_writable(target)
    chosen = choose_device(device)
    around = _setting(source, setting, recording, scale, shift, up)
    batch = load_views(source, placing=around.placing, recording=recording, frame_interval=frame_interval, frame_count=1, width=width)
    batch = batch._replace(cameras=batch.cameras.at(0))
    if (trained := int((~batch.held_out).sum())) < 2:
        raise UserError(f"{source} has {trained} views to train on; a reconstruction needs at least two")
    plan = {key: value for key, value in options.items() if key not in ("out", "device", "progress", "save_every", "folder")}
    if out is not None:
        plan["source"] = str(source.resolve())
    with claimed_folder(target, plan, "a reconstruction with other options", file=SETUP):
        if (target / REPORT).is_file():
            _tell(target)
            return
        torch.manual_seed(seed)
        module = _optimise(batch, around, target, chosen, options)
        with torch.no_grad():
            found = Gaussians(*(part.detach() for part in module.gaussians()[:4]))
            body = _fill(found, module, batch, around, source, options)
            figures = _score(module, batch) | _compare(body, found, read_truth(source) if source.is_dir() else None)
        _write(target, found, body)
        _draw(target / "comparison.png", module, batch, body)
        write_setting(around, target / "scene.yaml")
        figures |= {"gaussians": len(found.means), "particles": len(body.x), "volume": float(body.volume.double().sum())}
        report = {key: float(f"{value:.5g}") for key, value in figures.items()}
        write_json(target / REPORT, report)
        (target / RESUME).unlink(missing_ok=True)
        _tell(target)


def _tell(target: Path) -> None:
    """Print the figures of a reconstruction and where its files are."""
    from neuido.data.files.parsing import read_json

    found = read_json(target / REPORT)
    print(f"{found['gaussians']:.0f} Gaussians, {found['particles']:.0f} particles that fill {found['volume']:.4g} m^3")
    for key, words in (("train", "views that it was fitted to"), ("held_out", "views that were held out")):
        if f"psnr_{key}" in found:
            figures = (found[f"psnr_{key}"], found[f"psnr_{key}_object"], found[f"ssim_{key}"])
            print("{}: PSNR {:.2f} dB ({:.2f} dB on the body), SSIM {:.4f}".format(words, *figures))
    if "volume_error" in found:
        print(
            f"against the truth: volume {100 * found['volume_error']:+.1f} %, Chamfer distance {found['chamfer_1e4']:.3g}e-4 "
            f"(other particles of the true body: {found['chamfer_floor_1e4']:.3g}e-4)"
        )
    print(f"results in {target}: gaussians.ply, body.npz, scene.yaml, all figures in report.json; look at comparison.png")


def _setting(source: Path, file: str | None, recording: str | None, scale: float, shift: "Vector", up: str) -> "SceneSetting":
    from neuido.data.scenes.filmed_scene import Placement, SceneSetting, read_setting
    from neuido.data.scenes.multiview import UP
    from neuido.data.scenes.synthetic import JELLY
    from neuido.types import Scene, Walls

    if up not in UP or not scale > 0:
        raise UserError(f"up = {up!r} must be one of {', '.join(UP)}, and scale = {scale} positive")
    x, y, z = shift
    placing = Placement(scale, (x, y, z), up)
    if (source / "experiment.yaml").is_file() and file is None:
        if placing != Placement():
            raise UserError("scale, shift and up are not for experiments: their files are in metres")
        return read_setting(source / "experiment.yaml", recording=recording)
    if file is not None:
        found = read_setting(Path(file).expanduser())
        return found if placing == Placement() else found._replace(placing=placing)
    scene = Scene(cells=32, dt=5e-4, walls=Walls("separate", float("inf")))
    return SceneSetting(source.resolve().name, scene, JELLY["density"], dict(JELLY), placing)


def _optimise(batch: "MultiViewBatch", around: "SceneSetting", target: Path, device: Any, options: dict[str, Any]) -> "ReconstructModule":
    from lightning.pytorch import LightningDataModule, Trainer
    from lightning.pytorch.callbacks import ModelCheckpoint, TQDMProgressBar
    from lightning.pytorch.loggers import CSVLogger

    from neuido.commands.cli.console import quiet_lightning
    from neuido.commands.cli.interruption import stop_at_step
    from neuido.commands.cli.plain_progress import needs_plain_lines, plain_progress
    from neuido.models.reconstruct.gaussian_fit import ReconstructModule

    class Views(LightningDataModule):
        def __init__(self) -> None:
            super().__init__()
            self.batch = _select(batch, ~batch.held_out)

        def train_dataloader(self) -> range:
            return range(steps)

    quiet_lightning()
    warnings.filterwarnings("ignore", message=r"Checkpoint directory .* exists and is not empty")  # it is the folder of the results
    warnings.filterwarnings("ignore", message=r".*your dataloader is not resumable")  # a step's views follow from its number
    steps = options["steps"]
    sizes = {key: options[key] for key in ("steps", "views", "lr", "resolution", "seed")}
    counts = {
        "initial_gaussians": options["start"],
        "max_gaussians": max(options["gaussians"], options["start"]),
        "densify_every": max(1, min(100, steps // 12)),
    }
    module = ReconstructModule(around.scene.lower, around.scene.upper, **sizes, **counts)
    saved = ModelCheckpoint(
        target, Path(RESUME).stem, every_n_train_steps=options["save_every"], save_top_k=1, enable_version_counter=False
    )
    bars = [plain_progress() if needs_plain_lines({}) else TQDMProgressBar(refresh_rate=20)] if options["progress"] else []
    trainer = Trainer(
        accelerator="gpu" if device.type == "cuda" else "cpu",
        devices=1,
        max_steps=steps,
        max_epochs=-1,
        callbacks=[stop_at_step(target / RESUME), saved, *bars],
        logger=CSVLogger(target, name="log"),
        log_every_n_steps=max(1, min(20, steps // 20)),
        enable_progress_bar=options["progress"],
        enable_model_summary=False,
        num_sanity_val_steps=0,
    )
    resume = target / RESUME
    trainer.fit(module, Views(), ckpt_path=resume if resume.is_file() else None, weights_only=True)
    if trainer.interrupted:
        raise KeyboardInterrupt
    return module.to(device).eval()


def _select(batch: "MultiViewBatch", chosen: "Tensor") -> "MultiViewBatch":
    from neuido.data.cameras import select

    parts = {name: getattr(batch, name)[chosen] for name in ("images", "masks", "held_out")}
    return batch._replace(cameras=select(batch.cameras, chosen.nonzero().squeeze(1).tolist()), **parts)


def _fill(
    found: "Gaussians", module: "ReconstructModule", batch: "MultiViewBatch", around: "SceneSetting", source: Path, options: dict[str, Any]
) -> "Body":
    import torch

    from neuido.models.reconstruct.filling import fill, opacity_volume
    from neuido.types import Body

    assert module.hull is not None
    volume = opacity_volume(found, spacing=module.hull.spacing, hull=module.hull)
    number = {"spacing": options["spacing"]} if options["spacing"] is not None else {"count": options["particles"]}
    x, share = fill(volume, method=options["filling"], seed=options["seed"], **number)
    outside = ((x < torch.tensor(around.scene.lower)) | (x > torch.tensor(around.scene.upper))).any(1)
    return Body(x[~outside], _velocity(x[~outside], source, options), share[~outside])


def _velocity(x: "Tensor", source: Path, options: dict[str, Any]) -> "Tensor":
    """Of the options, else of motion.yaml, else of the nearest particle that the recording has, else zero."""
    import torch

    from neuido.data.bodies.shapes import rigid_velocity
    from neuido.data.scenes.filmed_scene import Motion, read_motion
    from neuido.data.scenes.readers import read_recording

    motion = read_motion(source) if source.is_dir() else None
    if options["velocity"] is not None or options["angular_velocity"] is not None:
        still = (0.0, 0.0, 0.0)
        motion = Motion(options["velocity"] or still, options["angular_velocity"] or still)
    known = None if motion is not None else read_recording(source, recording=options["recording"]).body
    if known is not None:
        from scipy.spatial import KDTree

        return known.v[torch.from_numpy(KDTree(known.x.numpy()).query(x.numpy())[1])]
    if motion is None:
        print("the velocity at t = 0 is not known: taken as zero; give --velocity")
        motion = Motion()
    centre = motion.centre or tuple(x.mean(0).tolist())
    return rigid_velocity(x, centre=centre, velocity=motion.velocity, angular_velocity=motion.angular_velocity)


def _score(module: "ReconstructModule", batch: "MultiViewBatch") -> dict[str, float]:
    """PSNR [dB] and SSIM of the first frame, on views that were trained on and on those that were not."""
    import torch
    from torchmetrics.functional.image import structural_similarity_index_measure

    figures = {}
    for name, chosen in (("train", ~batch.held_out), ("held_out", batch.held_out)):
        if not bool(chosen.any()):
            continue
        part = _select(batch, chosen)
        images = _render(module, part)
        square = (images - part.images[:, 0]).square()
        near = torch.nn.functional.max_pool2d(part.masks[:, :1, :, :], 9, 1, 4)[:, 0, ..., None] > 0.5  # the object and a rim of 4 px
        figures[f"psnr_{name}"] = float(-10 * square.mean().log10())
        figures[f"psnr_{name}_object"] = float(-10 * square[near.expand_as(square)].mean().log10())
        both = (images.permute(0, 3, 1, 2), part.images[:, 0].permute(0, 3, 1, 2))
        similarity = cast("Tensor", structural_similarity_index_measure(*both, data_range=1.0))  # a pair only with an image of it
        figures[f"ssim_{name}"] = float(similarity)
    return figures


def _render(module: "ReconstructModule", batch: "MultiViewBatch") -> "Tensor":
    """Images (V, H, W, 3) on the CPU."""
    import torch

    cameras = batch.cameras._replace(viewmats=batch.cameras.viewmats.to(module.device), Ks=batch.cameras.Ks.to(module.device))
    with torch.no_grad():
        return module.render(cameras, batch.background.to(module.device))[0].clamp(0, 1).cpu()


def _compare(body: "Body", found: "Gaussians", truth: "Truth | None") -> dict[str, float]:
    """How the Gaussians hang on the particles, and how the body compares with the truth."""
    from neuido.models.render.gaussians import bind
    from neuido.models.scoring.metrics import chamfer_distance, resampling_floor

    held = (bind(found, body.x).weight > 0).sum(1)
    figures = {"particles_per_gaussian": float(held.float().mean()), "bound_to_nearest_alone": float((held == 1).float().mean())}
    if truth is None:
        return figures
    figures["volume_error"] = float(body.volume.double().sum() / truth.volume.double().sum() - 1)
    figures["chamfer_1e4"] = 1e4 * float(chamfer_distance(body.x, truth.x0))
    return figures | {"chamfer_floor_1e4": 1e4 * float(resampling_floor(truth.x0))}


def _write(target: Path, found: "Gaussians", body: "Body") -> None:
    from neuido.models.render.gaussians import save_gaussians

    save_gaussians(target / "gaussians.ply", found)
    arrays = {"x0": body.x.numpy(), "v0": body.v.numpy(), "volume": body.volume.numpy()}
    write_arrays(target / "body.npz", arrays, compressed=False)


def _draw(path: Path, module: "ReconstructModule", batch: "MultiViewBatch", body: "Body", side: int = 320) -> None:
    """For up to three views, held-out ones first: recorded, rendered, their difference times four, the particles."""
    import cv2
    import numpy as np

    from neuido.data.cameras import project
    from neuido.data.formats.nerfstudio import write_image

    order = sorted(range(len(batch.images)), key=lambda v: not bool(batch.held_out[v]))[:3]
    images = _render(module, batch)
    pixels, depths = project(body.x, batch.cameras)
    height, width = batch.images.shape[2:4]
    size = (side, round(side * height / width))
    rows = []
    for v in order:
        truth = batch.images[v, 0]
        cells = [truth, images[v], 1 - (4 * (images[v] - truth).abs()).clamp(0, 1)]
        row = [cv2.resize((255 * cell.numpy()).round().astype(np.uint8), size, interpolation=cv2.INTER_AREA) for cell in cells]
        dots = np.full((size[1], size[0], 3), 255, np.uint8)
        near, far = depths[v].aminmax()
        shades = (40 + 180 * ((depths[v] - near) / (far - near + 1e-9)).double()).int()
        centres = (pixels[v] * size[0] / width).round().int()
        far_first = depths[v].argsort(descending=True)
        for (x, y), shade in zip(centres[far_first].tolist(), shades[far_first].tolist()):
            cv2.circle(dots, (x, y), 2, (shade, shade, 220), -1)
        rows.append(np.concatenate([*row, dots], 1))
    write_image(path, np.concatenate(rows, 0))
