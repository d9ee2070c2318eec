"""Tasks by a pool of processes or by Ray: the same answers whatever dies, done once, and each misuse in one line."""

import csv
import importlib.util
import os
import signal
from types import SimpleNamespace

import pytest

from neuido.commands.engines import local_pool, ray_cluster
from neuido.commands.engines.many_diagnoses import diagnose_folder, diagnose_folders
from neuido.commands.engines.outcome import RETRIES, Share, attempt
from neuido.commands.engines.task_folder import finish, finished, joined, local_copy, written
from neuido.commands.engines.tasks import check_engine, map_tasks
from neuido.errors import UserError
from tests.command import run
from tests.commands.ended_workers import killed, killed_once
from tests.discrepancy import made

OPTIONS = {"model": None, "law": None, "data": "auto", "effects": "drag_linear,drag_quadratic", "solver": "both", "draws": 19, "seed": 0,
           "max_effects": 1, "effort": "quick", "minutes": 0.0, "device": "cpu", "resume": True, "progress": False}  # fmt: skip
needs_ray = pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="needs the extra scale")


def refused(what: str) -> None:
    raise UserError(f"{what} is refused")


@pytest.mark.parametrize(
    ("engine", "address", "share", "line"),
    [
        ("rya", None, Share(), "engine = 'rya' is not known, did you mean 'ray'?"),
        ("local", "head:6379", Share(), "address = head:6379 is that of a Ray cluster"),
        ("local", None, Share(cpus=0.0), "cpus = 0 must be positive"),
        ("local", None, Share(cpus=1.5), "cpus = 1.5 must be a fraction of a core, or a whole number"),
        ("local", None, Share(gpus=1.5), "gpus = 1.5 must be 0, a fraction of a GPU, or a whole number"),
        ("local", None, Share(gpus=float("nan")), "gpus = nan must be 0"),
    ],
)
def test_misuse_is_one_line(engine, address, share, line):
    with pytest.raises(UserError) as error:
        check_engine(engine, address, share)
    assert line in str(error.value)


def test_ray_is_named_with_its_extra_where_it_is_not_there(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"needs the package ray, of the extra scale: pip install 'neuido\[scale\]'"):
        check_engine("ray", None, Share())


def test_folders_of_one_name_are_refused_before_anything_is_written(tmp_path):
    for place in ("a", "b"):
        (tmp_path / place / "throw").mkdir(parents=True)
    folders = [str(tmp_path / "a" / "throw"), str(tmp_path / "b" / "throw")]
    with pytest.raises(UserError, match="has the name 'throw'"):
        diagnose_folders(folders, str(tmp_path / "out"), OPTIONS, engine="local", address=None, share=Share(), progress=False)
    assert not (tmp_path / "out").exists()


def test_processes_share_cores_and_gpus(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(8)), raising=False)
    monkeypatch.setattr(local_pool, "visible_gpus", lambda: ["4", "5"])
    assert local_pool._places(Share(2.0), 9) == [([0, 1], ""), ([2, 3], ""), ([4, 5], ""), ([6, 7], "")]
    assert [gpus for _, gpus in local_pool._places(Share(1.0, 0.25), 99)] == ["4"] * 4 + ["5"] * 4
    assert [gpus for _, gpus in local_pool._places(Share(1.0, 2.0), 99)] == ["4,5"]
    assert len(local_pool._places(Share(), 3)) == 3
    for share, line in ((Share(9.0), "may use 8 cores"), (Share(1.0, 3.0), "has 2 GPUs")):
        with pytest.raises(UserError, match=line):
            local_pool._places(share, 1)


def test_an_error_of_a_task_is_its_line():
    assert attempt(refused, ("x",)) == (None, "x is refused")
    assert attempt(divmod, (1, 0))[1].startswith("ZeroDivisionError")
    assert attempt(divmod, (7, 2)) == ((3, 1), "")


def test_folders_may_be_addresses(tmp_path):
    place = "memory://tests/answers"
    with written(joined(place, "one")) as folder:
        (folder / "below").mkdir()
        (folder / "below" / "a.txt").write_text("whole")
    assert finished(joined(place, "one"), "x") is None
    finish(joined(place, "one"), "x", {"answer": "none"})
    assert finished(joined(place, "one"), "x") == {"answer": "none"}
    assert finished(joined(place, "one"), "y") is None
    with local_copy(joined(place, "one")) as copy:
        assert copy.name == "one" and (copy / "below" / "a.txt").read_text() == "whole"
    with pytest.raises(UserError, match="cannot be reached: FileNotFoundError"), local_copy("memory://tests/absent"):
        pass
    with pytest.raises(UserError, match="nowhere://x cannot be opened"):
        finished("nowhere://x", "x")


def test_a_mark_that_is_damaged_does_not_count(tmp_path):
    finish(str(tmp_path), "x", {"answer": "none"})
    (tmp_path / ".task.json").write_text('{"digest": "x", ')
    assert finished(str(tmp_path), "x") is None


@pytest.mark.parametrize("address", [None, "nowhere:1"])
def test_a_cluster_that_does_not_start_is_one_line(monkeypatch, address):
    def init(**options):
        raise Exception("The current node timed out")  # as Ray raises it

    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    ray = SimpleNamespace(is_initialized=lambda: False, init=init)
    line = f"address = {address}: no Ray cluster answers there" if address else "no cluster can be started on this machine"
    with pytest.raises(UserError, match=f"{line}: The current node timed out"), ray_cluster._connected(ray, address):
        pass


def test_signals_end_the_command_as_they_did_before_ray_was_started():
    """Ray's own handler of SIGTERM ends the process by SIGABRT."""
    before, ended = signal.getsignal(signal.SIGTERM), []
    ray = SimpleNamespace(
        is_initialized=lambda: False,
        init=lambda **options: signal.signal(signal.SIGTERM, signal.SIG_IGN),
        shutdown=lambda: ended.append(True),
    )
    with ray_cluster._connected(ray, None):
        assert signal.getsignal(signal.SIGTERM) is before
    assert ended


@pytest.mark.slow
def test_a_folder_is_diagnosed_once(tmp_path):
    made.track(tmp_path / "throw")
    asked = (str(tmp_path / "throw"), str(tmp_path / "out"))
    row = diagnose_folder(*asked, OPTIONS)
    written_at = (tmp_path / "out" / "diagnosis.json").stat().st_mtime_ns
    assert diagnose_folder(*asked, OPTIONS) == row and row["answer"] == "effect" and row["effects"] == "drag_quadratic"
    assert (tmp_path / "out" / "diagnosis.json").stat().st_mtime_ns == written_at
    diagnose_folder(*asked, OPTIONS | {"draws": 20})
    assert (tmp_path / "out" / "diagnosis.json").stat().st_mtime_ns > written_at


@pytest.mark.slow
def test_processes_that_are_killed_lose_no_task(tmp_path):
    for name in "abc":
        (tmp_path / name).mkdir()
    items = [(str(tmp_path / "a"), 0), (str(tmp_path / "b"), 1), (str(tmp_path / "c"), RETRIES + 1)]
    found = {outcome.number: outcome for outcome in map_tasks(killed, items, share=Share())}
    assert (found[0].value, found[1].value) == (1, 2) and not found[0].error + found[1].error
    assert found[2].value is None and found[2].error == f"its process ended {RETRIES + 1} times: killed, or no memory was left"


@pytest.mark.slow
def test_many_folders_by_the_command(tmp_path, capsys):
    made.track(tmp_path / "throw")
    (tmp_path / "empty").mkdir()
    words = ["diagnose", tmp_path / "throw", tmp_path / "empty", "--out", tmp_path / "out", "--draws", "19", "--device", "cpu"]
    status, out, _ = run(capsys, *words, "--effects", "drag_linear,drag_quadratic")
    assert status == 1 and "1 of 2 failed" in out
    rows = list(csv.DictReader((tmp_path / "out" / "diagnoses.csv").open()))
    assert [(row["name"], row["answer"], row["effects"]) for row in rows] == [
        ("throw", "effect", "drag_quadratic"),
        ("empty", "failed", ""),
    ]
    assert "none of experiment.yaml" in rows[1]["error"] and (tmp_path / "out" / "throw" / "report.html").is_file()


@pytest.mark.slow
def test_trajectories_by_an_engine_are_those_of_one_process(tmp_path, capsys):
    small = ["--instances", "1", "--held_out", "0", "--setup.particles_per_side", "3", "--setup.steps", "8", "--setup.cells", "10"]
    for out, more in (("one", []), ("many", ["--engine", "local", "--shards", "2"])):
        assert run(capsys, "trajectories", "--out", tmp_path / out, *small, *more, "--device", "cpu", "--progress", "false")[0] == 0
    files = [sorted((path.name, path.read_bytes()) for path in (tmp_path / out).glob("*.npy")) for out in ("one", "many")]
    assert files[0] == files[1] and len(files[0]) == 3 and (tmp_path / "many" / "index.json").is_file()
    status, _, err = run(capsys, "trajectories", "--out", tmp_path / "x", "--engine", "local", "--shard", "1")
    assert status == 2 and "shard = 1 is for jobs that are started one by one" in err and not (tmp_path / "x").exists()


@needs_ray
@pytest.mark.slow
def test_ray_gives_the_answers_of_one_process_though_a_worker_is_killed(tmp_path):
    import ray

    made.track(tmp_path / "throw")
    alone = diagnose_folder(str(tmp_path / "throw"), str(tmp_path / "alone"), OPTIONS)
    (tmp_path / "mark").mkdir()
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False)
    try:
        items = [(str(tmp_path / "throw"), str(tmp_path / f"out{i}"), OPTIONS, str(tmp_path / "mark")) for i in range(3)]
        found = list(map_tasks(killed_once, items, engine="ray", share=Share()))
        with pytest.raises(UserError, match="no machine of the cluster has as much"):
            list(map_tasks(refused, [("x",)], engine="ray", share=Share(cpus=64.0)))
        assert [outcome.error for outcome in map_tasks(refused, [("x",)], engine="ray", share=Share())] == ["x is refused"]
    finally:
        ray.shutdown()
    assert sorted(outcome.number for outcome in found) == [0, 1, 2] and len(list((tmp_path / "mark").iterdir())) == 4
    assert all({**outcome.value, "seconds": 0.0} == {**alone, "seconds": 0.0} for outcome in found)
    for i in range(3):
        assert (tmp_path / f"out{i}" / "model_after.yaml").read_bytes() == (tmp_path / "alone" / "model_after.yaml").read_bytes()
