"""The demonstration's experiment as `particles.csv` (t, id, x, y, z), from the file to the answer by what the commands themselves print."""

import json
import shlex

import pytest

from neuido.commands.demo.closed_loop import LAUNCHES, UNDECLARED, record
from neuido.commands.main import main

pytest.importorskip("pint")
pytestmark = pytest.mark.slow


def run(words, capsys):
    """Run a command; return its status and its lines."""
    with pytest.raises(SystemExit) as stop:
        main(words)
    said = capsys.readouterr()
    return stop.value.code or 0, (said.out + said.err).splitlines()


@pytest.mark.parametrize("guess", ["1e5", "6e5"])
def test_five_commands_lead_to_the_drag(guess, tmp_path, capsys, monkeypatch):
    """With a guess of the modulus that is nearly right, and one ten times too stiff."""
    monkeypatch.chdir(tmp_path)
    made = record(tmp_path / "truth", UNDECLARED, launches=LAUNCHES, side=4, frames=12)
    rows = [
        f"{take.name};{1e3 * t:.3f};P{i:02d};" + ";".join(f"{1e3 * value:.4f}" for value in place)
        for take in made.recordings
        for t, frame in zip(take.t.tolist(), take.x.tolist())
        for i, place in enumerate(frame)
    ]
    (tmp_path / "particles.csv").write_text("\n".join(["take;Zeit [ms];Punkt;X [mm];Y [mm];Z [mm]", *rows, ""]).replace(".", ","))
    status, said = run(["import", "particles.csv"], capsys)
    assert status == 2 and len(said) == 1 and all(option in said[0] for option in ("--density", "--young", "--out FOLDER"))
    status, said = run(["import", "particles.csv", "--density", "1000", "--young", guess, "--out", "cube"], capsys)
    text = "\n".join(said)
    assumed = ["at rest without stress in the first frame", "m^3 each", "mm apart", "Young's modulus", "(assumed: --poisson)"]
    for words in ("read as points on a deforming body", *assumed, "along -y (--up z", "no floor (--floor", "held out: particles-toss"):
        assert words in text
    proposed = next(line for line in said if line.startswith("next: "))
    commands = [shlex.split(command)[1:] for command in proposed.removeprefix("next: ").split("; ")]
    assert status == 0 and [command[0] for command in commands] == ["check", "diagnose"]
    assert run(commands[0], capsys)[0] == 0
    small = ["--effects", "drag_linear,gravity", "--solver", "material_points", "--effort", "quick", "--max_effects", "1", "--draws", "19"]
    assert run([*commands[1], *small, "--minutes", "0", "--progress", "false"], capsys)[0] == 0
    found = json.loads((tmp_path / "cube-answer" / "diagnosis.json").read_text())
    assert [effect["name"] for effect in found["effects"]] == ["drag_linear"]
    assert found["effects"][0]["parameters"]["k"]["value"] == pytest.approx(UNDECLARED["drag_linear.k"], rel=0.1)
