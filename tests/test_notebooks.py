"""The notebooks run from top to bottom, at a small size, as scripts."""

import json
import os
import subprocess
import sys
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest

import neuido

ROOT = Path(neuido.__file__).parents[1]


def execute(name: str, out: Path, **environment: str) -> str:
    """Run a notebook as a script; what it printed."""
    own = {"MPLBACKEND": "Agg", "OMP_NUM_THREADS": "1", "NEUIDO_NOTEBOOK_SMALL": "1", "NEUIDO_NOTEBOOK_OUT": str(out), **environment}
    path = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    command = [sys.executable, str(ROOT / "notebooks" / f"{name}.py")]
    done = subprocess.run(command, env={**os.environ, "PYTHONPATH": path, **own}, cwd=out.parent, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


@pytest.fixture(scope="module")
def closed_loop(tmp_path_factory):
    """The folder of a run without measured data, and what it printed."""
    out = tmp_path_factory.mktemp("notebook") / "out"
    return out, execute("closed_loop", out, NEUIDO_DATA="")


@pytest.mark.slow
def test_closed_loop(closed_loop):
    out, printed = closed_loop
    answer, again = (line for line in printed.splitlines() if "held-out error" in line)
    assert answer.startswith(("effect: ", "class: ")) and "(drag_linear)" in answer.partition(";")[0]
    assert again.startswith("none; ")
    assert "set NEUIDO_DATA" in printed
    assert matplotlib.image.imread(out / "block.png").std() > 0.05
    assert not (out / "rubber.png").exists()


@pytest.mark.parametrize("path", sorted((ROOT / "notebooks").glob("*.py")), ids=lambda path: path.stem)
def test_cells_are_well_formed(path):
    """Every cell begins with the marker of the percent format, and each one compiles alone."""
    text = path.read_text()
    cells = text.split("\n# %%")[1:]
    assert sum(cell.startswith(" [markdown]") for cell in cells) >= 4
    for cell in cells:
        kind, _, body = cell.partition("\n")
        if kind == " [markdown]":
            assert all(not line or line.startswith("#") for line in body.splitlines())
        else:
            compile(body, "cell", "exec")


@pytest.mark.slow
def test_closed_loop_on_rubber(data_root, tmp_path):
    """The real case: stiffening, and a much better extrapolation."""
    execute("closed_loop", tmp_path / "out", NEUIDO_DATA=str(data_root))
    content = json.loads((tmp_path / "out" / "rubber" / "diagnosis.json").read_text())
    assert "strain_stiffening" in content["effects"][0]["class"]
    assert content["error"]["after"]["held_out"] < 0.2 * content["error"]["before"]["held_out"]
    assert matplotlib.image.imread(tmp_path / "out" / "rubber.png").std() > 0.05


@pytest.mark.slow
def test_latent_space(tmp_path):
    pytest.importorskip("sklearn")
    printed = execute("latent_space", tmp_path / "out")
    raw, laws = (float(next(line for line in printed.splitlines() if line.startswith(name)).split()[1]) for name in ("raw", "laws"))
    assert min(raw, laws) > 0.3
    for name in ("tsne", "directions"):
        assert matplotlib.image.imread(tmp_path / "out" / f"{name}.png").std() > 0.05


@pytest.mark.slow
def test_interpolation(tmp_path):
    printed = execute("interpolation", tmp_path / "out")
    for name in ("small-strain modulus [Pa]", "greatest compression", "contact time [s]"):
        assert f"{name}: Spearman 1.000, 100 % of the steps" in printed
    assert "sand" in printed
    for name in ("motion", "stiffness"):
        assert matplotlib.image.imread(tmp_path / "out" / f"{name}.png").std() > 0.05


def test_notebooks_read_what_the_command_wrote(tmp_path):
    """With the tables there, nothing is computed anew."""
    rows = "measure,steps,spearman,back\nmodulus,1,0.95,0\ncompression,1,-0.5,0\ncontact,1,0.25,0\n"
    out = tmp_path / "out"
    out.mkdir()
    (out / "monotonicity.csv").write_text(rows)
    (out / "interpolation.csv").write_text("share,modulus,compression,contact\n0,1,2,3\n1,2,1,2\n")
    (out / "pairs.csv").write_text("family,pairs,monotone,steps,spearman\nfoam,3,1,1,1\n")
    np.savez(out / "interpolation.npz", x=np.random.default_rng(0).random((5, 2, 10, 3)), shares=[0.0, 1.0], names=["a", "b"])
    printed = execute("interpolation", out)
    assert "Spearman -0.500" in printed
    assert "foam" in printed
