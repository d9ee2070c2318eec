"""Adaptation by several processes: each scene ends as in one, the tables hold all, and no rank waits for one that died."""

import os
import re
import signal
import socket
import time
from pathlib import Path

import pytest
from safetensors.torch import load_file

from neuido.errors import UserError
from neuido.models.stages.scene_ranks import SharesScenes
from tests.models.stages.adaptation_runs import finish, losses, rows_of, start
from tests.waiting import HANGS, wait_for

YOUNGS = (4e4, 2e5, 1e5)  # three scenes: a process of two has one and waits
CLOCK = ("seconds",)


def results(folder: Path) -> tuple[list[dict], dict]:
    """Return the table of scores without the figures of the clock, and the weights of each fit."""
    rows = [{key: value for key, value in row.items() if key not in CLOCK} for row in rows_of(folder / "out" / "scores.csv")]
    names = list(dict.fromkeys(row["scene"] for row in rows))
    return rows, {name: load_file(folder / "out" / name / "fit" / "adapter_model.safetensors") for name in names}


def equal(one: Path, other: Path) -> None:
    (rows, fits), (rows_there, fits_there) = results(one), results(other)
    assert [(row["scene"], row["stage"]) for row in rows] == [(row["scene"], row["stage"]) for row in rows_there]
    for row, there in zip(rows, rows_there):
        for name, value in row.items():
            assert there[name] == value or float(there[name]) == pytest.approx(float(value), rel=1e-3), (row["scene"], name)
    for name, fit in fits.items():
        for key, weight in fit.items():
            assert fits_there[name][key].allclose(weight, atol=1e-6, rtol=1e-4), (name, key)


def two_nodes(folder: Path, **options) -> list:
    """Start two launchers of two processes each, as on two machines."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    shared = ("-m", "torch.distributed.run", "--nnodes=2", "--nproc-per-node=2", "--master-addr=127.0.0.1", f"--master-port={port}")
    return [start(folder, ranks=4, devices=2, launcher=(*shared, f"--node-rank={node}"), **options) for node in range(2)]


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    folder = tmp_path_factory.mktemp("alone") / "one"
    finish(start(folder, youngs=(*YOUNGS, 3e4, 6e4)))
    return folder


@pytest.mark.slow
def test_two_processes_fit_each_scene_as_one_does_and_go_on_when_killed(tmp_path):
    whole, shared = tmp_path / "whole", tmp_path / "shared"
    finish(start(whole, youngs=YOUNGS))
    begun = start(shared, 0.3, youngs=YOUNGS, ranks=2)
    wait_for(lambda: len(losses(shared)) >= 5, begun)
    time.sleep(0.2)
    os.killpg(begun.pid, signal.SIGKILL)
    begun.communicate()
    assert len(losses(shared)) < 12
    wrong = start(shared, resume=str(shared / "last.ckpt"), youngs=YOUNGS)
    printed, _ = wrong.communicate(timeout=HANGS)
    assert wrong.returncode and "of an adaptation in 2 processes, not 1: go on with as many" in printed
    finish(start(shared, resume=str(shared / "last.ckpt"), youngs=YOUNGS, ranks=2))
    equal(whole, shared)
    expected, found = losses(whole), losses(shared)
    assert expected.keys() == found.keys() and all(found[key] == pytest.approx(value, rel=1e-4) for key, value in expected.items())


@pytest.mark.slow
def test_two_nodes_of_two_processes_fit_each_scene_as_one_process_does(tmp_path, alone):
    for process in two_nodes(tmp_path / "four", youngs=(*YOUNGS, 3e4, 6e4)):
        finish(process)
    equal(alone, tmp_path / "four")


@pytest.mark.slow
def test_a_process_that_dies_ends_all_within_a_minute(tmp_path):
    folder = tmp_path / "broken"
    both = two_nodes(folder, youngs=(*YOUNGS, 3e4), steps=100000, stop_on="none")
    wait_for((folder / "last.ckpt").is_file, both[0])
    children = Path(f"/proc/{both[1].pid}/task/{both[1].pid}/children").read_text().split()
    os.kill(int(children[-1]), signal.SIGKILL)
    died, printed = time.monotonic(), ""
    try:
        for process in both:
            printed += process.communicate(timeout=60)[0]  # the promise itself
            assert process.returncode not in (0, None)
    finally:
        for process in both:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
    assert time.monotonic() - died < 60
    assert re.search("Connection closed|SIGKILL", printed), "the other process lost it, or torchrun tells of it first"


@pytest.mark.slow
def test_more_processes_than_scenes_are_refused(tmp_path):
    process = start(tmp_path / "few", youngs=(5e4,), ranks=2)
    printed, _ = process.communicate(timeout=HANGS)
    assert process.returncode and "trainer.devices: 2 processes for 1 scenes" in printed


def test_a_checkpoint_of_another_training_is_refused():
    with pytest.raises(UserError, match="no checkpoint of an adaptation"):
        SharesScenes().take_own({})
    with pytest.raises(UserError, match="in 3 processes, not 1"):
        SharesScenes().take_own({"adaptation": {"progress": {}, "rows": [], "others": [{}, {}]}})
