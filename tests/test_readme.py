"""What the README says can be done can be done: its commands, its Python, its links, its tables."""

import ast
import csv
import math
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

import neuido
from neuido.commands import main as cli
from neuido.discrepancy import judging
from neuido.discrepancy.laboratory import LEAST_GAIN

ROOT = Path(neuido.__file__).parents[1]
README = ROOT / "README.md"
if not README.is_file():
    pytest.skip("the README does not come with the installed package", allow_module_level=True)
TEXT = README.read_text()
CHEAP = ("--help", "--print_config", "--device cpu", "--trainer.max_steps", "doctor")
"""A command that has one of these is run as it stands; another is only read by the command line that it is for."""


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", TEXT, flags=re.MULTILINE | re.DOTALL)


def commands(program: str) -> list[str]:
    lines = (line.split(" #")[0].strip() for block in blocks("bash") for line in block.splitlines())
    return [line for line in lines if line.split()[:1] == [program]]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Where the commands run one after the other: they build on what the ones before have written."""
    return tmp_path_factory.mktemp("readme")


def test_there_are_commands():
    assert len(commands("neuido")) > 10
    assert sum(any(mark in command for mark in CHEAP) for command in commands("neuido")) >= 6
    assert len(blocks("python")) >= 5


@pytest.mark.parametrize("command", commands("neuido"))
def test_command(command, folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    monkeypatch.delenv("NEUIDO_DATA", raising=False)
    args = shlex.split(command)[1:]
    cheap = any(mark in command for mark in CHEAP)
    with pytest.raises(SystemExit) as stop:
        cli.main(args if cheap else [*args, "--print_config"])
    out, err = capsys.readouterr()
    assert stop.value.code == 0, err
    if not cheap:  # what the command line would run has the values of the README
        for value in re.findall(r"--[\w.]+ ([\w.e-]+)$", command):
            assert value in out


def test_python(folder, monkeypatch):
    """The snippets in their order, in one namespace, beside the YAML files that the README shows."""
    monkeypatch.chdir(folder)
    for block in blocks("yaml"):
        name = re.match(r"# (\S+\.yaml)\n", block)
        assert name is not None, "a YAML block starts with its file name"
        Path(name[1]).write_text(block)
    space: dict = {}
    for snippet in blocks("python"):
        if snippet.startswith("# needs data"):  # then what it imports must be there
            body = [node for node in ast.parse(snippet).body if isinstance(node, ast.ImportFrom)]
            assert body
            exec(compile(ast.Module(body, []), "README.md", "exec"), {})
            continue
        exec(compile(snippet, "README.md", "exec"), space)
        assert space["frames"].x.isfinite().all()
    assert space["young"].grad.abs().item() > 0
    assert space["heights"].diff().abs().min() > 0
    assert space["stiffness"].grad.abs().item() > 0
    assert space["frames"].x.shape[0] == 21
    assert space["moduli"].grad.abs().min() > 0
    assert space["images"].shape == (21, 2, 100, 100, 3)
    assert space["alphas"].max() > 0.5


@pytest.mark.parametrize("command", commands("python"))
def test_benchmark(command):
    script, *options = shlex.split(command)[1:]
    answer = subprocess.run([sys.executable, script, "--help"], capture_output=True, text=True, cwd=ROOT, check=True)
    for option in options:
        assert not option.startswith("--") or option in answer.stdout


def test_make_and_pip():
    targets = re.search(r"^\.PHONY:(.*)$", (ROOT / "Makefile").read_text(), flags=re.MULTILINE)[1].split()
    for command in commands("make"):
        assert command.split()[1] in targets
    constraints = (ROOT / "constraints.txt").read_text().splitlines()
    for command in commands("pip"):
        words = shlex.split(command)
        for word in words:
            if "==" in word:
                assert word in constraints
            if word.endswith(".txt"):
                assert (ROOT / word).is_file()


@pytest.mark.parametrize("name", ["README.md", "CONTRIBUTING.md", "CHANGELOG.md", "LOG.md", "neuido/models/weights/README.md"])
def test_links(name):
    text = (ROOT / name).read_text()
    headings = {re.sub(r"[^\w -]", "", h.lower()).replace(" ", "-") for h in re.findall(r"^#+ (.+)$", text, flags=re.MULTILINE)}
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if target.startswith("#"):
            assert target[1:] in headings
        elif not target.startswith("http"):
            assert (ROOT / name).parent.joinpath(target).exists()


def rows(title: str) -> list[list[str]]:
    """The cells of the body of the table below a heading, without emphasis."""
    section = TEXT.split(f"\n### {title}\n")[1].split("\n#")[0]
    lines = [line for line in section.splitlines() if line.startswith("| ")][2:]
    return [[cell.strip().strip("*") for cell in line.strip("|").split("|")] for line in lines]


def test_stage1_table_is_the_measured_one():
    measured = {}
    for line in (ROOT / "benchmarks" / "results" / "stage1.md").read_text().splitlines()[2:]:
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        measured[tuple(cells[:3])] = [float(cell) for cell in cells[3:] if cell]
    quoted = {tuple(cells[:3]): [float(cell) for cell in cells[3:] if cell] for cells in rows("Stage I")}
    assert quoted.keys() == measured.keys()
    for key, values in quoted.items():
        assert values == pytest.approx(measured[key], rel=1e-2), key


def test_law_table_is_the_measured_one():
    with (ROOT / "benchmarks" / "results" / "laws.csv").open() as file:
        measured = {(row["body"], row["material"]): (float(row["ours"]), float(row["nclaw"])) for row in csv.DictReader(file)}
    *bodies, total = rows("The learned laws on real bodies")
    assert len(bodies) == 10
    for body, *cells in bodies:
        expected = [value for material in ("jelly", "plasticine", "sand") for value in measured[body, material]]
        assert [float(cell) for cell in cells] == pytest.approx(expected, rel=5e-3, abs=6e-4)
    for i, material in enumerate(("jelly", "plasticine", "sand")):
        for j in range(2):
            squares = [pair[j] ** 2 for (_, name), pair in measured.items() if name == material]
            assert float(total[1 + 2 * i + j]) == pytest.approx(math.sqrt(sum(squares) / 10), rel=5e-3, abs=6e-4)


def printed(name: str) -> list[list[str]]:
    """The rows of a table in benchmarks/results, its header first."""
    text = (ROOT / "benchmarks" / "results" / name).read_text().replace("^2", "²")
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line.startswith("| ")]


def test_rollout_table_is_the_measured_one():
    header, *lines = (cells for cells in printed("rollout.md") if not cells[0].startswith("---"))
    measured = {cells[0].replace("²", "^2"): dict(zip(header, cells, strict=True)) for cells in lines}
    quoted = rows("Rollout speed")
    assert [cells[0] for cells in quoted] == list(measured)
    for case, _, ms, _, rate, peak, _, factor, neuma, _, floors, plain in quoted:
        row = measured[case]
        assert float(ms) == float(row["ms"]) and float(rate) == float(row["p-substeps/s"]) and float(peak) == float(row["peak MB"])
        assert float(floors) == pytest.approx(float(row["ours / floor"]), rel=1e-2)
        assert (factor, neuma) == (row["better by"], row["NeuMA / ours"])
        assert not plain or float(plain) == pytest.approx(float(row["plain / ours"]), rel=1e-2)


def test_render_table_is_the_measured_one():
    measured = printed("render.md")[2:]
    assert rows("Rendering speed")[: len(measured)] == measured


def blind(seed):
    """What the rows of a blind seed say of bodies, and those rows, by ablation: shares by their labels, "count of all"."""
    with (ROOT / "benchmarks" / "results" / f"blind-seed-{seed}.csv").open() as file:
        measured = [row for row in csv.DictReader(file) if row["measured"] == "body"]
    return {how: (shares(of), of) for how in {r["ablation"] for r in measured} for of in [[r for r in measured if r["ablation"] == how]]}


def shares(of):
    nulls, single, pairs, outside = (
        [r for r in of if r["group"] in groups] for groups in (("null", "nuisance"), ("one",), ("two",), ("outside",))
    )

    def named(row):
        return row["answer"] in ("effect", "class")

    def right(row):
        return row["in_class"] == "True"

    counted = {
        "false alarms on nulls": (named, nulls),
        "nulls answered none": (lambda row: row["answer"] == "none", nulls),
        "effects in class": (right, single + pairs),
        "two effects, both in class": (right, pairs),
        "outside the library: unknown": (lambda row: row["answer"] == "unknown", outside),
        "outside the library: a near effect": (lambda row: named(row) and row["near"] == "True", outside),
    }
    for solver, label in (("same", "by the suggested solver"), ("finer", "on a finer grid"), ("elements", "by finite elements")):
        counted[f"single effects {label}"] = (right, [row for row in single if row["solver"] == solver])
    return {label: f"{sum(map(test, among))} of {len(among)}" for label, (test, among) in counted.items()}


def covering(of):
    covered, intervals = (sum(int(row[name]) for row in of) for name in ("covered", "intervals"))
    return f"{covered} of {intervals}"


def test_blind_tables_are_the_measured_ones():
    runs = {seed: blind(seed) for seed in (28, 29)}
    columns = [(29, how) for how in ("none", "plain-bic", "no-unknown", "take-smallest-error")]
    columns += [(28, how) for how in ("none", "no-discretisation", "single-recording")]
    lines = rows("Closed loop: blind cases")
    second = next(i for i, cells in enumerate(lines) if "seed 19" in cells)
    quoted = {label.split(" (goal")[0]: cells for label, *cells in lines[:second]}
    for column, (seed, ablation) in enumerate(columns):
        figures, of = runs[seed][ablation]
        for label, figure in figures.items():
            assert quoted[label][column] == figure, (seed, ablation, label)
        if ablation in ("none", "no-discretisation", "single-recording"):  # the others have no intervals
            assert quoted["90 % intervals that cover"][column] == covering([row for row in of if row["group"] in ("one", "two")])
    together = {label: cells for label, *cells in lines[second + 2 :]}
    for column, seed in enumerate((*range(19, 26), 27, 28, 29)):
        figures, of = blind(seed)["none"]
        figures["90 % intervals that cover"] = covering([row for row in of if row["group"] in ("one", "two")])
        for label, cells in together.items():
            assert cells[column] == figures[label], (seed, label)
    for label, cells in together.items():
        counts = [list(map(int, cell.split(" of "))) for cell in cells]
        assert counts[-1] == [sum(count) for count in zip(*counts[:-1], strict=True)], label


def test_what_naming_takes_is_what_the_code_asks():
    section = TEXT.split("**When an effect is named.**")[1].split("**Beside one effect")[0]
    quoted = [float(line.strip("| ").split("|")[-1]) for line in section.splitlines() if line.startswith("| where")]
    asked = [
        LEAST_GAIN,
        judging.GAIN_AT_FLOOR,
        judging.GAIN_IN_FLOOR,
        judging.GAIN_TO_NOISE,
        LEAST_GAIN,
        judging.BACK_GAIN,
        judging.FORETELLS,
        judging.LEAST_GAIN_EXACT,
    ]
    assert quoted == pytest.approx([math.exp(gain) for gain in asked])
