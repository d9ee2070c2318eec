"""Order of the training samples, and loaders that resume in the middle of an epoch.

A batch holds n samples of each of M trajectories, sorted by trajectory. In an epoch, all trajectories use the same permutation of their N
training samples, each from a different offset. An epoch therefore costs one randperm(N) and no memory per trajectory. The order is a
function of seed, epoch and step only.
"""

from collections.abc import Callable, Iterable, Iterator
from typing import Generic, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from neuido.errors import UserError
from neuido.types import TrajectoryBatch

T = TypeVar("T")


class Step(NamedTuple):
    """Number of a training batch whose samples are gathered later, on the device."""

    epoch: int
    step: int


class SampleOrder:
    """Random order of samples: the rows of each trajectory that a training step uses.

    The order is a function of seed, epoch and step only.

    Args:
        rows: Rows of a trajectory that training may use, (N,) int64.
        trajectory_count: Number of trajectories M.
        samples: Samples of each trajectory in a batch, n.
        seed: Seed of the order.
        drop_last: Omit the last batch of an epoch if it is smaller than the others.
    """

    def __init__(self, rows: Tensor, trajectory_count: int, samples: int, *, seed: int, drop_last: bool = False) -> None:
        self.rows, self.trajectory_count, self.samples, self.seed = rows, trajectory_count, min(samples, len(rows)), seed
        self.drop_last = drop_last
        self._epoch: tuple[int, torch.device] | None = None

    def __len__(self) -> int:
        """Return the number of steps in an epoch."""
        full, rest = divmod(len(self.rows), self.samples)
        return full + (1 if rest and not self.drop_last else 0)

    def __call__(self, epoch: int, step: int, device: torch.device) -> Tensor:
        """Return the rows of each trajectory for a step, (M, n) int64 on `device`; the last step of an epoch may have fewer columns."""
        if self._epoch != (epoch, device):
            seed = int(np.random.SeedSequence([self.seed, epoch]).generate_state(1, np.uint64)[0] >> np.uint64(1))
            generator = torch.Generator().manual_seed(seed)
            self._shuffled = self.rows[torch.randperm(len(self.rows), generator=generator)].to(device)
            self._offsets = torch.randint(len(self.rows), (self.trajectory_count, 1), generator=generator).to(device)
            self._epoch = (epoch, device)
        positions = torch.arange(step * self.samples, min((step + 1) * self.samples, len(self.rows)), device=device)
        return self._shuffled[(self._offsets + positions) % len(self.rows)]


class ResumableLoader(Generic[T]):
    """Training loader that a resumed run continues in the middle of an epoch.

    Lightning calls `sampler.set_epoch` before the first batch of an epoch and stores `state_dict` in its checkpoints. The state counts the
    batches that training has received, so workers that read ahead do not change it.

    Args:
        identity: Values that must be equal when a run is resumed, such as the seed.
    """

    def __init__(self, identity: dict[str, int]) -> None:
        self.identity = identity
        self.epoch = 0
        self._next = 0
        self._resume: tuple[int, int] | None = None

    def batches(self, epoch: int, start: int) -> Iterable[T]:
        """Return the batches of an epoch from batch `start` on; subclasses implement it."""
        raise NotImplementedError

    @property
    def sampler(self) -> "ResumableLoader":
        """This loader: Lightning calls `set_epoch` of a loader's sampler."""
        return self

    def set_epoch(self, epoch: int) -> None:
        self.epoch = epoch

    def __iter__(self) -> Iterator[T]:
        # This is a generator, so nothing runs before the first batch: Lightning creates the iterator before it sets the epoch.
        epoch, start = self.epoch, 0
        if self._resume is not None and self._resume[0] == epoch:
            start = self._resume[1]
        self._resume = None
        self._next = start
        for batch in self.batches(epoch, start):
            self._next += 1
            yield batch

    def state_dict(self) -> dict[str, int]:
        return {"epoch": self.epoch, "step": self._next, **self.identity}

    def load_state_dict(self, state: dict[str, int]) -> None:
        changed = [f"{key} was {state.get(key)} and is {value}" for key, value in self.identity.items() if state.get(key) != value]
        if changed:
            raise UserError(f"the checkpoint was written with other data options ({'; '.join(changed)}): use the former options to resume")
        self._resume = (state["epoch"], state["step"])


class TrainingSteps(ResumableLoader[Step | TrajectoryBatch]):
    """Resumable loader of the training batches of an epoch, shared by several processes.

    Args:
        order: The order of the samples.
        gather: Reads the batch of (epoch, step) from the files. None: yield `Step`s, whose samples are gathered on the device.
        workers: Number of worker processes that call `gather`.
        rank: Index of this process.
        ranks: Number of processes.
    """

    def __init__(
        self, order: SampleOrder, gather: Callable[[int, int], TrajectoryBatch] | None, *, workers: int = 0, rank: int = 0, ranks: int = 1
    ) -> None:
        count = {"trajectories": order.trajectory_count, "samples": order.samples, "rows": len(order.rows)}
        super().__init__({"seed": order.seed, **count, "ranks": ranks})
        self.order, self.gather, self.workers, self.rank, self.ranks = order, gather, workers, rank, ranks

    def __len__(self) -> int:
        return len(self.order) // self.ranks

    def batches(self, epoch: int, start: int) -> Iterable[Step | TrajectoryBatch]:
        steps = [Step(epoch, k * self.ranks + self.rank) for k in range(start, len(self))]
        return steps if self.gather is None else DataLoader(_GatheredSteps(self.gather, steps), batch_size=None, num_workers=self.workers)


class _GatheredSteps(Dataset):
    """Batches of given steps, each read by `gather` when it is accessed."""

    def __init__(self, gather: Callable[[int, int], TrajectoryBatch], steps: list[Step]) -> None:
        self.gather, self.steps = gather, steps

    def __len__(self) -> int:
        return len(self.steps)

    def __getitem__(self, index: int) -> TrajectoryBatch:
        return self.gather(*self.steps[index])


class FixedBatches:
    """Loader of a fixed list of batches."""

    def __init__(self, batches: list[TrajectoryBatch]) -> None:
        self.batches = batches

    def __len__(self) -> int:
        return len(self.batches)

    def __iter__(self) -> Iterator[TrajectoryBatch]:
        return iter(self.batches)
