"""Every reader of the package with a sample of what it reads."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch
import yaml

from neuido.commands.cli.checkpoint_options import check_checkpoint, numbers_of
from neuido.commands.cli.sweep_file import command_of, read_sweep, runs_of
from neuido.data.bodies.scene_files import load_scene
from neuido.data.clips import FORMAT as CLIPS
from neuido.data.clips import FilmDataModule, FlowWindows
from neuido.data.files.html_page import video
from neuido.data.files.results import figures, logged_curves, open_runs, scenes_of
from neuido.data.files.score_tables import read_rows
from neuido.data.files.sweep_run import FORMAT as SWEEP_RUN
from neuido.data.formats.neuma import read_assets
from neuido.data.formats.ply import read_ply_vertices
from neuido.data.importers.importing import import_file
from neuido.data.measured.columns import errors_of
from neuido.data.measured.experiment import read_declared_model, read_experiment
from neuido.data.measured.material_test import read_material_tests
from neuido.data.measured.track import read_tracks
from neuido.data.scenes.filmed_scene import (
    Motion,
    Placement,
    SceneSetting,
    load_views,
    read_body,
    read_motion,
    read_setting,
    read_truth,
    write_motion,
    write_setting,
)
from neuido.data.scenes.readers import read_recording as read_views
from neuido.data.trajectories.trajectory_files import FORMAT as TRAJECTORIES
from neuido.data.trajectories.trajectory_module import TrajectoryDataModule
from neuido.discrepancy.problems.declared_model import read_model_file
from neuido.discrepancy.report.diagnosis import Diagnosis
from neuido.models.baselines.nclaw import load_nclaw
from neuido.models.fewshot.method import read_tensors, write_tensors
from neuido.models.inference.law_file import load_law, save_law
from neuido.models.inference.outputs import write_video
from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
from neuido.models.render.gaussians import attach_gaussians, load_gaussians, save_gaussians
from neuido.models.video.encoder import DynamicsEncoder
from neuido.models.video.flow_vae import FlowVAE
from tests.data import samples
from tests.data.footage import drawn
from tests.data.formats.ply_samples import write_ply
from tests.data.importers import test_importing as exports
from tests.data.importers import test_pandas_hdf5 as hdf5
from tests.data.importers.fields import test_fields as fields
from tests.faults.fuzzing import Reader

SAMPLE = samples.Sample()
ROOT = Path(__file__).parents[2]
TEST = {
    "format": "neuido-material-test/1",
    "name": "rubber",
    "model": {
        "density": 1100.0,
        "elasticity": {"law": "neo_hookean", "young": 1e6, "poisson": 0.499},
        "plasticity": {"law": "identity"},
        "free": ["young"],
        "incompressible": True,
    },
    "tests": [
        {"name": "pull", "file": "pull.csv", "mode": "uniaxial", "columns": {"stretch": "a", "nominal_stress": "b"}, "role": "fit"},
        {"name": "timed", "file": "timed.csv", "mode": "uniaxial", "columns": {"time": "t", "stretch": "a", "nominal_stress": "b"},
         "role": "held_out", "scale": {"nominal_stress": 1e6}, "rows": [0, 8]},
    ],
}  # fmt: skip
TRACKS = {
    "format": "neuido-track/1",
    "name": "ball",
    "model": {"gravity": [0.0, -9.81, 0.0], "effects": {"drag_quadratic": 0.01}, "free": []},
    "bodies": {"ball": {"mass": 0.1, "diameter": 0.07}},
    "recordings": [
        {"name": "drop", "body": "ball", "file": "drop.csv", "columns": {"t": "t", "y": "y"}, "role": "fit"},
        {"name": "throw", "body": "ball", "file": "throw.csv", "columns": {"t": "t", "x": "x", "y": "y"}, "role": "held_out",
         "scale": {"x": 0.001}, "spin": [0.0, 0.0, 10.0], "noise": 0.001},
    ],
}  # fmt: skip


def sample(write: Callable[..., object]) -> Callable[[Path], object]:
    """Return a function that writes the common sample in a layout into a folder."""
    return lambda folder: write(folder, SAMPLE)


def _test(folder: Path) -> None:
    (folder / "test.yaml").write_text(yaml.safe_dump(TEST, sort_keys=False))
    (folder / "pull.csv").write_text("# made\na,b\n-,Pa\n" + "".join(f"{1 + 0.05 * i},{1e4 * i}\n" for i in range(9)))
    (folder / "timed.csv").write_text("t;a;b\n" + "".join(f"{i};1,{i};{i / 10}\n".replace(".", ",") for i in range(9)))


def _tracks(folder: Path) -> None:
    (folder / "track.yaml").write_text(yaml.safe_dump(TRACKS, sort_keys=False))
    (folder / "drop.csv").write_text("t,y\n" + "".join(f"{0.1 * i:.3f},{2 - 0.0491 * i * i:.5f}\n" for i in range(7)))
    rows = (f"{0.1 * i:.3f}\t{300 * i}\t{1 + 0.4 * i - 0.0491 * i * i:.5f}\n" for i in range(9))
    (folder / "throw.csv").write_text("t\tx\ty\n" + "".join(rows))


def _scene(folder: Path) -> None:
    shutil.copy(ROOT / "configs" / "scenes" / "nclaw-cube.yaml", folder / "scene.yaml")


def _read_scene(folder: Path) -> object:
    return load_scene(folder / "scene.yaml")


def _particles(folder: Path) -> None:
    content = yaml.safe_load((ROOT / "configs" / "scenes" / "nclaw-cube.yaml").read_text())
    (folder / "scene.yaml").write_text(yaml.safe_dump(content | {"body": {"particles": "body.npz"}}))
    grid = np.stack(np.meshgrid(*[np.linspace(0.4, 0.6, 4)] * 3, indexing="ij"), -1).reshape(-1, 3).astype(np.float32)
    np.savez(folder / "body.npz", x=grid, v=np.zeros_like(grid))


def _read_particles(folder: Path) -> object:
    return load_scene(folder / "scene.yaml", folder)


def _model(folder: Path) -> None:
    model = {"density": 1000.0, "elasticity": {"law": "fixed_corotated", "young": 1e5, "poisson": 0.3}, "plasticity": {"law": "identity"},
             "free": ["young"], "effects": {"drag_quadratic": {"k": 0.1}}}  # fmt: skip
    (folder / "model.yaml").write_text(yaml.safe_dump({"model": model}))


def _read_model(folder: Path) -> object:
    content = read_model_file(str(folder / "model.yaml"))
    with errors_of(folder / "model.yaml"):
        return read_declared_model(content)


def _views(folder: Path) -> object:
    return read_views(folder, frame_interval=0.02)


def _images(folder: Path) -> None:
    """A recording with images of several kinds, small ones."""
    samples.nerfstudio(folder, samples.Sample(frame_count=1))
    content = json.loads((folder / "transforms.json").read_text())
    image = SAMPLE.images[1, 0, ..., :3]
    cv2.imwrite(str(folder / "images" / "1_000.jpg"), image)
    cv2.imwrite(str(folder / "images" / "2_000.tiff"), image.astype(np.uint16) * 256)
    content["frames"][1]["file_path"], content["frames"][2]["file_path"] = "images/1_000.jpg", "images/2_000.tiff"
    for frame in content["frames"]:
        frame["mask_path"] = f"masks/{frame['view']}.png"
    for v, bits in ((0, 255), (1, 1), (2, 255)):
        samples.png(folder / f"masks/{v}.png", (SAMPLE.images[v, 0, ..., 3] > 0).astype(np.uint8) * bits)
    (folder / "transforms.json").write_text(json.dumps(content))
    for name in ("1_000.png", "2_000.png"):
        (folder / "images" / name).unlink()


def _read_images(folder: Path) -> object:
    return load_views(folder, workers=1)


def _gaussians(folder: Path) -> None:
    x = torch.rand(12, 3, generator=torch.Generator().manual_seed(0))
    save_gaussians(folder / "gaussians.ply", attach_gaussians(x, torch.full((12,), 1e-3)))
    content = (folder / "gaussians.ply").read_bytes()
    (folder / "commented.ply").write_bytes(content.replace(b"end_header", "comment é\nend_header".encode()))
    vertices = read_ply_vertices(folder / "gaussians.ply")
    write_ply(folder / "text.ply", vertices, form="text", faces=[[0, 1, 2], [3, 2, 1, 0]])
    write_ply(folder / "faces.ply", vertices, form="big", faces=[[0, 1, 2]])


def _read_gaussians(folder: Path) -> object:
    return [load_gaussians(path, device="cpu") for path in sorted(folder.glob("*.ply"))]


def _assets(folder: Path) -> None:
    generator = torch.Generator().manual_seed(0)
    x = torch.rand(6, 3, generator=generator)
    torch.save({"init_x": x, "init_v": torch.zeros(3)}, folder / "init.pt")
    weights = torch.rand(4, 6, generator=generator).to_sparse().coalesce()
    parts = {"bindings_ind": weights.indices(), "bindings_val": weights.values(), "bindings_size": weights.size()}
    torch.save(parts, folder / "bindings.pt")
    np.savez(folder / "particles.npz", p_x=x.numpy(), vol=np.float32(1e-5))


def _importer(name: str, make, file: str, count: int = 10_000, **options) -> Reader:
    def read(folder: Path) -> object:
        return import_file(folder / file, None, **options)

    return Reader(f"import-{name}", make, file, read, count)


def _deeplabcut(folder: Path) -> None:
    flight = exports.FLIGHT
    rows = np.stack([200 * flight[:, 0], 1080 - 200 * flight[:, 1], np.full(31, 0.99)], 1)
    head = ["scorer,net,net,net", "bodyparts,ball,ball,ball", "coords,x,y,likelihood"]
    exports.write(folder / "dlc.csv", [*head, *(f"{i},{row}" for i, row in enumerate(exports.table(*rows.T)))])


def _body(folder: Path) -> None:
    grid = np.stack(np.meshgrid(*[np.linspace(0.4, 0.6, 3)] * 3, indexing="ij"), -1).reshape(-1, 3)
    lines = [f"{t},{i},{x},{y - 4.905 * t * t},{z}" for t in exports.T[:5] for i, (x, y, z) in enumerate(grid)]
    exports.write(folder / "particles.csv", ["t,id,x,y,z", *lines])


def _hdf5(folder: Path) -> None:
    hdf5.table(folder / "dlc.h5")


def _forces(folder: Path) -> None:
    fields.rows(folder / "forces.csv", ["Time (s)", "Force (N)"], np.arange(7) + 2.0, fields.STRESS * 20e-6)


def _field(folder: Path) -> None:
    fields.vic2d(folder)
    _forces(folder)


def _ncorr(folder: Path) -> None:
    fields.ncorr(folder)
    _forces(folder)


def _read_field(folder: Path) -> object:
    files = sorted(folder.glob("strip*")) or [folder / "strip.mat"]
    return import_file(files, None, kind="field", specimen=fields.SPECIMEN, forces=str(folder / "forces.csv"))


def _throw(folder: Path) -> None:
    drawn.throw(folder / "throw.mp4", count=6, size=(64, 48), x0=(1.0, 1.0))


def _read_throw(folder: Path) -> object:
    return import_file(folder / "throw.mp4", None, scale=drawn.SCALE)


def _trajectories(folder: Path) -> None:
    setup = {"wall_inset": 3, "steps": 8, "record_every": 4, "particles_per_side": 2}
    entries = []
    for i, split in enumerate(("train", "held_out")):
        np.save(folder / f"elastic-{i}.npy", np.ones((2, 8, 27), np.float32))
        entries.append({"name": f"elastic-{i}", "family": "elastic", "split": split, "parameters": {"young": 1e5, "poisson": 0.3},
                        "stress_rms": 1.0, "residual_rms": 0.1})  # fmt: skip
    (folder / "index.json").write_text(json.dumps({"format": TRAJECTORIES, "setup": setup, "trajectories": entries}))


def _read_trajectories(folder: Path) -> object:
    module = TrajectoryDataModule(str(folder))
    return module.names, module.families, module.parameters, module.stress_rms, module.residual_rms, module.instance_names


def _clips(folder: Path) -> None:
    rng = np.random.default_rng(0)
    entries = [{"name": f"clip-{i}", "family": "elastic", "parameters": {"young": 1e5, "poisson": 0.3}} for i in range(2)]
    for entry in entries:
        law = {key: rng.random((4, 3, 3), np.float32) for key in ("trial", "corrected", "stress")}
        np.savez(folder / f"{entry['name']}.npz", flow=np.zeros((2, 4, 8, 8, 2), np.float16), cell=np.ones(2, np.float32),
                 frame_interval=np.float32(0.02), **law)  # fmt: skip
    (folder / "index.json").write_text(json.dumps({"format": CLIPS, "clips": entries}))


def _read_clips(folder: Path) -> object:
    module = FilmDataModule(str(folder))
    paths = [folder / f"{clip['name']}.npz" for clip in module.clips]
    return [module.read(i) for i in range(len(module.clips))], module.training_count, FlowWindows(paths, 4, 1, 0)[0]


def _runs(folder: Path) -> None:
    (folder / "version_0").mkdir()
    (folder / "version_0" / "metrics.csv").write_text("epoch,step,loss\n0,1,2.5\n0,2,\n,3,1.5\n")
    (folder / "scores.csv").write_text("scene,cd,psnr,stage,floor\nball,1.5,30,before,1\nball,1.2,31,after,1\n")
    (folder / "ball" / "after").mkdir(parents=True)
    (folder / "ball" / "after" / "particles.csv").write_text("frame,time,cd\n0,0,0\n1,0.02,1.5\n")


def _read_runs(folder: Path) -> object:
    entries = open_runs([str(folder)])
    rows = [entry.by_frame(scene) for scene in scenes_of(entries) for entry in entries]
    return [figures(own, "cd") for own in rows], [logged_curves(entry.root) for entry in entries]


def _sweep_runs(folder: Path) -> None:
    for i in range(2):
        run = folder / f"lr-{i}"
        run.mkdir()
        (run / "run.json").write_text(
            json.dumps({"format": SWEEP_RUN, "status": "done", "parameters": {"model.lr": 0.1 * i}, "seconds": 3.5})
        )
        (run / "metrics.csv").write_text("epoch,step,loss\n0,1,2.5\n0,2,1.5\n")


def _sweep(folder: Path) -> None:
    content = {
        "program": "neuido",
        "method": "grid",
        "metric": {"name": "loss", "goal": "minimize"},
        "command": ["${env}", "${program}", "fit", "--config", "configs/stage1.yaml", "${args}"],
        "parameters": {"model": {"parameters": {"lr": {"values": [1e-3, 1e-4]}, "width": {"min": 1, "max": 4}}}, "seed": {"value": 1}},
        "run_cap": 5,
    }
    (folder / "sweep.yaml").write_text(yaml.safe_dump(content, sort_keys=False))


def _read_sweep(folder: Path) -> object:
    sweep = read_sweep(folder / "sweep.yaml")
    return [command_of(sweep, run, {}) for run in runs_of(sweep, count=3)]


def _setting(folder: Path) -> None:
    own = folder.parent / "experiment-of-setting"
    samples.experiment(own, SAMPLE)
    found = read_experiment(own)
    shutil.rmtree(own)
    model = {key: found.model[key] for key in ("density", "elasticity", "plasticity")}
    write_setting(SceneSetting("cube", found.scene, 1000.0, model, Placement()), folder / "scene.yaml")
    write_motion(Motion((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.5, 0.5, 0.5)), folder)
    arrays = samples.particles(SAMPLE, track=True)
    np.savez(folder / "body.npz", **{key: arrays[key] for key in ("x0", "v0", "volume")})
    x = np.tile(arrays["x0"], (4, 1, 1))
    np.savez(folder / "truth.npz", x=x, x0=x[0], volume=arrays["volume"], times=SAMPLE.times)
    (folder / "truth.yaml").write_text(yaml.safe_dump({"format": "neuido-truth/1", "law": model}))


def _read_setting(folder: Path) -> object:
    return read_setting(folder / "scene.yaml"), read_motion(folder), read_body(folder / "body.npz"), read_truth(folder)


def _diagnosis(folder: Path) -> None:
    shutil.copy(ROOT / "tests" / "discrepancy" / "report" / "diagnosis-1" / "diagnosis.json", folder)


def _read_diagnosis(folder: Path) -> object:
    found = Diagnosis.read(folder)
    return found.name, found.bodies, found.answer, found.effects, found.error, found.line, found.summary(), repr(found)


def _operator(folder: Path) -> None:
    torch.manual_seed(0)
    operator = IntrinsicDynamicsOperator(latent_dim=4, hidden_dim=8, head_dim=4, basis_dim=3)
    operator.set_latents(torch.zeros(2, 4), ["a", "b"], ["elastic", "elastic"])
    operator.save(folder / "operator.safetensors", {"stage": "I"})


def _read_operator(folder: Path) -> object:
    return IntrinsicDynamicsOperator.load(folder / "operator.safetensors")


def _law(folder: Path) -> None:
    torch.manual_seed(0)
    operator = IntrinsicDynamicsOperator(latent_dim=4, hidden_dim=8, head_dim=4, basis_dim=3)
    save_law(folder / "law.safetensors", operator, torch.zeros(4))


def _read_law(folder: Path) -> object:
    return load_law(folder / "law.safetensors")


def _encoder(folder: Path) -> None:
    torch.manual_seed(0)
    DynamicsEncoder(FlowVAE(width=8), latent_dim=4, width=6, heads=2).save(folder / "encoder.safetensors")


def _read_encoder(folder: Path) -> object:
    return DynamicsEncoder.load(folder / "encoder.safetensors")


def _fit(folder: Path) -> None:
    write_tensors(folder / "start.safetensors", {"twist": torch.zeros(2, 3)})


def _read_fit(folder: Path) -> object:
    return read_tensors(folder / "start.safetensors")


def _checkpoint(folder: Path) -> None:
    content = {"hyper_parameters": {"lr": 0.1, "_class_path": "neuido.PretrainTask", "save_to": "x"}, "state_dict": {"w": torch.zeros(2)}}
    torch.save(content, folder / "last.ckpt")


def _read_checkpoint(folder: Path) -> object:
    check_checkpoint(str(folder / "last.ckpt"))
    if (folder / "last.ckpt").is_dir():  # of a distributed strategy; Lightning reads it
        return None
    return numbers_of(str(folder / "last.ckpt"), "neuido.PretrainTask")


def _nclaw(folder: Path) -> None:
    rng = np.random.default_rng(0)
    arrays = {
        f"{part}.{name}.weight": rng.random(shape, np.float32)
        for part in ("elasticity", "plasticity")
        for name, shape in (("layers.0", (64, 13)), ("layers.1", (64, 64)), ("final_layer", (9, 64)))
    }
    np.savez(folder / "nclaw.npz", **arrays)


def _read_nclaw(folder: Path) -> object:
    return load_nclaw(folder / "nclaw.npz")


def _video(folder: Path) -> None:
    write_video(folder / "film.mp4", torch.rand(4, 16, 24, 3, generator=torch.Generator().manual_seed(0)))


def _read_video(folder: Path) -> object:
    return video(folder / "film.mp4", "film", width=32)


def _table(folder: Path) -> None:
    (folder / "paper.csv").write_text("run,scene,cd,psnr\nNeuMA,ball,1.5,30\nours,ball,,31\n")


def _read_table(folder: Path) -> object:
    return read_rows(folder / "paper.csv")


GROUPS = {
    "measured": (
        Reader("experiment", sample(samples.experiment), "experiment.yaml", read_experiment, 2_000),
        Reader("experiment-arrays", sample(samples.experiment), "*/particles.npz", read_experiment, 2_000),
        Reader("material-test", _test, "test.yaml", read_material_tests),
        Reader("material-test-table", _test, "*.csv", read_material_tests),
        Reader("track", _tracks, "track.yaml", read_tracks),
        Reader("track-table", _tracks, "*.csv", read_tracks),
        Reader("scene", _scene, "scene.yaml", _read_scene),
        Reader("scene-particles", _particles, "body.npz", _read_particles),
        Reader("model", _model, "model.yaml", _read_model),
    ),
    "recordings": (
        Reader("nerfstudio", sample(samples.nerfstudio), "*.json", _views),
        Reader("blender", sample(samples.blender), "*.json", _views),
        Reader("neuma-synthetic", sample(samples.neuma_synthetic), "*.json", _views),
        Reader("neuma-real", sample(samples.neuma_real), "**/*.[jb][si][on]*", _views),
        Reader("pacnerf", sample(samples.pacnerf), "*.json", _views),
        Reader("springgaus-synthetic", sample(samples.springgaus_synthetic), "*.json", _views),
        Reader("springgaus-real", sample(samples.springgaus_real), "**/*.[jb][si][on]*", _views),
        Reader("colmap", sample(samples.colmap), "**/*.bin", _views),
        Reader("images", _images, "*/*.*", _read_images),
        Reader("gaussians", _gaussians, "*.ply", _read_gaussians),
        Reader("neuma-assets", _assets, "*.*", read_assets),
    ),
    "imports": (
        _importer("instron", exports.instron, "instron.csv"),
        _importer("zwick", exports.zwick, "zwick.txt"),
        _importer("trios", exports.trios, "trios.txt"),
        _importer("excel", exports.excel, "sheet.xlsx", 2_000),
        _importer("tracker", exports.tracker, "tracker.txt"),
        _importer("plain", exports.millimetres, "plain.csv"),
        _importer("optitrack", exports.optitrack, "optitrack.csv"),
        _importer("vicon", exports.vicon, "vicon.csv"),
        _importer("trc", exports.trc, "ball.trc"),
        _importer("deeplabcut", _deeplabcut, "dlc.csv", scale=0.005, y_down=True, frame_rate=30.0),
        _importer("c3d", exports.c3d, "ball.c3d"),
        _importer("deeplabcut-hdf5", _hdf5, "dlc.h5", 2_000, point="ball", scale=0.005, frame_rate=30.0),
        Reader("import-field", _field, "strip-1_0.csv", _read_field, 400, 10),
        Reader("import-ncorr", _ncorr, "strip.mat", _read_field, 2_000),
        Reader("import-film", _throw, "throw.mp4", _read_throw, 300, 3),
        _importer("body", _body, "particles.csv", density=1000.0, young=5e4, floor=0.0),
    ),
    "results": (
        Reader("trajectories", _trajectories, "*.*", _read_trajectories),
        Reader("clips", _clips, "*.*", _read_clips),
        Reader("runs", _runs, "**/*.csv", _read_runs),
        Reader("sweep-runs", _sweep_runs, "*/*.*", _read_runs),
        Reader("sweep", _sweep, "sweep.yaml", _read_sweep),
        Reader("setting", _setting, "*.*", _read_setting),
        Reader("diagnosis", _diagnosis, "diagnosis.json", _read_diagnosis),
        Reader("operator", _operator, "*.safetensors", _read_operator),
        Reader("law", _law, "*.safetensors", _read_law),
        Reader("encoder", _encoder, "*.safetensors", _read_encoder, 2_000, 20),
        Reader("fit", _fit, "*.safetensors", _read_fit),
        Reader("checkpoint", _checkpoint, "*.ckpt", _read_checkpoint),
        Reader("nclaw", _nclaw, "*.npz", _read_nclaw),
        Reader("video", _video, "*.mp4", _read_video),
        Reader("table", _table, "*.csv", _read_table),
    ),
}
READERS = {reader.name: reader for group in GROUPS.values() for reader in group}
