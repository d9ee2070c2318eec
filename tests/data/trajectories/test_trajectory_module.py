import json
import shutil

import numpy as np
import pytest
import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint

from neuido.data.sampling import SampleOrder
from neuido.data.trajectories.trajectory_module import TrajectoryDataModule
from neuido.errors import UserError

from .conftest import TINY

CPU = torch.device("cpu")


def module(folder, **options) -> TrajectoryDataModule:
    made = TrajectoryDataModule(str(folder), **({"batch_size": 900, "seed": 5} | options))
    made.setup()
    return made


class Recorder(LightningModule):
    """Learns one number and keeps a fingerprint of each batch."""

    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(()))
        self.seen = []

    def training_step(self, batch, batch_idx):
        key = float(batch.stress.double().sum()), int(batch.trajectory.sum()), len(batch.stress)
        self.seen.append((self.current_epoch, batch_idx, *key))
        return (self.weight - batch.stress.mean()).square()

    def validation_step(self, batch, batch_idx):
        assert batch.trial.shape == (len(batch.trajectory), 3, 3)

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=1e-3)


class Killed(RuntimeError):
    pass


class Stop(Callback):
    """Breaks a run off after some steps."""

    def __init__(self, step: int):
        self.step = step

    def on_train_batch_end(self, trainer, *_):
        if trainer.global_step == self.step:
            raise Killed


def fit(data, root, *, epochs=3, stop=None, resume=None, every=1, **options) -> Recorder:
    saver = ModelCheckpoint(root / "saved", filename="{step}", every_n_train_steps=every, save_top_k=-1)
    trainer = Trainer(
        max_epochs=epochs,
        accelerator="cpu",
        devices=1,
        default_root_dir=root,
        callbacks=[saver] + ([Stop(stop)] if stop else []),
        logger=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        **options,
    )
    recorder = Recorder()
    if stop:
        with pytest.raises(Killed):
            trainer.fit(recorder, data, ckpt_path=resume)
    else:
        trainer.fit(recorder, data, ckpt_path=resume)
    return recorder


# The order


@pytest.mark.parametrize(("rows", "samples"), [(100, 10), (103, 10), (7, 50)])
def test_an_epoch_takes_each_sample_of_each_trajectory_once(rows, samples):
    order = SampleOrder(torch.arange(rows) * 3, 4, samples, seed=1)
    for epoch in range(3):
        taken = torch.cat([order(epoch, step, CPU) for step in range(len(order))], dim=1)
        assert taken.shape == (4, rows)
        assert torch.equal(taken.sort(dim=1).values, (torch.arange(rows) * 3).expand(4, -1))
    assert len(SampleOrder(torch.arange(rows), 4, samples, seed=1, drop_last=True)) == max(1, rows // samples)


def test_order_is_a_function_of_seed_epoch_and_step():
    orders = [SampleOrder(torch.arange(500), 5, 20, seed=seed) for seed in (1, 1, 2)]
    steps = [(2, 3), (0, 0), (2, 4), (1, 24), (2, 3)]
    first = {step: orders[0](*step, CPU).clone() for step in steps}
    assert all(torch.equal(orders[1](*step, CPU), first[step]) for step in reversed(steps))
    assert not any(torch.equal(orders[2](*step, CPU), first[step]) for step in steps)
    assert not torch.equal(first[(0, 0)], orders[0](1, 0, CPU))
    assert not torch.equal(first[(0, 0)][0], first[(0, 0)][1])  # trajectories start at different places


# The split


def test_split_is_disjoint_and_complete(folder):
    data = module(folder)
    parts = {name: set(data.rows(name).tolist()) for name in ("train", "particles", "steps")}
    assert sum(map(len, parts.values())) == len(set.union(*parts.values())) == 30 * 64
    late, points = data.held_out
    assert int(late.sum()) == 3
    assert int(points.sum()) == 6
    assert all(not late[row // 64] and not points[row % 64] for row in parts["train"])
    assert all(points[row % 64] for row in parts["particles"])
    assert all(late[row // 64] for row in parts["steps"])
    other = module(folder, seed=6).held_out
    assert not (torch.equal(late, other[0]) and torch.equal(points, other[1]))


def test_held_out_steps_are_blocks():
    data = TrajectoryDataModule("nowhere", held_out_steps=0.2)
    data.index = {"setup": {"steps": 1000, "record_every": 1, "particles_per_side": 2}, "trajectories": []}
    late, _ = data.held_out
    assert int(late.sum()) == 200
    assert all(len(set(block.tolist())) == 1 for block in late.view(50, 20))


# The batches


def test_batches_are_balanced_and_true(folder):
    data = module(folder)
    stored = [np.load(folder / f"{name}.npy").reshape(-1, 27) for name in data.names]
    allowed = set(data.rows("train").tolist())
    for step in (0, 5, len(data.order) - 1):
        batch = data.gather(1, step)
        n = len(batch.trajectory) // 9
        assert n == 100 if step < len(data.order) - 1 else 0 < n <= 100
        assert torch.equal(batch.trajectory, torch.arange(9).repeat_interleave(n))
        rows = torch.cat([part.flatten(1) for part in batch[:3]], dim=1).numpy()
        for k in (0, n, 9 * n - 1):
            (at,) = np.nonzero((stored[k // n] == rows[k]).all(axis=1))
            assert len(at)
            assert allowed & set(at.tolist())


def test_resident_and_mapped_data_give_the_same_batches(folder, tmp_path):
    runs = {
        name: fit(module(folder, **options), tmp_path / name, epochs=2, every=1000).seen
        for name, options in (
            ("resident", {"preload": True}),
            ("auto", {}),
            ("mapped", {"preload": False}),
            ("workers", {"preload": False, "num_workers": 2}),
        )
    }
    assert len(runs["resident"]) == 2 * len(module(folder).order)
    assert all(run == runs["resident"] for run in runs.values())
    assert len({entry[2] for entry in runs["resident"]}) == len(runs["resident"])


def test_validation_is_what_training_never_sees(folder):
    data = module(folder, validation_samples=40)
    batches = list(data.val_dataloader())
    whole = torch.cat([b.trial.flatten(1) for b in batches])
    assert len(whole) == 9 * 40
    stored = [np.load(folder / f"{name}.npy").reshape(-1, 27) for name in data.names]
    train = data.rows("train").numpy()
    for batch in batches:
        assert torch.equal(batch.trajectory, batch.trajectory.sort().values)
        for row, trajectory in zip(batch.trial.flatten(1).numpy()[::37], batch.trajectory.tolist()[::37]):
            assert not (stored[trajectory][train, :9] == row).all(axis=1).any()
    again = torch.cat([b.trial.flatten(1) for b in module(folder, validation_samples=40).val_dataloader()])
    assert torch.equal(whole, again)


def test_held_out_instances(folder):
    data = module(folder, instance_samples=50)
    fitted, scored = data.instance_batches()
    assert data.instance_names == [f"{f}-{n:03d}" for f in ("elastic", "plasticine", "sand") for n in (3, 4)]
    assert torch.equal(fitted.trajectory, torch.arange(6).repeat_interleave(50))
    assert torch.equal(scored.trajectory, fitted.trajectory)
    stored = [np.load(folder / f"{name}.npy").reshape(-1, 27) for name in data.instance_names]
    held_out = torch.cat([data.rows("particles"), data.rows("steps")])
    for half, rows in ((fitted, data.rows("train")), (scored, held_out)):
        for k in range(0, 300, 29):
            sample = torch.cat([part[k].flatten() for part in half[:3]]).numpy()
            assert (stored[k // 50][rows.numpy()] == sample).all(axis=1).any()


def test_what_the_model_needs_is_known_before_setup(folder):
    data = TrajectoryDataModule(str(folder))
    entries = json.loads((folder / "index.json").read_text())["trajectories"]
    assert data.trajectory_count == 9
    assert data.names[:2] == ["jelly", "elastic-001"]
    assert data.families == ["elastic"] * 3 + ["plasticine"] * 3 + ["sand"] * 3
    assert data.stress_rms.tolist() == pytest.approx([e["stress_rms"] for e in entries[:9]])
    assert data.residual_rms.shape == (9,)
    assert data.instance_stress_rms.tolist() == pytest.approx([e["stress_rms"] for e in entries[9:]])


# Resuming


@pytest.fixture(scope="module")
def straight(folder, tmp_path_factory):
    """A run that is not broken off."""
    return fit(module(folder), tmp_path_factory.mktemp("straight"), every=1000)


@pytest.mark.parametrize("options", [{}, {"preload": False, "num_workers": 1}], ids=["resident", "workers"])
@pytest.mark.parametrize("stop", [4, 15, 16, 17, 18, 40])
def test_resumed_run_sees_the_same_batches(folder, straight, tmp_path, stop, options):
    """Broken off within an epoch, at its last batch (16) and in the next ones; a checkpoint after each step."""
    assert len(module(folder).order) == 16
    first = fit(module(folder, **options), tmp_path / "broken", stop=stop, **options_of(options))
    last = max((tmp_path / "broken" / "saved").glob("*.ckpt"), key=lambda path: int(path.stem.split("=")[1]))
    done = int(last.stem.split("=")[1])
    assert done in (stop, stop - 1)
    second = fit(module(folder, **options), tmp_path / "resumed", resume=last, every=1000)
    assert first.seen[:done] + second.seen == straight.seen
    assert torch.equal(second.weight, straight.weight)


def options_of(options: dict) -> dict:
    return {"val_check_interval": 5} if not options else {}


def test_resume_of_a_run_counted_in_steps(folder, tmp_path):
    """With max_steps Lightning restores the loader at the end of an epoch too."""
    straight = fit(module(folder), tmp_path / "straight", every=1000)
    for stop in (10, 16, 20):
        fit(module(folder), tmp_path / str(stop), stop=stop, epochs=-1, max_steps=48)
        checkpoint = tmp_path / str(stop) / "saved" / f"step={stop - 1}.ckpt"
        second = fit(module(folder), tmp_path / f"{stop}b", resume=checkpoint, every=1000, epochs=-1, max_steps=48)
        assert second.seen == straight.seen[stop - 1 :]


def test_resume_with_other_data_options_is_refused(folder, tmp_path):
    fit(module(folder), tmp_path, stop=5)
    checkpoint = next((tmp_path / "saved").glob("*.ckpt"))
    with pytest.raises(UserError, match=r"samples was 100 and is 50"):
        fit(module(folder, batch_size=450), tmp_path, resume=checkpoint)


# Errors


def test_missing_and_incomplete_folders(folder, tmp_path):
    for state, word in ((tmp_path / "none", "has no trajectories"), (tmp_path / "half", "is incomplete")):
        if state.name == "half":
            state.mkdir()
            shutil.copy(folder / "plan.json", state)
        with pytest.raises(UserError, match=f"{word}.*neuido trajectories --config configs/trajectories.yaml --out") as error:
            module(state)
        assert "\n" not in str(error.value)
    shutil.copytree(folder, tmp_path / "cut")
    whole = (tmp_path / "cut" / "sand.npy").read_bytes()
    (tmp_path / "cut" / "sand.npy").write_bytes(whole[:-1])
    with pytest.raises(UserError, match=r"sand.npy is missing or truncated"):
        module(tmp_path / "cut")


def test_generate_on_the_fly(folder, tmp_path):
    data = TrajectoryDataModule(str(tmp_path / "made"), generate=TINY)
    assert data.trajectory_count == 9
    assert (tmp_path / "made" / "sand.npy").read_bytes() == (folder / "sand.npy").read_bytes()


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"held_out_particles": 0.0}, "held_out_particles"),
        ({"held_out_steps": 1.0}, "held_out_steps"),
        ({"batch_size": 8}, "batch_size"),
        ({"batch_size": 0}, "batch_size"),
        ({"preload": "yes"}, "preload"),
        ({"generate": {"stepps": 3}}, "stepps"),
    ],
)
def test_bad_options(folder, options, word):
    with pytest.raises(UserError, match=word):
        module(folder, **options)
