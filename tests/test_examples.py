"""Each example runs, answers what it promises, and stays short."""

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import neuido

ROOT = Path(neuido.__file__).parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("[0-9][0-9]_*.py"))
if not EXAMPLES:
    pytest.skip("the examples do not come with the installed package", allow_module_level=True)
ANSWERS = {  # what each must print
    "01": r"d height / d modulus [1-9]",
    "02": r"found (5\.[5-9]|6\.[0-4])\d*e\+04 Pa",
    "03": r"d height / d stiffness [1-9]",
    "04": r"-0\.\d+ m for each 1/s of drag",
    "05": r"d height / d modulus",
    "06": r"the methods end \d\.\d mm apart",
    "07": r"lacks strain stiffening",
    "08": r"lacks quadratic air drag",
    "09": r"torch\.Size\(\[6, 2, 160, 160, 3\]\)",
    "10": r"Young's modulus read from the video: \d+ kPa, Poisson's ratio 0\.\d+",
    "11": r"lacks linear air drag",
    "12": "",
    "13": r"d path / d friction -0\.\d+ m",
    "14": r"the ball sinks to 0\.\d+ m and ends at x = 0\.\d+ m",
    "15": r"slips 7\.\d+ cm, a rigid one 7\.35 cm\n.* with (6\.[7-9]|7\.[01])\d* N, friction times weight is 6\.89 N",
    "16": r"d force / d modulus [1-9]",
    "17": r"the period is 1\.2[2-7]\d s, that of a rigid pendulum 1\.250 s",
    "18": r"2[45]\d\d particles of 3\d{3} cm\^3; the ground feels up to \d+ N",
    "19": r"misses by 1\d\.\d+ cm\n(.*\n)+.*misses by 0\.[0-4]\d cm",
    "20": r"found (3\.9|4|4\.0)\d*e\+04 Pa",
    "21": r"100 % plasticine: mean height 1\d\.\d cm",
}


def test_each_example_has_an_answer():
    assert [path.name[:2] for path in EXAMPLES] == sorted(ANSWERS)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_shape(path):
    text = path.read_text()
    assert len(text.splitlines()) <= 62
    words = ast.get_docstring(ast.parse(text))
    title, line = words.splitlines()[:2]
    assert re.fullmatch(r"=+", line)
    assert len(line) >= len(title)
    assert f"python examples/{path.name}" in words, "it says how to run it"


@pytest.mark.slow
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_runs(path, tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "MPLBACKEND": "agg"}
    environment.pop("NEUIDO_DATA", None)
    done = subprocess.run([sys.executable, str(path)], capture_output=True, text=True, cwd=tmp_path, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    assert re.search(ANSWERS[path.name[:2]], done.stdout), done.stdout
    assert list(tmp_path.glob("*.png")), "it draws a picture for the gallery"
