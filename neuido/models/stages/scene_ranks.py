"""Several processes that share the scenes of an adaptation: each fits its own, and scores, metrics and checkpoints hold those of all."""

from pathlib import Path
from typing import Any

import torch
from lightning.fabric.utilities import move_data_to_device
from lightning.pytorch.strategies import DDPStrategy, StrategyRegistry
from torch import Tensor

from neuido.data.files.score_tables import write_rows
from neuido.errors import UserError
from neuido.models.stages.image_module import SCORES, ImageModule

OWN = ("state_dict", "optimizer_states")
"""Parts of a Lightning checkpoint that differ between the processes."""


class SceneRanks(DDPStrategy):
    """Strategy of processes that each fit scenes of their own, in step with each other: no parameter and no gradient is exchanged."""

    scenes_apart = True
    """A data module then opens only the scenes of its process."""

    def configure_ddp(self) -> None:
        """Leave the module without the wrapper that averages gradients."""


StrategyRegistry.register("scenes", SceneRanks, description="Processes fit scenes of their own", override=True)


def gathered(own: Any) -> list[Any]:
    """Return an object of each process, by rank; without other processes only the given one."""
    if not (torch.distributed.is_available() and torch.distributed.is_initialized()):
        return [own]
    everyone: list[Any] = [None] * torch.distributed.get_world_size()
    torch.distributed.all_gather_object(everyone, own)
    return everyone


class SharesScenes(ImageModule):
    """Base class of modules whose scenes may be spread over processes; subclasses have the option `out`.

    Process r of R has the scenes r, r + R, ... All take the same number of steps, which checkpoints count; one whose scene is done waits.
    """

    def __init__(self) -> None:
        super().__init__()
        self._rows: list[dict[str, Any]] = []
        self._order: list[str] = []
        self._shown: set[tuple[str, str]] = set()
        self._waiting: dict[str, float] = {}

    @property
    def alone(self) -> bool:
        """Whether no other process takes part."""
        return self._trainer is None or self.trainer.world_size == 1

    def share_scenes(self, own: list[str]) -> int:
        """Note the names of the scenes of all processes, and return the largest number of scenes of a process.

        Raises:
            UserError: The strategy would exchange gradients, a process has no scene, or two scenes have one name.
        """
        if not self.alone and not isinstance(self.trainer.strategy, SceneRanks):
            raise UserError(
                f"trainer.strategy: adaptation in {self.trainer.world_size} processes takes --trainer.strategy scenes: each fits its own"
            )
        names = gathered(own)
        longest = max(len(part) for part in names)
        self._order = [part[i] for i in range(longest) for part in names if i < len(part)]
        if not all(names):
            raise UserError(f"trainer.devices: {len(names)} processes for {len(self._order)} scenes; each process needs at least one")
        for name in self._order:
            if self._order.count(name) > 1:
                raise UserError(f"data.scenes: two scenes have the name {name}: rename one of them in its experiment.yaml")
        return longest

    # Scores.

    def record(self, row: dict[str, Any]) -> None:
        """Add the scores of a scene; a single process also writes the table."""
        self._rows.append(row)
        self.show(row)
        if self.alone:
            self._write(self._rows)

    def publish(self) -> None:
        """Write the scores that all processes have so far; all must call it."""
        if self.alone:
            return
        rows = self.rows_of_all()
        if self.trainer.is_global_zero and rows:
            for row in rows:
                if (row["scene"], row["stage"]) not in self._shown:
                    self.show(row)
            self._write(rows)

    def rows_of_all(self) -> list[dict[str, Any]]:
        """Return the rows of all processes in the order of the scenes; all must call it."""
        rows = [row for part in gathered(self._rows) for row in part]
        place = {name: i for i, name in enumerate(self._order)}
        return sorted(rows, key=lambda row: place.get(row["scene"], 0))

    def show(self, row: dict[str, Any]) -> None:
        """Print a row in one line, by the first process."""
        self._shown.add((row["scene"], row["stage"]))
        shown = [f"{key} {row[key]:.4g}" for key in (*SCORES, "later_iou", "steps", "seconds", "peak_memory_gb") if key in row]
        self.print(f"{row['scene']:16s} {row['stage']:7s} {', '.join(shown)}{row.get('failed', '')}")

    def _write(self, rows: list[dict[str, Any]]) -> None:
        write_rows(Path(self.hparams.out) / "scores.csv", rows)

    # Metrics.

    def _log(self, values: dict[str, Tensor | float]) -> None:
        if self.alone:
            super()._log(values)
        else:
            self._waiting |= {name: float(value.detach() if isinstance(value, Tensor) else value) for name, value in values.items()}

    def on_train_batch_end(self, *_: Any) -> None:
        """Log the means over the processes whose scenes were not done."""
        if self.alone:
            return
        parts, self._waiting = gathered(self._waiting), {}
        means = {}
        for name in sorted({name for part in parts for name in part}):
            values = [part[name] for part in parts if name in part]
            means[name] = sum(values) / len(values)
        super()._log(means)

    # Checkpoints.

    def keep_all(self, checkpoint: dict[str, Any], progress: dict[str, Any]) -> None:
        """Add to a checkpoint what each process has: progress and scores here, of the others also what Lightning keeps of one process."""
        own: dict[str, Any] = {"progress": progress, "rows": self._rows}
        checkpoint["adaptation"] = own
        if not self.alone:
            parts = {name: checkpoint[name] for name in OWN if name in checkpoint}
            _, *others = gathered(move_data_to_device(own | parts, torch.device("cpu")))
            checkpoint["adaptation"] = own | {"others": others}

    def take_own(self, checkpoint: dict[str, Any]) -> dict[str, Any]:
        """Put what this process had in its place in a checkpoint, and return its progress.

        Raises:
            UserError: The checkpoint is of another training, or of another number of processes.
        """
        kept = checkpoint.get("adaptation")
        if kept is None:
            raise UserError("ckpt_path is no checkpoint of an adaptation")
        others, here = kept.get("others", []), 1 if self.alone else self.trainer.world_size
        if len(others) + 1 != here:
            raise UserError(f"ckpt_path is of an adaptation in {len(others) + 1} processes, not {here}: go on with as many")
        rank = 0 if self.alone else self.trainer.global_rank
        if rank:
            kept = others[rank - 1]
            checkpoint.update({name: kept[name] for name in OWN if name in kept})
        self._rows = kept["rows"]
        return kept["progress"]
