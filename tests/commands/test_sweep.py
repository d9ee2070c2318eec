"""Sweeps: what a file stands for agrees with wandb's own rules, and runs are resumed, shared and collected."""

import csv
import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

import neuido
from neuido.commands.cli.sweep_file import command_of, read_sweep, runs_of
from neuido.commands.main import main
from neuido.commands.sweep import scored, sweep
from neuido.data.files.score_tables import write_rows
from neuido.data.files.sweep_run import own_folder, redirect
from neuido.errors import UserError
from tests.waiting import wait_for

ROOT = Path(neuido.__file__).parents[1]
SWEEPS = sorted(path for path in neuido.configs_root().rglob("*.yaml") if re.search(r"^parameters:", path.read_text(), re.MULTILINE))
GRID = {"a": {"values": [1, 2, 3]}, "model.b": {"values": ["x", "y"]}, "c": {"value": 5}}
PROGRAM = """
import os, sys, csv, pathlib
folder = pathlib.Path(os.environ["NEUIDO_RUN"], "log")
value = float(dict(word.lstrip("-").split("=") for word in sys.argv[1:])["a"])
with pathlib.Path(os.environ["NEUIDO_RUN"]).parent.joinpath("started").open("a") as file:
    file.write(f"{value:g} {os.environ['WANDB_MODE']} {os.environ['WANDB_RUN_ID']}\\n")
if value == float(os.environ.get("FAIL", "nan")):
    sys.exit("this value is cursed")
folder.mkdir()
with (folder / "metrics.csv").open("w") as file:
    csv.writer(file).writerows([["step", "loss", "acc"], [1, 9.0, ""], [2, "", 0.5], [3, value**2, ""]])
"""


def write(folder: Path, **content) -> str:
    path = folder / "plan.yaml"
    path.write_text(yaml.safe_dump({"method": "grid", "program": "prog.py", "parameters": GRID, **content}, sort_keys=False))
    return str(path)


@pytest.fixture
def plan(tmp_path) -> str:
    """A grid of three runs of a small program."""
    (tmp_path / "prog.py").write_text(PROGRAM)
    command = [sys.executable, str(tmp_path / "prog.py"), "${args}"]
    return write(tmp_path, command=command, parameters={"a": {"values": [3, 1, 2]}}, metric={"name": "loss", "goal": "minimize"})


def table(folder: Path) -> list[dict[str, str]]:
    with (folder / "results.csv").open() as file:
        return list(csv.DictReader(file))


def started(folder: Path) -> list[str]:
    return (folder / "started").read_text().splitlines()


def test_grid_is_the_product(tmp_path):
    runs = runs_of(read_sweep(write(tmp_path)))
    assert [run.parameters for run in runs] == [{"a": a, "model.b": b, "c": 5} for a in (1, 2, 3) for b in ("x", "y")]
    assert [run.name for run in runs][:2] == ["a-1-b-x", "a-1-b-y"]
    assert [run.name for run in runs_of(read_sweep(write(tmp_path, run_cap=4)))] == [run.name for run in runs][:4]


def test_random_runs_depend_on_their_number_alone(tmp_path):
    parameters = {
        "lr": {"distribution": "log_uniform_values", "min": 1e-5, "max": 1e-1},
        "n": {"min": 2, "max": 4},
        "share": {"min": 0.0, "max": 1.0},
        "q": {"distribution": "q_uniform", "min": 0, "max": 1, "q": 0.25},
        "kind": {"values": ["a", "b"], "probabilities": [1.0, 0.0]},
    }
    file = read_sweep(write(tmp_path, method="random", parameters=parameters))
    runs = runs_of(file, count=200, seed=3)
    assert runs[:7] == runs_of(file, count=7, seed=3)
    assert runs_of(file, count=7, seed=4) != runs[:7]
    values = {name: [run.parameters[name] for run in runs] for name in parameters}
    assert all(1e-5 <= v <= 1e-1 for v in values["lr"])
    assert 60 < sum(v < 1e-3 for v in values["lr"]) < 140
    assert set(values["n"]) == {2, 3, 4}
    assert set(values["q"]) == {0.0, 0.25, 0.5, 0.75, 1.0}
    assert set(values["kind"]) == {"a"}
    assert len({run.name for run in runs}) == 200


def wandb_says(sweep_file, run) -> list[str]:
    """The command line of wandb's agent for this run, as `wandb_agent.Agent._command_run` makes it."""
    utils = pytest.importorskip("wandb.sdk.launch.sweeps.utils")
    words = utils.create_sweep_command(list(sweep_file.command))
    known = utils.create_sweep_command_args({"args": {name: {"value": value} for name, value in run.arguments.items()}})
    known |= {"interpreter": [sys.executable], "program": [sweep_file.program], "env": ["/usr/bin/env"]}
    out: list[str] = []
    for word in words:
        out += known.get(word[2:-1], []) if word.startswith("${") and word.endswith("}") else [word]
    return out


@pytest.mark.parametrize("macro", ["args", "args_no_equals", "args_no_hyphens", "args_no_boolean_flags", "args_json"])
def test_command_is_that_of_wandbs_agent(tmp_path, macro, monkeypatch):
    monkeypatch.setenv("PLACE", "here")
    command = ["${env}", "${interpreter}", "${program}", "at ${envvar:PLACE}!", 7, f"${{{macro}}}"]
    parameters = {
        "a": {"values": [True, False]},
        "b.c": {"value": "x y"},
        "d": {"parameters": {"e": {"values": [1.5]}, "f": {"value": None}}},
    }
    file = read_sweep(write(tmp_path, command=command, parameters=parameters))
    for run in runs_of(file):
        assert command_of(file, run, os.environ) == wandb_says(file, run)
        assert run.parameters == {"a": run.arguments["a"], "b.c": "x y", "d.e": 1.5, "d.f": None}


@pytest.mark.parametrize("path", SWEEPS, ids=lambda path: path.stem)
def test_the_sweeps_here_read_alike(path):
    assert len(SWEEPS) >= 6
    file = read_sweep(path)
    for run in runs_of(file):
        assert command_of(file, run, os.environ) == wandb_says(file, run)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"method": "bayes"}, ("bayes", "wandb")),
        ({"method": None}, ("method",)),
        ({"parameters": {}}, ("parameters",)),
        ({"parameters": {"a": 3}}, ("a", "3")),
        ({"parameters": {"a": {"valuez": [1]}}}, ("valuez",)),
        ({"parameters": {"a": {"values": []}}}, ("values",)),
        ({"parameters": {"a": {"min": 0.0, "max": 1.0}}}, ("grid", "uniform")),
        ({"method": "random", "parameters": {"a": {"min": "1e-4", "max": 1.0}}, "run_cap": 1}, ("min", "1e-4", "number")),
        ({"method": "random", "parameters": {"a": {"min": 2.0, "max": 1.0}}, "run_cap": 1}, ("min = 2.0",)),
        ({"method": "random", "parameters": {"a": {"distribution": "beta"}}, "run_cap": 1}, ("beta",)),
        ({"method": "random", "parameters": {"a": {"values": [1, 2], "probabilities": [1]}}, "run_cap": 1}, ("probabilities",)),
        ({"method": "random"}, ("--count",)),
        ({"command": "neuido fit"}, ("command",)),
        ({"command": ["neuido", "${argz}"]}, ("${argz}",)),
        ({"command": ["${envvar:NOWHERE_SET}"]}, ("NOWHERE_SET",)),
        ({"metric": {"goal": "minimize"}}, ("metric",)),
        ({"run_cap": 0}, ("run_cap",)),
        ({"sweeps": 1}, ("sweeps",)),
        ({"program": None}, ("program",)),
    ],
)
def test_mistakes_are_one_line(tmp_path, capsys, monkeypatch, change, words):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        main(["sweep", write(tmp_path, **change)])
    err = capsys.readouterr().err.strip()
    assert stop.value.code == 2
    assert len(err.splitlines()) == 1
    assert all(word in err for word in words), err


def test_file_that_is_none(tmp_path, capsys):
    path = tmp_path / "plan.yaml"
    path.write_text("!!python/object/apply:os.system ['touch evil']\n")
    with pytest.raises(UserError, match="not valid YAML"):
        sweep(str(path))
    with pytest.raises(UserError, match="shard = 2"):
        sweep(str(path), shard=2, shards=2)
    assert not Path("evil").exists()


def test_runs_are_collected_and_skipped(plan, tmp_path, capsys):
    assert sweep(plan, out=str(tmp_path / "out")) == 0
    assert "best loss: 1 (a-1)" in capsys.readouterr().out
    rows = table(tmp_path / "out")
    assert [(row["run"], row["status"], row["a"], row["loss"], row["acc"]) for row in rows] == [
        ("a-3", "done", "3", "9", "0.5"),
        ("a-1", "done", "1", "1", "0.5"),
        ("a-2", "done", "2", "4", "0.5"),
    ]
    assert list(rows[0])[:5] == ["run", "status", "seconds", "a", "loss"]
    assert started(tmp_path / "out") == ["3 offline a-3", "1 offline a-1", "2 offline a-2"]
    assert sweep(plan, out=str(tmp_path / "out")) == 0
    assert len(started(tmp_path / "out")) == 3
    assert table(tmp_path / "out") == rows


def test_stopping_early_is_said_to_be_left_out(plan, tmp_path, capsys):
    content = yaml.safe_load(Path(plan).read_text()) | {"early_terminate": {"type": "hyperband", "min_iter": 3}}
    Path(plan).write_text(yaml.safe_dump(content))
    assert sweep(plan, out=str(tmp_path / "out")) == 0
    assert "early_terminate" in capsys.readouterr().err
    assert len(table(tmp_path / "out")) == 3


def test_scores_are_means_of_the_last_stage(tmp_path):
    rows = [("Ball", "before", 9.0), ("Ball", "after", 3.0), ("Cat", "after", 5.0)]
    write_rows(tmp_path / "results" / "scores.csv", [{"scene": "Ball", "stage": "before", "cd": 9.0}])
    assert scored(tmp_path) == {"scores/cd": 9.0}  # of a method that learns nothing
    write_rows(tmp_path / "results" / "scores.csv", [{"scene": s, "stage": stage, "cd": cd} for s, stage, cd in rows])
    assert scored(tmp_path) == {"scores/cd": 4.0}
    write_rows(
        tmp_path / "results" / "test.csv",
        [{"scene": "Ball", "stage": "test", "cd": 7.0}, {"scene": "Cat", "stage": "test", "failed": "NaN"}],
    )
    assert scored(tmp_path) == {"scores/cd": 7.0, "scores/failed": 1.0}


def test_shards_share_the_runs(plan, tmp_path):
    out = tmp_path / "out"
    assert sweep(plan, out=str(out), shard=1, shards=2) == 0
    assert [row["run"] for row in table(out)] == ["a-1"]
    assert sweep(plan, out=str(out), shard=0, shards=2) == 0
    assert [row["run"] for row in table(out)] == ["a-3", "a-1", "a-2"]
    assert sorted(started(out)) == ["1 offline a-1", "2 offline a-2", "3 offline a-3"]


def test_failed_run_is_told_and_tried_again(plan, tmp_path, monkeypatch):
    out = tmp_path / "out"
    monkeypatch.setenv("FAIL", "1")
    assert sweep(plan, out=str(out)) == 1
    row = table(out)[1]
    assert (row["status"], row["loss"]) == ("failed", "")
    assert "cursed" in row["error"]
    assert table(out)[2]["status"] == "done"
    monkeypatch.setenv("FAIL", "nan")
    assert sweep(plan, out=str(out)) == 0
    assert [row["status"] for row in table(out)] == ["done"] * 3
    assert len(started(out)) == 4


def test_killed_run_starts_anew(plan, tmp_path):
    out = tmp_path / "out"
    sweep(plan, out=str(out))
    state = json.loads((out / "a-1" / "run.json").read_text())
    (out / "a-1" / "run.json").write_text(json.dumps(state | {"status": "started"}))  # as a killed one leaves it
    (out / "a-1" / "half-written").touch()
    sweep(plan, out=str(out))
    assert not (out / "a-1" / "half-written").exists()
    assert started(out)[3:] == ["1 offline a-1"]


def test_run_that_another_process_holds_is_left_alone(tmp_path):
    """A sweep that is killed leaves its run alive, and a second sweep leaves that run alone."""
    (tmp_path / "prog.py").write_text("import time, sys; print('running', flush=True); time.sleep(600)")
    path = write(tmp_path, command=[sys.executable, str(tmp_path / "prog.py"), "${args}"], parameters={"a": {"values": [1]}})
    out = tmp_path / "out"
    code = f"from neuido.commands.sweep import sweep; sweep({path!r}, out={str(out)!r})"
    first = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, start_new_session=True, stdout=subprocess.DEVNULL)
    try:
        log = out / "a-1" / "log.txt"
        wait_for(lambda: log.exists() and log.read_text(), first)
        first.kill()
        first.wait()
        assert sweep(path, out=str(out)) == 0
        assert [row["status"] for row in table(out)] == ["started"]
    finally:
        os.killpg(first.pid, signal.SIGKILL)


def test_foreign_folder_is_not_emptied(plan, tmp_path):
    mine = tmp_path / "out" / "a-3" / "mine.txt"
    mine.parent.mkdir(parents=True)
    mine.write_text("dear to me")
    with pytest.raises(UserError, match="--out"):
        sweep(plan, out=str(tmp_path / "out"))
    assert mine.read_text() == "dear to me"


def test_program_that_is_not_there(tmp_path):
    path = write(tmp_path, command=["no-such-program"], parameters={"a": {"values": [1]}})
    with pytest.raises(UserError, match="no-such-program"):
        sweep(path, out=str(tmp_path / "out"))


def test_own_folder():
    assert own_folder({}) is None
    assert own_folder({"NEUIDO_RUN": "/x", "WANDB_SWEEP_ID": "s", "WANDB_RUN_ID": "r"}) == Path("/x")
    assert own_folder({"WANDB_SWEEP_ID": "s", "WANDB_RUN_ID": "r"}) == Path("runs/sweeps/s/r")
    assert own_folder({"WANDB_RUN_ID": "r"}) is None


def test_redirect():
    from jsonargparse import Namespace

    csv_logger = Namespace(class_path="CSVLogger", init_args=Namespace(save_dir="runs", name="x"))
    odd = Namespace(class_path="Odd", init_args=Namespace(name="y"))
    arguments = Namespace(save_to="a/b.safetensors", out="runs/c", lr=1.0)
    options = Namespace(trainer=Namespace(logger=[csv_logger, odd]), model=Namespace(class_path="M", init_args=arguments))
    redirect(options, Path("run"))
    assert (csv_logger.init_args.save_dir, arguments.save_to, arguments.out) == ("run", "run/b.safetensors", "run/c")
    assert options.trainer.default_root_dir == "run"
    options = Namespace(trainer=Namespace(logger=False), model=Namespace(class_path="M", init_args=Namespace(save_to=None)))
    redirect(options, Path("run"))
    assert options.model.init_args.save_to is None


@pytest.mark.slow
def test_real_fits_with_wandb_offline(tmp_path):
    """A plain sweep file over `neuido fit`: everything goes to each run's folder, wandb's offline run included."""
    pytest.importorskip("wandb")
    options = ["--data.root", str(tmp_path / "data"), "--data.generate.instances=1", "--data.generate.particles_per_side=3",
               "--data.generate.steps=40", "--data.batch_size=90", "--trainer.max_epochs=1", "--trainer.limit_train_batches=4",
               "--trainer.enable_progress_bar=false", "--model.instance_steps=0", "--model.save_to=operator.safetensors"]  # fmt: skip
    configs = ["--config", "quickstart", "--config", "loggers/wandb"]
    path = write(
        tmp_path,
        command=["${env}", sys.executable, "-m", "neuido", "fit", *configs, *options, "${args}"],
        parameters={"model.latent_dim": {"values": [4]}},
        metric={"name": "val/stress_error"},
    )
    out = tmp_path / "out"
    before = os.environ.get("PYTHONPATH", "")
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (str(ROOT), before)))
    try:
        status = sweep(path, out=str(out))
    finally:
        os.environ["PYTHONPATH"] = before
    assert status == 0, (out / "latent_dim-4" / "log.txt").read_text()[-2000:]
    (row,) = table(out)
    assert 0 < float(row["val/stress_error"]) < 10
    assert (out / "latent_dim-4" / "operator.safetensors").is_file()
    assert list((out / "latent_dim-4").rglob("offline-run-*"))
    assert not (ROOT / "operator.safetensors").exists()


def test_runs_side_by_side_are_refused_before_anything_is_made(tmp_path, plan):
    for words, line in (({"engine": "slurm"}, "engine = 'slurm' is not known"), ({"engine": "local", "cpus": -1.0}, "cpus = -1 must be")):
        with pytest.raises(UserError, match=line):
            sweep(plan, out=str(tmp_path / "out"), **words)
        assert not (tmp_path / "out").exists()


def test_a_folder_that_cannot_be_made_leaves_none_above_it(tmp_path, plan):
    with pytest.raises(OSError, match="name too long"):
        sweep(plan, out=str(tmp_path / "a" / ("x" * 300)))
    assert not (tmp_path / "a").exists()


@pytest.mark.slow
def test_runs_side_by_side_end_as_one_after_the_other(tmp_path, plan, monkeypatch):
    monkeypatch.setenv("FAIL", "1")
    assert (
        sweep(plan, out=str(tmp_path / "one"), report=False) == sweep(plan, out=str(tmp_path / "many"), report=False, engine="local") == 1
    )
    rows = [[{**row, "seconds": ""} for row in table(tmp_path / name)] for name in ("one", "many")]
    assert rows[0] == rows[1] and [row["status"] for row in rows[0]] == ["done", "failed", "done"]
