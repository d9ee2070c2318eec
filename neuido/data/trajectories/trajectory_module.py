"""Lightning data module of the Stage I samples (F_tr, F_hat, stress, trajectory) in balanced batches."""

import inspect
from dataclasses import fields
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import LightningDataModule
from torch import Tensor

from neuido.data.bodies.families import check_entry
from neuido.data.files.parsing import naming, read_json
from neuido.data.files.values import list_of_mappings, mapping, number, require_key
from neuido.data.sampling import FixedBatches, SampleOrder, Step, TrainingSteps
from neuido.data.trajectories.options import Throw, make_trajectories
from neuido.data.trajectories.trajectory_files import COLUMNS, FORMAT, TrajectoryFiles, is_complete, to_batch
from neuido.errors import UserError
from neuido.types import TrajectoryBatch

BLOCKS = 50
"""Number of blocks of time. Held-out steps are whole blocks, so the training set has hardly any sample one substep from a held-out one."""


class TrajectoryDataModule(LightningDataModule):
    """Lightning data module of the constitutive trajectories of Stage I (paper, "Training on constitutive trajectories").

    Training uses the training instances without held-out particles and steps. Validation and test use a fixed number of samples of the
    held-out particles and steps. `instance_batches` returns samples of the held-out instances: one half to fit a latent, the other half to
    score it.

    Args:
        root: Folder written by `neuido trajectories`.
        batch_size: Samples of a batch; each of the M trajectories gets batch_size // M. The paper uses 10^4.
        held_out_particles: Fraction of the particles that is held out; the same particles in every trajectory.
        held_out_steps: Fraction of the steps that is held out, in whole blocks of time.
        validation_samples: Held-out samples of each training trajectory that validation uses.
        instance_samples: Samples of each held-out instance in each half of `instance_batches`.
        seed: Seed of the split and of the order.
        preload: True: copy the training set to the device of the trainer, which is fast. False: read memory-mapped files. `auto`: copy it
            if it fits into half of the free GPU memory, or into 2 GiB on the CPU.
        num_workers: Number of worker processes that read if the training set is not preloaded.
        drop_last: Omit the last batch of an epoch if it is smaller than the others.
        generate: Options of `neuido trajectories` that generate a missing folder. None: a missing folder is an error.

    Attributes:
        trajectory_count, names, families, parameters: Of the training instances, in the order of the trajectory index.
        stress_rms, residual_rms: Root mean square of the Frobenius norm of the stress [Pa] and of F_hat - F_tr [-], (M,) float32.
        viscosity: Their `reference_viscosity` [Pa s], (M,) float32; zero where the files do not say.
        instance_names, instance_families, instance_parameters, instance_stress_rms, instance_residual_rms, instance_viscosity: The same
            of the held-out instances.
    """

    def __init__(
        self,
        root: str = "data/trajectories",
        *,
        batch_size: int = 10_000,
        held_out_particles: float = 0.1,
        held_out_steps: float = 0.1,
        validation_samples: int = 1000,
        instance_samples: int = 2000,
        seed: int = 0,
        preload: bool | str = "auto",
        num_workers: int = 0,
        drop_last: bool = False,
        generate: dict[str, Any] | None = None,
    ) -> None:
        super().__init__()
        for name, fraction in (("held_out_particles", held_out_particles), ("held_out_steps", held_out_steps)):
            if not 0 < fraction < 1:
                raise UserError(f"{name} must be a fraction between 0 and 1, got {fraction}")
        for name, count in (("batch_size", batch_size), ("validation_samples", validation_samples), ("instance_samples", instance_samples)):
            if count < 1:
                raise UserError(f"{name} must be at least 1, got {count}")
        if preload not in (True, False, "auto"):
            raise UserError(f"preload must be true, false or auto, got {preload!r}")
        throw = {field.name for field in fields(Throw)}
        unknown = set(generate or {}) - throw - set(inspect.signature(make_trajectories).parameters)
        unknown |= set((generate or {}).get("setup", {})) - throw
        if unknown:
            raise UserError(f"data.generate has the unknown option {sorted(unknown)[0]!r}: `neuido trajectories --help` lists them")
        self.root = Path(root)
        self.batch_size, self.seed, self.preload, self.num_workers, self.drop_last = batch_size, seed, preload, num_workers, drop_last
        self.held_out_particles, self.held_out_steps = held_out_particles, held_out_steps
        self.validation_samples, self.instance_samples = validation_samples, instance_samples
        self.generate = generate
        self._resident: Tensor | None = None

    # The content of index.json.

    @cached_property
    def index(self) -> dict[str, Any]:
        """The content of index.json.

        Raises:
            UserError: The folder is missing, incomplete or of another format.
        """
        if self.generate is not None:
            self.prepare_data()
        path = self.root / "index.json"
        command = f"neuido trajectories --config configs/trajectories.yaml --out {self.root}"
        if not path.is_file():
            state = "is incomplete" if (self.root / "plan.json").is_file() else "has no trajectories"
            raise UserError(f"data.root = {self.root} {state} (index.json is missing): generate them with `{command}`")
        content = read_json(path)
        if not isinstance(content, dict) or content.get("format") != FORMAT:
            content = content if isinstance(content, dict) else {}
            raise UserError(f"{path} has the format {content.get('format')!r}, not {FORMAT!r}: generate it again with `{command}`")
        with naming(path, "holds a value that cannot be used"):
            setup = mapping(require_key(content, "setup", "the file"), "setup")
            for key in ("steps", "record_every", "particles_per_side"):
                if not isinstance(setup.get(key), int) or not 0 < setup[key] < 1 << 31:
                    raise UserError(f"setup.{key} must be a positive whole number, got {setup.get(key)!r}")
        for i, entry in enumerate(list_of_mappings(require_key(content, "trajectories", str(path)), f"{path}: trajectories")):
            where = f"{path}: trajectories[{i}]"
            check_entry(entry, where)
            require_key(entry, "split", where)
            for key in ("stress_rms", "residual_rms"):
                number(require_key(entry, key, where), f"{where}.{key}", least=0.0)
            number(entry.get("viscosity", 0.0), f"{where}.viscosity", least=0.0)
            if not is_complete(self.root / f"{entry['name']}.npy", self._shape(content)):
                raise UserError(f"{self.root / entry['name']}.npy is missing or truncated: generate it again with `{command}`")
        return content

    @property
    def trajectory_count(self) -> int:
        return len(self._entries("train"))

    @property
    def names(self) -> list[str]:
        return [entry["name"] for entry in self._entries("train")]

    @property
    def families(self) -> list[str]:
        return [entry["family"] for entry in self._entries("train")]

    @property
    def parameters(self) -> list[dict[str, float]]:
        return [entry["parameters"] for entry in self._entries("train")]

    @property
    def stress_rms(self) -> Tensor:
        return torch.tensor([float(entry["stress_rms"]) for entry in self._entries("train")])

    @property
    def residual_rms(self) -> Tensor:
        return torch.tensor([float(entry["residual_rms"]) for entry in self._entries("train")])

    @property
    def viscosity(self) -> Tensor:
        return torch.tensor([float(entry.get("viscosity", 0.0)) for entry in self._entries("train")])

    @property
    def instance_names(self) -> list[str]:
        return [entry["name"] for entry in self._entries("held_out")]

    @property
    def instance_families(self) -> list[str]:
        return [entry["family"] for entry in self._entries("held_out")]

    @property
    def instance_parameters(self) -> list[dict[str, float]]:
        return [entry["parameters"] for entry in self._entries("held_out")]

    @property
    def instance_stress_rms(self) -> Tensor:
        return torch.tensor([float(entry["stress_rms"]) for entry in self._entries("held_out")])

    @property
    def instance_residual_rms(self) -> Tensor:
        return torch.tensor([float(entry["residual_rms"]) for entry in self._entries("held_out")])

    @property
    def instance_viscosity(self) -> Tensor:
        return torch.tensor([float(entry.get("viscosity", 0.0)) for entry in self._entries("held_out")])

    def _entries(self, part: str) -> list[dict[str, Any]]:
        return [entry for entry in self.index["trajectories"] if entry["split"] == part]

    @staticmethod
    def _shape(content: dict[str, Any]) -> tuple[int, int, int]:
        setup = content["setup"]
        return setup["steps"] // setup["record_every"], setup["particles_per_side"] ** 3, COLUMNS

    def _files(self, part: str) -> TrajectoryFiles:
        return TrajectoryFiles([self.root / f"{entry['name']}.npy" for entry in self._entries(part)])

    # The split.

    @cached_property
    def held_out(self) -> tuple[Tensor, Tensor]:
        """Boolean masks of the held-out steps (T,) and particles (P,), the same for all trajectories."""
        steps, particles, _ = self._shape(self.index)
        generator = torch.Generator().manual_seed(self.seed)
        blocks = min(BLOCKS, steps)
        chosen = torch.randperm(blocks, generator=generator)[: max(1, round(self.held_out_steps * blocks))]
        block = torch.arange(steps) * blocks // steps
        points = torch.zeros(particles, dtype=torch.bool)
        points[torch.randperm(particles, generator=generator)[: max(1, round(self.held_out_particles * particles))]] = True
        return torch.isin(block, chosen), points

    def rows(self, part: str) -> Tensor:
        """Return the row numbers t P + p of a part of a trajectory: `train`, or the held-out `particles` or `steps`."""
        late, points = (m for m in self.held_out)
        masks = {
            "train": ~late[:, None] & ~points,
            "particles": points.expand(len(late), -1),
            "steps": late[:, None] & ~points,
        }
        return masks[part].flatten().nonzero().squeeze(1)

    # Lightning's hooks.

    def prepare_data(self) -> None:
        if self.generate is not None and not (self.root / "index.json").is_file():
            make_trajectories(str(self.root), **self.generate)

    def setup(self, stage: str | None = None) -> None:
        samples = self.batch_size // self.trajectory_count
        if samples == 0:
            raise UserError(
                f"batch_size = {self.batch_size} gives less than one sample to each of {self.trajectory_count} trajectories: raise it"
            )
        self.files = self._files("train")
        self.order = SampleOrder(self.rows("train"), self.trajectory_count, samples, seed=self.seed, drop_last=self.drop_last)

    def train_dataloader(self) -> TrainingSteps:
        trainer = self.trainer
        rank, ranks = (trainer.global_rank, trainer.world_size) if trainer is not None else (0, 1)
        resident = trainer is not None and self._preload(trainer.strategy.root_device)
        return TrainingSteps(self.order, None if resident else self.gather, workers=self.num_workers, rank=rank, ranks=ranks)

    def val_dataloader(self) -> FixedBatches:
        return self._validation

    def test_dataloader(self) -> FixedBatches:
        return self._validation

    def on_after_batch_transfer(self, batch: Any, dataloader_idx: int) -> Any:
        if not isinstance(batch, Step):
            return batch
        if self._resident is None:
            raise RuntimeError("a Step was loaded, but the training set is not on the device")
        rows = self.order(*batch, self._resident.device)
        rows = rows + self._resident.shape[1] * torch.arange(len(rows), device=rows.device)[:, None]
        picked = self._resident.view(-1, self._resident.shape[-1]).index_select(0, rows.view(-1))
        return to_batch(picked.view(*rows.shape, -1))

    def teardown(self, stage: str) -> None:
        self._resident = None

    # Samples.

    def gather(self, epoch: int, step: int) -> TrajectoryBatch:
        """Read the training batch of a step from the files: M n samples sorted by trajectory."""
        return self.files.gather(self.order(epoch, step, torch.device("cpu")))

    def instance_batches(self) -> tuple[TrajectoryBatch, TrajectoryBatch]:
        """Draw samples of the held-out instances: one batch to fit latents, one batch to score them.

        The first batch has steps and particles that training uses, the second has held-out ones. Both are sorted by instance and have at
        most `instance_samples` samples of each; `trajectory` counts the held-out instances from 0.

        Raises:
            UserError: The folder has no held-out instances.
        """
        files = self._files("held_out")
        if not files.paths:
            raise UserError(f"{self.root} has no held-out instances: generate it with `neuido trajectories --held_out 10 ...`")
        fit = self._draw(self.rows("train"), self.instance_samples, len(files.paths), salt=1)
        return files.gather(fit), files.gather(self._held_out_rows(self.instance_samples, len(files.paths), salt=2))

    @cached_property
    def _validation(self) -> FixedBatches:
        rows = self._held_out_rows(self.validation_samples, self.trajectory_count, salt=3)
        files, samples = self._files("train"), max(1, self.batch_size // self.trajectory_count)
        return FixedBatches([files.gather(part) for part in rows.split(samples, dim=1)])

    def _held_out_rows(self, samples: int, trajectories: int, *, salt: int) -> Tensor:
        """Draw half of the rows from held-out particles and half from held-out steps, (trajectories, <= samples)."""
        points = self._draw(self.rows("particles"), (samples + 1) // 2, trajectories, salt=salt)
        late = self._draw(self.rows("steps"), samples // 2, trajectories, salt=salt + 100)
        return torch.cat([points, late], dim=1)

    def _draw(self, rows: Tensor, samples: int, trajectories: int, *, salt: int) -> Tensor:
        generator = torch.Generator().manual_seed(self.seed * 1000 + salt)
        return torch.stack([rows[torch.randperm(len(rows), generator=generator)[:samples]] for _ in range(trajectories)])

    def _preload(self, device: torch.device) -> bool:
        """Copy the training set to the device if `preload` asks for it and it fits; return whether it is on the device."""
        if self.preload is False:
            return False
        if self._resident is not None and self._resident.device == device:
            return True
        steps, particles, columns = self._shape(self.index)
        wanted = self.trajectory_count * steps * particles * columns * 4
        if self.preload == "auto":
            free = torch.cuda.mem_get_info(device)[0] // 2 if device.type == "cuda" else 2 * 2**30
            if wanted > free:
                return False
        self._resident = self.files.load(device)
        return True
