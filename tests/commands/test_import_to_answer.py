"""From a raw table of an Instron, a Tracker export and an OptiTrack take to a diagnosis, by the three commands of docs/howto/import.md."""

import json

import numpy as np
import pytest
import torch

from neuido.commands.main import main
from neuido.physics.effects.parameters import Effects
from neuido.physics.laws.classical import NeoHookean
from neuido.physics.points.material_point import Specimen, stress_along

pytest.importorskip("pint")
pytestmark = pytest.mark.slow
RNG = np.random.default_rng(0)
YOUNG, STIFFENING = 1.2e6, 0.05
DRAG = 0.15  # 1/m, of a light ball
T = np.arange(46) / 60


def run(*words):
    with pytest.raises(SystemExit) as stop:
        main(list(map(str, words)))
    assert not stop.value.code


def answer_of(folder, files, *options):
    """Import, check and diagnose; return the content of diagnosis.json."""
    run("import", *files, *options, "--out", folder / "data")
    run("check", folder / "data")
    run("diagnose", folder / "data", "--out", folder / "answer", "--draws", 39, "--progress", "false")
    return json.loads((folder / "answer" / "diagnosis.json").read_text())


def instron(path, largest, effects):
    stretch = np.linspace(1, largest, 60)
    specimen = Specimen(NeoHookean(YOUNG, 0.499), None, effects, 1, True)
    stress = stress_along(specimen, "uniaxial", torch.from_numpy(stretch)[:, None])[0, :, 0].numpy()
    load = 20e-6 * (stress + 1.5e3 * RNG.standard_normal(60))
    head = [f'"Specimen label","{path.stem}"', '"Width","10.0","mm"', '"Thickness","2.0","mm"', '"Length","50.0","mm"', "",
            '"Extension","Load"', '"(mm)","(N)"']  # fmt: skip
    path.write_text("\r\n".join([*head, *(f'"{50 * (a - 1):.6f}","{f:.6f}"' for a, f in zip(stretch, load)), ""]))
    return path


@pytest.mark.parametrize("stiffens", [False, True])
def test_instron(tmp_path, stiffens):
    effects = Effects.of({"strain_stiffening.k": STIFFENING}) if stiffens else Effects()
    files = [instron(tmp_path / f"specimen-{i}.csv", largest, effects) for i, largest in enumerate((2.5, 2.2))]
    found = answer_of(tmp_path, files)
    named = [name for effect in found["effects"] for name in effect["class"]]
    assert "strain_stiffening" in named if stiffens else found["answer"] in ("none", "insufficient") and not named


def flight(velocity, drag):
    x, v, out, step = np.array([0.0, 1.5, 0.0]), np.array(velocity), [], 1 / 6000
    for _ in T:
        out.append(x)
        for _ in range(100):
            v = v + step * (np.array([0.0, -9.81, 0.0]) - drag * np.linalg.norm(v) * v)
            x = x + step * v
    return np.array(out) + 1e-3 * RNG.standard_normal((len(T), 3))


THROWS = ([6.0, 5.0, 0.5], [8.0, 4.0, -0.5], [7.0, 6.0, 1.0])


def tracker(path, x):
    """Two axes, a line with the name of the mass above the titles, a clock that starts at 12.3 s."""
    path.write_text("\n".join(["mass_A\t\t", "t\tx\ty", *(f"{12.3 + t:.9E}\t{a:.9E}\t{b:.9E}" for t, (a, b, _) in zip(T, x)), ""]))
    return path


def optitrack(path, x):
    head = ["Format Version,1.23,Take Name,Take 1,Length Units,Millimeters,Coordinate Space,Global", ",,Rigid Body,Rigid Body,Rigid Body",
            ",Name,ball,ball,ball", ",ID,1,1,1", ",,Position,Position,Position", "Frame,Time (Seconds),X,Y,Z"]  # fmt: skip
    rows = [f"{i},{t:.6f}," + ",".join(f"{1e3 * v:.4f}" for v in row) for i, (t, row) in enumerate(zip(T, x))]
    path.write_text("\n".join([*head, *rows, ""]))
    return path


@pytest.mark.parametrize(("make", "options"), [(tracker, ()), (optitrack, ("--point", "ball"))])
@pytest.mark.parametrize("drag", [0.0, DRAG])
def test_flights(tmp_path, make, options, drag):
    files = [make(tmp_path / f"throw{i}.csv", flight(velocity, drag)) for i, velocity in enumerate(THROWS)]
    found = answer_of(tmp_path, files, "--mass", 0.0027, "--diameter", 0.04, *options)
    named = [name for effect in found["effects"] for name in effect["class"]]
    assert "drag_quadratic" in named if drag else not named
    assert found["error"]["after"]["held_out"] < 3e-3
