"""Every command of the command line, with a small sample of what it reads and words that run within a second or two."""

import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import yaml

from neuido.commands.main import main
from tests.discrepancy import made
from tests.faults.readers import READERS

SCENE = """
format: neuido-scene/1
name: little-ball
scene:
  domain: [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]
  gravity: [0.0, -9.8, 0.0]
  walls: {contact: separate, friction: 0.3, inset: 0.0}
model:
  density: 1000.0
  elasticity: {law: fixed_corotated, young: 3.0e+4, poisson: 0.2}
body: {shape: ball, centre: [0.5, 0.5, 0.5], radius: 0.12, spacing: 0.06, velocity: [0.0, -2.0, 0.0]}
discretisation: {grid: 12, dt: 1.0e-3}
steps: 12
"""
FILM = {"views": 3, "held_out": [2], "width": 24, "height": 24, "frames": 3, "substeps": 4, "density": 1}


class Target(NamedTuple):
    """A command with its words, run in a folder that has the sample in `in`; it writes `out`, if anything."""

    name: str
    words: tuple[str, ...]
    make: Callable[[Path], object]
    """Writes the sample into a new folder."""
    files: str = "**/*.*"
    """Pattern of the files that are damaged, relative to the sample."""
    acts: bool = False
    """Whether it starts processes or makes connections."""
    quick: bool = False
    """Whether the fast tier has it: an input costs less than a tenth of a second."""

    @property
    def command(self) -> str:
        return self.words[0]


def _reader(name: str) -> tuple[Callable[[Path], object], str]:
    return READERS[name].make, READERS[name].files


def _scene(folder: Path) -> None:
    (folder / "scene.yaml").write_text(SCENE)


def _empty(folder: Path) -> None:
    """Write nothing: the command reads no files."""


def _write(folder: Path, name: str, content: object) -> None:
    (folder / name).write_text(yaml.safe_dump(content, sort_keys=False))


def _laws(folder: Path) -> None:
    _scene(folder)
    READERS["law"].make(folder)


def _scenes(folder: Path) -> None:
    entry = yaml.safe_load(SCENE)
    entry = {"name": "Ball", **{key: entry[key] for key in ("scene", "model", "body", "discretisation")}}
    _write(folder, "scenes.yaml", {"scenes": [entry], "film": FILM, "device": "cpu"})


def _made(write: Callable[[Path], object]) -> Callable[[Path], object]:
    """Return a maker of a folder that must not be there yet."""

    def make(folder: Path) -> None:
        folder.rmdir()
        write(folder)

    return make


def _experiment(folder: Path) -> None:
    made.experiment(folder, {"drag_linear.k": 3.0}, frames=5, side=4)


def _filmed(folder: Path) -> None:
    _scenes(folder)
    _run(["scenes", "--config", str(folder / "scenes.yaml"), "--out", str(folder / "all"), "--progress", "false"])
    for path in (folder / "all" / "Ball").iterdir():
        path.rename(folder / path.name)
    shutil.rmtree(folder / "all")
    (folder / "scenes.yaml").unlink()


def _reconstructed(folder: Path) -> None:
    """Write a reconstructed scene `Ball` and a configuration of `predict`."""
    own = folder / "Ball"
    own.mkdir()
    _filmed(own)
    small = ["--steps", "2", "--start", "30", "--gaussians", "40", "--particles", "60", "--views", "1", "--resolution", "8"]
    _run(["reconstruct", str(own), *small, "--device", "cpu", "--progress", "false"])
    model = {"class_path": "AlignModule", "init_args": {"operator": "pretrained", "init_from": "pretrained-small", "out": "out"}}
    data = {"class_path": "VisualDataModule", "init_args": {"root": "in", "scenes": ["Ball"]}}
    trainer = {"accelerator": "cpu", "logger": False, "enable_checkpointing": False, "use_distributed_sampler": False}
    _write(folder, "config.yaml", {"model": model, "data": data, "trainer": trainer})


def _run(words: list[str]) -> None:
    try:
        main(words)
    except SystemExit as stop:
        if stop.code:
            raise RuntimeError(f"{words} ends with {stop.code}") from stop


def _learning(folder: Path) -> None:
    """Write two trajectories and a configuration of Stage I."""
    READERS["trajectories"].make(folder)
    for path in folder.glob("*.npy"):
        np.save(path, np.tile(np.eye(3, dtype=np.float32).reshape(9), (2, 8, 3)))
    sizes = {"latent_dim": 4, "basis_dim": 3, "hidden_dim": 8, "head_dim": 4, "instance_steps": 1, "save_to": "out/operator.safetensors"}
    logger = {"class_path": "lightning.pytorch.loggers.CSVLogger", "init_args": {"save_dir": "out", "name": "log"}}
    trainer = {"max_epochs": 1, "accelerator": "cpu", "enable_model_summary": False, "num_sanity_val_steps": 0, "logger": logger}
    data = {"class_path": "TrajectoryDataModule", "init_args": {"root": "in", "batch_size": 16}}
    model = {"class_path": "PretrainModule", "init_args": sizes}
    _write(folder, "config.yaml", {"seed_everything": 0, "model": model, "data": data, "trainer": trainer})


def _learned(folder: Path) -> None:
    """Write the same with a checkpoint of an epoch."""
    _learning(folder)
    content = yaml.safe_load((folder / "config.yaml").read_text())
    content["trainer"] |= {"callbacks": [{"class_path": "lightning.pytorch.callbacks.ModelCheckpoint", "init_args": {"save_last": True}}]}
    content["data"]["init_args"]["root"] = str(folder)
    with tempfile.TemporaryDirectory() as out:
        text = yaml.safe_dump(content).replace("out", out).replace("held_" + out, "held_out")
        (folder / "first.yaml").write_text(text)
        _run(["fit", "--config", str(folder / "first.yaml")])
        shutil.copy(next(Path(out).rglob("*.ckpt")), folder / "last.ckpt")
    (folder / "first.yaml").unlink()


def _sweep(folder: Path) -> None:
    parameters = {"a": {"values": [1, 2]}, "b": {"value": "x"}}
    _write(folder, "sweep.yaml", {"method": "grid", "program": "true", "command": ["true", "${args}"], "parameters": parameters})


def _runs(folder: Path) -> None:
    READERS["runs"].make(folder)
    READERS["video"].make(folder / "ball" / "after")
    (folder / "ball" / "after" / "film.mp4").rename(folder / "ball" / "after" / "prediction.mp4")


def _operator(folder: Path) -> None:
    from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator

    torch.manual_seed(0)
    operator = IntrinsicDynamicsOperator(latent_dim=4, hidden_dim=8, head_dim=4, basis_dim=3)
    names = [f"{family}-{i}" for family in ("elastic", "sand") for i in range(8)]
    operator.set_latents(torch.randn(16, 4), names, [name.partition("-")[0] for name in names])
    operator.save(folder / "operator.safetensors", {"stage": "I"})


SMALL = ("--device", "cpu", "--progress", "false")
OUT = ("--out", "out")
THROW = ("--setup.particles_per_side", "3", "--setup.steps", "8", "--setup.record_every", "4", "--setup.cells", "10")
CLIP = ("--count", "1", "--views", "1", "--frames", "6", "--frame_steps", "2", "--cells", "12", "--particles", "60", "--width", "24",
        "--flow_size", "16", "--samples", "4")  # fmt: skip
SHOTS = ("--steps", "2", "--start", "30", "--gaussians", "40", "--particles", "60", "--views", "1", "--resolution", "8")
SEARCH = ("--draws", "19", "--minutes", "0.02")

TARGETS = (
    Target("simulate", ("simulate", "in/scene.yaml", *OUT, "--every", "4", *SMALL), _scene, quick=True),
    Target("simulate-particles", ("simulate", "in/scene.yaml", *OUT, "--steps", "4", "--data_root", "in", *SMALL),
           READERS["scene-particles"].make),
    Target("simulate-law", ("simulate", "in/scene.yaml", *OUT, "--law", "in/law.safetensors", *SMALL), _laws),
    Target("trajectories", ("trajectories", *OUT, "--instances", "1", "--held_out", "0", *THROW, *SMALL), _empty, quick=True),
    Target("scenes", ("scenes", "--config", "in/scenes.yaml", *OUT, "--progress", "false"), _scenes),
    Target("undeclared-track", ("undeclared", *OUT, "--seed", "3", "--measured", "track", *SMALL), _empty, quick=True),
    Target("undeclared-test", ("undeclared", *OUT, "--seed", "3", "--measured", "material_test", *SMALL), _empty),
    Target("undeclared-body", ("undeclared", *OUT, "--seed", "3", "--kind", "drag_linear", "--solver", "same", "--particles", "100",
                               "--seconds", "0.1", "--separation", "40", *SMALL), _empty),
    Target("replay", ("replay", "in", *OUT, *SMALL), _made(_experiment)),
    Target("reconstruct", ("reconstruct", "in", *OUT, *SHOTS, *SMALL), _filmed),
    Target("reconstruct-own", ("reconstruct", "in", *OUT, "--frame_interval", "0.02", *SHOTS, *SMALL), READERS["nerfstudio"].make),
    Target("check-experiment", ("check", "in"), READERS["experiment"].make, quick=True),
    Target("check-test", ("check", "in"), READERS["material-test"].make, quick=True),
    Target("check-track", ("check", "in"), READERS["track"].make, quick=True),
    Target("diagnose-track", ("diagnose", "in", *OUT, "--effects", "drag_linear,drag_quadratic", *SEARCH, *SMALL), _made(made.track)),
    Target("diagnose-test", ("diagnose", "in", *OUT, "--effects", "strain_stiffening,yield", *SEARCH, *SMALL), _made(made.material_test)),
    Target("diagnose-experiment", ("diagnose", "in", *OUT, "--effects", "drag_linear", "--solver", "material_points", *SEARCH, *SMALL),
           _made(_experiment)),
    Target("report-runs", ("report", "in", "--out", "out/report.html"), _runs),
    Target("report-diagnosis", ("report", "in", "--out", "out/report.html"), READERS["diagnosis"].make, quick=True),
    Target("report-sweep", ("report", "in", "--out", "out/report.html"), READERS["sweep-runs"].make),
    Target("sweep", ("sweep", "in/sweep.yaml", *OUT), _sweep, acts=True),
    Target("latents", ("latents", "--operator", "in/operator.safetensors", *OUT, "--parts", "[space]", "--perplexity", "3", "--device",
                       "cpu"), _operator),
    Target("film", ("film", *OUT, *CLIP, *SMALL), _empty),
    Target("fit", ("fit", "--config", "in/config.yaml"), _learning),
    Target("fit-resumed", ("fit", "--config", "in/config.yaml", "--ckpt_path", "in/last.ckpt", "--trainer.max_epochs", "2"), _learned,
           "*.[cy][ka][pm]*"),
    Target("test", ("test", "--config", "in/config.yaml", "--ckpt_path", "in/last.ckpt"), _learned, "*.ckpt"),
    Target("validate", ("validate", "--config", "in/config.yaml"), _learning, "config.yaml"),
    Target("predict", ("predict", "--config", "in/config.yaml"), _reconstructed),
    Target("fit-help", ("fit", "--config", "in/config.yaml", "--help"), _learning, "config.yaml"),
    Target("print-config", ("trajectories", *OUT, *THROW, "--print_config"), _empty, quick=True),
    Target("completion", ("--print_completion", "bash"), _empty),
    Target("doctor", ("doctor", "--data", "in"), _empty, acts=True),
    *(
        Target(name, ("import", f"in/{READERS[name].files}", *OUT, *words), READERS[name].make, quick=True)
        for name, words in {
            "import-instron": (), "import-zwick": (), "import-trios": (), "import-excel": (), "import-tracker": (),
            "import-optitrack": (), "import-vicon": (), "import-trc": (), "import-c3d": (),
            "import-deeplabcut": ("--scale", "0.005", "--y_down", "true", "--frame_rate", "30"),
            "import-body": ("--density", "1000", "--young", "5e4"),
        }.items()
    ),
)  # fmt: skip
