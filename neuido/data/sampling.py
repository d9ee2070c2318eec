"""The order of the training samples, and the loaders that follow it.

A batch holds the same number n of samples of each of M trajectories, sorted by trajectory. One permutation of the N training samples
of a trajectory serves all trajectories of an epoch, each from an offset of its own, so an epoch's order costs one randperm(N)
and no memory for each trajectory. It is a function of (seed, epoch, step) alone.
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
    """A training batch that is still to be gathered."""

    epoch: int
    step: int


class SampleOrder:
    """Which rows of each trajectory a training step takes: a function of (seed, epoch, step).

    Args:
        rows: Rows that may be taken from each trajectory, (N,) int64.
        trajectory_count: M.
        samples: Samples of each trajectory in a batch, n.
        seed: Seed.
        drop_last: Leave out the last batch of an epoch if it would be smaller than the others.
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
        """Return rows of each trajectory, (M, n) int64; the last step of an epoch may have fewer."""
        if self._epoch != (epoch, device):
            seed = int(np.random.SeedSequence([self.seed, epoch]).generate_state(1, np.uint64)[0] >> np.uint64(1))
            generator = torch.Generator().manual_seed(seed)
            self._shuffled = self.rows[torch.randperm(len(self.rows), generator=generator)].to(device)
            self._offsets = torch.randint(len(self.rows), (self.trajectory_count, 1), generator=generator).to(device)
            self._epoch = (epoch, device)
        positions = torch.arange(step * self.samples, min((step + 1) * self.samples, len(self.rows)), device=device)
        return self._shuffled[(self._offsets + positions) % len(self.rows)]


class ResumableLoader(Generic[T]):
    """A training loader whose epochs go on where a resumed run stopped.

    Lightning calls `sampler.set_epoch` before the first batch of an epoch and stores `state_dict` in its checkpoints. The state
    counts the batches that were handed out, so workers that read ahead do not disturb it.

    Args:
        identity: What must be the same when a run is resumed.
    """

    def __init__(self, identity: dict[str, int]) -> None:
        self.identity = identity
        self.epoch = 0
        self._next = 0
        self._resume: tuple[int, int] | None = None

    def batches(self, epoch: int, start: int) -> Iterable[T]:
        """Return the batches of an epoch from number `start` on."""
        raise NotImplementedError

    @property
    def sampler(self) -> "ResumableLoader":
        """Where Lightning looks for `set_epoch`."""
        return self

    def set_epoch(self, epoch: int) -> None:
        self.epoch = epoch

    def __iter__(self) -> Iterator[T]:
        # A generator: Lightning makes the iterator before it sets the epoch, and nothing here runs before the first batch.
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
        changed = [f"{key} {state.get(key)} then, {value} now" for key, value in self.identity.items() if state.get(key) != value]
        if changed:
            raise UserError(f"the checkpoint was written with other data options ({'; '.join(changed)}): restore them to resume")
        self._resume = (state["epoch"], state["step"])


class TrainingSteps(ResumableLoader[Step | TrajectoryBatch]):
    """The steps of an epoch.

    Args:
        order: The order of the samples.
        gather: Makes the batch of a step in a worker process; none: hand out `Step`s, gathered where the data lie.
        workers: Worker processes; used with `gather`.
        rank: This process among those that share the steps.
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
        return steps if self.gather is None else DataLoader(_Gathered(self.gather, steps), batch_size=None, num_workers=self.workers)


class _Gathered(Dataset):
    def __init__(self, gather: Callable[[int, int], TrajectoryBatch], steps: list[Step]) -> None:
        self.gather, self.steps = gather, steps

    def __len__(self) -> int:
        return len(self.steps)

    def __getitem__(self, index: int) -> TrajectoryBatch:
        return self.gather(*self.steps[index])


class FixedBatches:
    """A fixed sequence of batches as a loader."""

    def __init__(self, batches: list[TrajectoryBatch]) -> None:
        self.batches = batches

    def __len__(self) -> int:
        return len(self.batches)

    def __iter__(self) -> Iterator[TrajectoryBatch]:
        return iter(self.batches)
