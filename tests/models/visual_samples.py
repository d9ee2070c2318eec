"""Tiny filmed bodies for the tests of Stage II, made in memory: a ball or box under a classical law, seen by three cameras."""

from collections.abc import Callable
from functools import cached_property
from pathlib import Path

import torch
from lightning.pytorch import LightningDataModule

from neuido.data.bodies.shapes import ball, box
from neuido.data.cameras import orbit
from neuido.data.scenes.filmed_scene import Truth, VisualScene
from neuido.data.scenes.filmed_scene_module import SequentialScenes, ShuffledScenes, ordered_loader
from neuido.models.render.gaussians import deform, harmonics_of, save_gaussians
from neuido.models.render.splatting import render
from neuido.physics.effects.parameters import Effects
from neuido.physics.laws.classical import material
from neuido.physics.mpm.simulator import Simulator
from neuido.types import Gaussians, MultiViewBatch, Scene, Walls


def tiny_scene(
    folder: Path,
    name: str = "tiny",
    *,
    young: float = 5e4,
    shape: str = "ball",
    spacing: float = 0.06,
    frames: int = 6,
    every: int = 15,
    width: int = 32,
    views: int = 3,
    velocity=(0.3, -2.0, 0.0),
    spin=(0.0, 0.0, -2.0),
    poisson: float = 0.25,
    dt: float = 2e-3,
    plasticity: dict | None = None,
    density: Callable[[torch.Tensor], torch.Tensor] | None = None,
) -> VisualScene:
    """The last view is held out. `density`: the true relative density at points (P, 3), of which the scene's body knows nothing."""
    scene = Scene(cells=16, dt=dt, walls=Walls(friction=float("inf")))
    options = {"spacing": spacing, "velocity": velocity, "angular_velocity": spin, "jitter": 0.5}
    if shape == "ball":
        body = ball(centre=(0.5, 0.24, 0.5), radius=0.19, **options)
    else:
        body = box(lower=(0.33, 0.05, 0.37), upper=(0.67, 0.30, 0.63), **options)
    law = {"density": 1000.0, "elasticity": {"law": "fixed_corotated", "young": young, "poisson": poisson},
           "plasticity": plasticity or {"law": "identity"}}  # fmt: skip
    if plasticity is not None:
        law["elasticity"]["law"] = "sigma"
    simulator = Simulator(scene, body, device="cpu")
    with torch.no_grad():
        effects = None if density is None else Effects(relative_density=density(body.x))
        laws = material(law["elasticity"], law["plasticity"])
        motion = simulator.rollout((frames - 1) * every, *laws, effects=effects, every=every)
    generator = torch.Generator().manual_seed(len(name) + int(young))
    waves = 25 * torch.randn(3, 3, generator=generator)
    colours = (0.5 + 0.4 * torch.sin(body.x @ waves)).clamp(0, 0.9)
    count = len(body.x)
    covariance = ((0.6 * spacing) ** 2 * torch.eye(3)).expand(count, 3, 3).contiguous()
    gaussians = Gaussians(body.x, covariance, torch.full((count,), 0.95), harmonics_of(colours))
    folder.mkdir(parents=True, exist_ok=True)
    save_gaussians(folder / f"{name}.ply", gaussians)
    cameras = orbit(views, target=(0.5, 0.3, 0.5), radius=2.2, angle=28.0, elevations=(12.0, 30.0), width=width, height=width)
    with torch.no_grad():
        images, alphas = render(deform(gaussians, motion.F, motion.x), cameras, background=torch.ones(3))
    times = torch.arange(frames, dtype=torch.float64) * every * dt
    held_out = torch.zeros(views, dtype=torch.bool)
    held_out[-1] = True
    batch = MultiViewBatch(
        0,
        name,
        images.transpose(0, 1).clamp(0, 1).contiguous(),
        alphas.transpose(0, 1).contiguous(),
        cameras,
        times,
        held_out,
        torch.ones(3),
    )
    truth = Truth(motion.x, body.x, body.volume, times, law)
    return VisualScene(name, scene, 1000.0, law, body, folder / f"{name}.ply", batch, truth)


class TinyScenes(LightningDataModule):
    """Scenes in memory, as `VisualDataModule` serves those of folders."""

    def __init__(self, folder: str, youngs: tuple[float, ...] = (4e4, 2e5), unseen: tuple[float, ...] = (), seed: int = 0):
        super().__init__()
        self.folder, self.youngs, self.unseen_youngs, self.seed = Path(folder), youngs, unseen, seed
        self.steps_in_a_row = None

    def __str__(self):
        return f"TinyScenes(youngs={self.youngs}, unseen={self.unseen_youngs})"

    @cached_property
    def scenes(self):
        own = slice(None)
        if self.trainer is not None and getattr(self.trainer.strategy, "scenes_apart", False):
            own = slice(self.trainer.global_rank, None, self.trainer.world_size)
        return [tiny_scene(self.folder, f"tiny-{i}", young=young) for i, young in list(enumerate(self.youngs))[own]]

    @cached_property
    def unseen(self):
        return [tiny_scene(self.folder, f"unseen-{i}", young=young, shape="box") for i, young in enumerate(self.unseen_youngs)]

    @property
    def unseen_names(self):
        return [scene.name for scene in self.unseen]

    def train_dataloader(self):
        if self.steps_in_a_row is not None:
            return SequentialScenes(self.scenes, steps=self.steps_in_a_row, total=len(self.youngs))
        return ShuffledScenes(self.scenes, seed=self.seed, **self._share())

    def val_dataloader(self):
        return ordered_loader(self.scenes, **self._share())

    def test_dataloader(self):
        return ordered_loader([*self.scenes, *self.unseen], **self._share())

    predict_dataloader = test_dataloader

    def transfer_batch_to_device(self, batch, device, dataloader_idx):
        return batch

    def _share(self):
        if self.trainer is None or getattr(self.trainer.strategy, "scenes_apart", False):
            return {}
        return {"rank": self.trainer.global_rank, "ranks": self.trainer.world_size}
