"""`neuido export`: each kind of run and of law to a file, and one line for what cannot be exported."""

import json

import numpy as np
import pytest
import torch

import neuido
from neuido.data.formats.ply import read_ply_vertices
from tests.commands.test_simulate import run

K, P, DT = 3, 6, 0.05
X = np.random.default_rng(0).random((1, P, 3)).astype(np.float32) + 0.1 * np.arange(K, dtype=np.float32)[:, None, None]
MODEL = "density: 1000.0\nelasticity: {law: sigma, young: 2.0e+5, poisson: 0.3}\nplasticity: {law: identity}\n"


@pytest.fixture
def runs(tmp_path):
    """A folder of a simulation, of a prediction and of a diagnosis, with files that hold what these commands write."""
    F = np.tile(np.eye(3, dtype=np.float32), (K, P, 1, 1))
    (tmp_path / "simulated").mkdir()
    times = DT * np.arange(K)
    np.savez(tmp_path / "simulated" / "frames.npz", x=X, v=X, C=F, F=1.1 * F, times=times, scene=np.zeros(P, np.int32))
    from neuido.models import write_particles
    from neuido.types import ParticleState

    for name in ("ball", "cube"):
        state = ParticleState(torch.from_numpy(X + (name == "cube")), torch.zeros(K, P, 3), None, None)
        write_particles(tmp_path / "predicted_run" / name / "particles", state)
    found = tmp_path / "found"
    (found / "predicted").mkdir(parents=True)
    (found / "diagnosis.json").write_text(json.dumps({"experiment": "throw"}))
    (found / "model_after.yaml").write_text(MODEL + "effects: {viscosity_shear.eta: 20.0, drag_linear.k: 0.4}\n")
    measured = X.copy()
    measured[1, 2] = np.nan
    np.savez(found / "predicted" / "first.npz", positions=np.array(1), t=times, measured=measured, before=X + 1, after=X + 2)
    return tmp_path


def test_each_kind_of_run_is_exported(runs, capsys):
    status, printed, _ = run(capsys, "export", runs / "simulated", "--to", "ply", "--out", runs / "a" / "motion")
    assert status == 0 and f"exported simulated: {K} frames of {P} particles, 0.1 s\nresults in {runs}/a/motion_0000.ply" in printed
    assert read_ply_vertices(runs / "a" / "motion_0002.ply")["volume_ratio"] == pytest.approx(1.331, rel=1e-5)

    status, printed, _ = run(capsys, "export", runs / "predicted_run", "--to", "npz", "--out", runs / "b.npz", "--frame_interval", 0.02)
    assert status == 0 and "note: one of 2: --recording chooses from ball, cube" in printed
    with np.load(runs / "b.npz") as archive:
        assert np.array_equal(archive["x"], X) and archive["times"] == pytest.approx([0.0, 0.02, 0.04])
    run(capsys, "export", runs / "predicted_run", "--to", "npz", "--out", runs / "c", "--frame_interval", 0.02, "--recording", "cube")
    with np.load(runs / "c.npz") as archive:
        assert np.array_equal(archive["x"], X + 1)

    for when, added, count in (("after", 2, P), ("before", 1, P), ("measured", 0, P - 1)):
        status, printed, _ = run(capsys, "export", runs / "found", "--to", "npz", "--out", runs / f"{when}.npz", "--when", when)
        assert status == 0 and ("1 points that were not seen in all frames are left out" in printed) == (when == "measured")
        with np.load(runs / f"{when}.npz") as archive:
            assert archive["x"].shape == (K, count, 3) and archive["x"][:, 0] == pytest.approx(X[:, 0] + added)
            assert archive["v"] == pytest.approx(2.0, rel=1e-4)  # 0.1 m a frame


def test_stress_is_that_of_the_law(runs, capsys):
    (runs / "model.yaml").write_text(MODEL)
    assert run(capsys, "export", runs / "simulated", "--to", "ply", "--out", runs / "s.ply", "--law", runs / "model.yaml")[0] == 0
    assert np.abs(read_ply_vertices(runs / "s_0001.ply")["stress"]).max() < 1.0  # F = 1.1 I has no deviator


def test_laws_are_exported(runs, capsys):
    status, printed, _ = run(
        capsys, "export", runs / "found", "--to", "abaqus", "--out", runs / "rubber", "--units", "mm", "--name", "rubber"
    )
    assert status == 0 and f"results in {runs}/rubber.inp" in printed
    card = (runs / "rubber.inp").read_text()
    assert "*MATERIAL, NAME=rubber" in card and "\n0.2, 0.3\n" in card and "model it in the scene: drag_linear" in card
    torch.manual_seed(0)
    operator = neuido.Operator("objective", latent_dim=4, basis_dim=4, hidden_dim=8, head_dim=8)
    from neuido.models import save_law

    save_law(runs / "law.safetensors", operator, torch.randn(4))
    status, _, _ = run(
        capsys, "export", runs / "law.safetensors", "--to", "c", "--out", runs / "law", "--name", "rubber", "--tangent", "true"
    )
    assert status == 0 and "rubber_tangent(const double F[9], double out[81])" in (runs / "law.h").read_text()
    status, _, _ = run(capsys, "export", runs / "law.safetensors", "--to", "torchscript", "--out", runs / "law")
    assert status == 0 and (runs / "law.pt").is_file()


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ("{none} --to usd --out {out}", "none is missing: give a folder of `neuido simulate`"),
        ("{simulated} --to usd --out {out}.glb", "the ending of usd is .usd or .usdc or .usda"),
        ("{simulated} --to usb --out {out}", "usd"),
        ("{predicted} --to usd --out {out}", "has no times: give --frame_interval"),
        ("{predicted} --to usd --out {out} --frame_interval -1", "frame_interval is -1"),
        ("{predicted} --to usd --out {out} --frame_interval 1 --recording bal", "did you mean 'ball'"),
        ("{simulated} --to abaqus --out {out} --surface true", "surface is an option of motions"),
        ("{simulated} --to usd --out {out} --tangent true", "tangent is no option of --to usd"),
        ("{simulated} --to abaqus --out {out}", "holds no model"),
        ("{found} --to c --out {out}", "a classical one: give --to abaqus"),
        ("{found} --to abaqus --out {out} --name 2", "a material's name starts with a letter"),
        ("{model} --to usd --out {out}", "is no motion"),
        ("{simulated} --to npz --out {out} --cameras {found}", "found"),
    ],
)  # fmt: skip
def test_what_cannot_be_exported_is_one_line(words, line, runs, capsys):
    names = {"none": "none", "simulated": "simulated", "predicted": "predicted_run", "found": "found", "model": "found/model_after.yaml"}
    paths = {name: runs / path for name, path in names.items()} | {"out": runs / "new" / "out"}
    status, _, err = run(capsys, "export", *words.format(**paths).split())
    assert status == 2 and line in err and err.count("\n") == 1
    assert not (runs / "new").exists()


def test_stress_is_that_of_each_bodys_law(runs, capsys):
    law = "{density: 1000.0, elasticity: {law: sigma, young: %s, poisson: 0.3}, plasticity: {law: identity}}"
    bodies = ", ".join(f"{{name: b{i}, model: {law % young}}}" for i, young in enumerate(("1.0e+5", "3.0e+5")))
    room = "domain: [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]], gravity: [0.0, -9.8, 0.0]"
    scene = f"format: neuido-scene/1\nscene: {{{room}}}\ndiscretisation: {{grid: 20, dt: 1.0e-4}}\nbodies: [{bodies}]\n"
    (runs / "simulated" / "scene.yaml").write_text(scene)
    F = np.tile(np.diag([1.2, 1.0, 1.0]).astype(np.float32), (K, P, 1, 1))
    np.savez(runs / "simulated" / "frames.npz", x=X, F=F, times=DT * np.arange(K), body=np.arange(P, dtype=np.int32) % 2)
    status, _, told = run(capsys, "export", runs / "simulated", "--to", "ply", "--out", runs / "s.ply")
    assert status == 0, told
    stress = read_ply_vertices(runs / "s_0001.ply")["stress"]
    assert stress[0] > 1e3 and stress == pytest.approx(np.tile([stress[0], 3 * stress[0]], P // 2), rel=1e-5)


def test_predictions_have_the_times_of_their_frames(runs, capsys):
    from neuido.models import write_particles
    from neuido.types import ParticleState

    state = ParticleState(torch.from_numpy(X), torch.zeros(K, P, 3), None, None)
    folder = runs / "timed" / "ball" / "particles"
    write_particles(folder, state, torch.tensor([0.0, 0.04, 0.08]))
    status, _, told = run(capsys, "export", runs / "timed", "--to", "npz", "--out", runs / "t.npz")
    assert status == 0, told
    with np.load(runs / "t.npz") as archive:
        assert archive["times"] == pytest.approx([0.0, 0.04, 0.08])
    (folder / "times.csv").write_text("frame,time [s]\n0,0\n1,soon\n2,0.08\n")
    status, _, told = run(capsys, "export", runs / "timed", "--to", "npz", "--out", runs / "u.npz")
    assert status == 2 and "times.csv must have two columns of numbers" in told
