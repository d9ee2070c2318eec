"""The command line: help without torch, and one line with status 2 for whatever the user can mend."""

import functools
import io
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
import torch

import neuido
from neuido.commands import main as cli
from neuido.commands.cli.config_files import find_configs
from neuido.commands.main import main
from neuido.commands.simulation.trajectories import trajectories
from neuido.errors import one_line
from tests.command import run

ROOT = Path(neuido.__file__).parents[1]
STAGE1 = str(neuido.configs_root() / "stage1.yaml")


def assert_one_line(capsys, args: list[str], *words: str) -> None:
    status, _, err = run(capsys, *args)
    lines = [line for line in err.splitlines() if line.strip()]
    assert status == 2, err
    assert len(lines) == 1, err
    assert lines[0].startswith("neuido: ")
    assert len(lines[0]) < 400
    for word in words:
        assert word in lines[0]


HELP = ["--help", "--version", *[f"{name} --help" for name in cli.LIGHT], "fit --help", "test --config adapt --help"]


@pytest.fixture(scope="module")
def helped():
    """What each command of `HELP` prints and loads, in a fork each of a fresh process that has imported the command line alone."""
    code = """
import contextlib, io, json, os, sys
from neuido.commands.main import main

for words in json.loads(sys.argv[1]):
    sys.stdout.flush()
    if os.fork():
        os.wait()
        continue
    streams = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(streams[0]), contextlib.redirect_stderr(streams[1]):
        try:
            main(words.split())
        except SystemExit as stop:
            status = stop.code
    print(json.dumps([words, status, *(each.getvalue() for each in streams), sorted({"torch", "lightning", "warp"} & set(sys.modules))]))
    sys.stdout.flush()
    os._exit(0)
"""
    answer = subprocess.run([sys.executable, "-c", code, json.dumps(HELP)], capture_output=True, text=True, cwd=ROOT, check=True)
    assert not answer.stderr
    return {words: rest for words, *rest in map(json.loads, answer.stdout.splitlines())}


@pytest.mark.parametrize("name", HELP)
def test_help_loads_no_torch(helped, name):
    status, out, err, loaded = helped[name]
    assert status == 0 and loaded == [] and "neuido" in out and err == ""


def test_help_names_every_command(capsys):
    status, out, _ = run(capsys, "--help")
    assert status == 0
    for name in [*cli.LIGHT, *cli.HEAVY]:
        assert f"\n  {name} " in out


def test_light_help_comes_from_the_docstring(capsys):
    status, out, _ = run(capsys, "trajectories", "--help")
    assert status == 0
    for word in ("neuido trajectories", "--config", "--print_config", "--held_out", "Time of a substep, s."):
        assert word in out


def test_version(capsys):
    assert run(capsys, "--version") == (0, f"neuido {neuido.__version__}\n", "")


def test_module_and_script_are_one_command():
    answer = subprocess.run([sys.executable, "-m", "neuido", "simlate"], capture_output=True, text=True, cwd=ROOT)
    assert answer.returncode == 2
    known = ", ".join([*cli.HEAVY, *cli.LIGHT])
    assert answer.stderr == f"neuido: unknown command 'simlate', did you mean 'simulate'? The commands are {known}\n"


def test_a_device_without_memory_is_one_line(capsys, monkeypatch):
    @functools.wraps(trajectories)
    def full(**options):
        raise RuntimeError("CUDA error: out of memory\nFor debugging consider passing CUDA_LAUNCH_BLOCKING=1")

    monkeypatch.setattr("neuido.commands.simulation.trajectories.trajectories", full)
    assert_one_line(capsys, ["trajectories", "--out", "x"], "no memory left", "CUDA error: out of memory)", "CPU")


def test_light_wrong_key_on_the_command_line(capsys):
    assert_one_line(capsys, ["trajectories", "--out", "x", "--instancez", "3"], "instancez")


@pytest.mark.parametrize(("wrong", "meant"), [("devic", "device"), ("particlez", "particles"), ("seedd", "seed")])
def test_light_wrong_name_is_answered_with_the_one_that_was_meant(capsys, tmp_path, wrong, meant):
    assert_one_line(capsys, ["film", "--out", "x", f"--{wrong}", "3"], f"--{wrong}", f"did you mean '{meant}'?")
    path = tmp_path / "wrong.yaml"
    path.write_text(f"out: x\n{wrong}: 3\n")
    assert_one_line(capsys, ["film", "--config", str(path)], f"'{wrong}'", f"did you mean '{meant}'?")


def test_light_abbreviation_is_refused(capsys, tmp_path):
    assert_one_line(capsys, ["trajectories", "--out", str(tmp_path / "x"), "--instanc", "3"], "instanc")
    assert not (tmp_path / "x").exists()


def test_light_wrong_key_in_yaml(capsys, tmp_path):
    path = tmp_path / "wrong.yaml"
    path.write_text("out: x\ninstancez: 3\n")
    assert_one_line(capsys, ["trajectories", "--config", str(path)], "instancez")


def test_light_wrong_type(capsys):
    assert_one_line(capsys, ["trajectories", "--out", "x", "--instances", "many"], "instances", "int", "many")


def test_light_missing_option(capsys):
    assert_one_line(capsys, ["trajectories"], "--out")


def test_broken_yaml(capsys, tmp_path):
    path = tmp_path / "broken.yaml"
    path.write_text("out: [\n a: b: c\n")
    assert_one_line(capsys, ["trajectories", "--config", str(path)], "line 2")


def test_yaml_is_read_safely(capsys, tmp_path):
    path, victim = tmp_path / "evil.yaml", tmp_path / "victim"
    path.write_text(f"out: !!python/object/apply:pathlib.Path.touch [!!python/object/apply:pathlib.Path ['{victim}']]\n")
    status, _, _ = run(capsys, "trajectories", "--config", str(path))
    assert status == 2
    assert not victim.exists()


@pytest.mark.parametrize("command", ["trajectories", "fit"])
def test_missing_configuration(capsys, command):
    assert_one_line(capsys, [command, "--config", "nowhere.yaml"], "nowhere.yaml", "--config")


def test_missing_configuration_of_the_demo(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert_one_line(capsys, ["demo", "--settings", "nowhere"], "nowhere", "--settings")
    assert not list(tmp_path.iterdir())
    (tmp_path / "runs" / "demo").mkdir(parents=True)  # a demonstration that was made hides the mistake no more
    (tmp_path / "runs" / "demo" / "demo.json").write_text('{"settings": "quickstart"}')
    assert_one_line(capsys, ["demo", "--settings", "nowhere"], "nowhere", "--settings")


def test_configurations_that_come_with_neuido_are_found_from_anywhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("configs/stage1.yaml", "stage1.yaml", "stage1"):
        assert find_configs(["fit", "--config", name, f"--config={name}"]) == ["fit", "--config", STAGE1, f"--config={STAGE1}"]
    Path("stage1.yaml").touch()
    assert find_configs(["-c", "stage1.yaml"]) == ["-c", "stage1.yaml"]


@pytest.mark.parametrize(
    "families",
    [
        "{elastic: {young: [-1.0e5, -1.0e5], poisson: [0.2, 0.2]}}",
        "{elastic: {young: [1.0e5, 1.0e5], poisson: [0.5, 0.5]}}",
    ],
)
def test_impossible_material(capsys, tmp_path, families):
    args = ["trajectories", "--out", str(tmp_path / "out"), "--families", families]
    assert_one_line(capsys, args, "young" if "-1.0e5" in families else "poisson", "-100000" if "-1.0e5" in families else "0.5")


def test_step_above_the_stability_limit(capsys, tmp_path):
    args = [
        "trajectories",
        "--out",
        str(tmp_path / "out"),
        "--setup.dt",
        "0.1",
        "--setup.steps",
        "2",
        "--instances",
        "1",
        "--held_out",
        "0",
    ]
    assert_one_line(capsys, [*args, "--setup.particles_per_side", "3", "--progress", "false", "--device", "cpu"], "dt", "0.1")


@pytest.mark.parametrize("words", [["--help"], ["trajectories", "--out", "out", "--print_config"]])
@pytest.mark.parametrize(("stream", "status"), [("/dev/full", 2), (None, 128 + 13)])
def test_stdout_that_cannot_be_written_is_one_line_and_stderr_may_be_gone(stream, status, words):
    """In a fork, whose own stdout is full or closed, and stderr closed."""
    child = os.fork()
    if child == 0:
        code: object = 99
        try:
            if stream:
                os.dup2(os.open(stream, os.O_WRONLY), 1)
            for number in (1, 2) if stream is None else (2,):
                reads, writes = os.pipe()
                os.close(reads)
                os.dup2(writes, number)
            sys.stdout, sys.stderr = (open(number, "w", closefd=False) for number in (1, 2))
            main(words)
        except SystemExit as stop:
            code = stop.code
        finally:
            os._exit(int(str(code)))
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == status


@pytest.mark.parametrize(
    ("error", "word"),
    [
        (ValueError("embedded null byte"), "null character"),
        (UnicodeEncodeError("utf-8", "a\ud800", 1, 2, "surrogates not allowed"), "cannot be written as utf-8"),
        (ValueError("Does not validate against any of the Union subtypes\nSubtypes: [x]\nErrors:\n  - root is null\n"), "root is null"),
    ],
)
def test_names_and_values_that_no_reader_expects_are_one_line(error, word):
    line = one_line(error)
    assert line is not None and word in line and "\n" not in line and "Subtypes" not in line


def test_output_in_an_encoding_that_lacks_a_character(monkeypatch):
    written = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(written, encoding="ascii"))
    monkeypatch.setattr(cli, "_help", lambda: "5 m² … done")
    with pytest.raises(SystemExit) as stop:
        main(["--help"])
    assert stop.value.code == 0 and written.getvalue() == b"5 m? ? done\n"


def test_interrupt(capsys, monkeypatch):
    def interrupted(args):
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "_dispatch", interrupted)
    assert run(capsys, "doctor") == (130, "", "neuido: interrupted\n")


def test_fault_of_the_program_keeps_its_traceback(capsys, monkeypatch, tmp_path):
    def broken(args):
        return [][3] + len("x" * 400)

    monkeypatch.setattr(cli, "_dispatch", broken)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    status, out, err = run(capsys, "doctor")
    assert (status, out) == (70, "") and err.count("\n") == 1 and len(err) <= 320 and "IndexError" in err
    (log,) = tmp_path.iterdir()
    assert str(log) in err and "in broken" in log.read_text() and "IndexError" in log.read_text()


def test_traceback_on_demand(monkeypatch):
    monkeypatch.setenv("NEUIDO_TRACEBACK", "1")
    with pytest.raises(ValueError, match="unknown command"):
        main(["doktor"])


class TestLightning:
    """The commands of the trainer; importing Lightning takes some seconds once."""

    def test_wrong_key_in_yaml(self, capsys, tmp_path):
        path = tmp_path / "wrong.yaml"
        path.write_text(Path(STAGE1).read_text() + "\nmodell:\n  lr: 1\n")
        assert_one_line(capsys, ["fit", "--config", str(path)], "modell")

    def test_wrong_model_option(self, capsys):
        assert_one_line(capsys, ["fit", "--config", STAGE1, "--model.latent_dimm", "3"], "latent_dimm")

    def test_wrong_model_type(self, capsys):
        assert_one_line(capsys, ["fit", "--config", STAGE1, "--model.latent_dim", "many"], "latent_dim", "int", "many")

    def test_wrong_choice(self, capsys):
        assert_one_line(capsys, ["fit", "--config", STAGE1, "--model.trunk", "cooked"], "trunk", "one of 'raw', 'objective'", "cooked")

    def test_wrong_trainer_option(self, capsys):
        assert_one_line(capsys, ["fit", "--config", STAGE1, "--trainer.max_epochz", "3"], "--trainer.max_epochz")

    def test_abbreviation_is_refused(self, capsys):
        assert_one_line(capsys, ["fit", "--config", STAGE1, "--trainer.max_epoch", "3"], "--trainer.max_epoch")

    def test_wrong_trainer_type(self, capsys):
        assert_one_line(capsys, ["fit", "--config", STAGE1, "--trainer.max_epochs", "many"], "--trainer.max_epochs", "many")

    @pytest.mark.parametrize("name", ["Nowhere", "neuido.models.stages.pretrain.Nowhere", "nowhere.Model"])
    def test_unknown_class(self, capsys, name):
        assert_one_line(capsys, ["fit", "--model", name, "--data", "TrajectoryDataModule"], "owhere")

    def test_nothing_given(self, capsys):
        assert_one_line(capsys, ["fit"], "model", "data")

    def test_missing_trajectories(self, capsys, tmp_path):
        assert_one_line(capsys, ["fit", "--config", STAGE1, "--data.root", str(tmp_path)], str(tmp_path), "neuido trajectories")

    def test_checkpoint_is_read_weights_only(self, capsys, tmp_path):
        checkpoint, victim = tmp_path / "evil.ckpt", tmp_path / "victim"

        class Evil:
            def __reduce__(self):
                return (Path.touch, (victim,))

        torch.save({"state_dict": {}, "hyper_parameters": Evil()}, checkpoint)
        assert_one_line(capsys, ["fit", "--config", STAGE1, "--ckpt_path", str(checkpoint)], "weights-only")
        assert not victim.exists()

    @pytest.mark.parametrize(("content", "word"), [(None, "no such file"), (b"junk", "not a checkpoint")])
    def test_no_checkpoint(self, capsys, tmp_path, content, word):
        path = tmp_path / "run.ckpt"
        if content is not None:
            path.write_bytes(content)
        assert_one_line(capsys, ["fit", "--config", STAGE1, "--ckpt_path", str(path)], "ckpt_path", str(path), word)

    def test_checkpoint_that_is_cut_short(self, capsys, tmp_path):
        path = tmp_path / "run.ckpt"
        torch.save({"state_dict": {"weight": torch.zeros(1000)}}, path)
        path.write_bytes(path.read_bytes()[:2000])
        assert_one_line(capsys, ["fit", "--config", STAGE1, "--ckpt_path", str(path)], "ckpt_path", "cut short")

    def test_help(self, capsys):
        status, out, _ = run(capsys, "fit", "--help")
        assert status == 0
        assert "neuido" in out
        assert "--ckpt_path" in out
        assert "--optimizer" not in out


def test_causes_in_a_circle_end():
    inner, outer = ValueError("inner"), OSError("outer")
    inner.__cause__, outer.__cause__ = outer, inner
    assert one_line(outer) == "outer"
