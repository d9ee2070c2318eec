"""Table of the balances of contact: momentum, energy, torque, closed forms and gradients, as the tests measure them.

    python benchmarks/balances.py [--out research/results/balances.md] [--fast]

It runs the tests, slow ones too, whose results `tests/physics/balances.py` keeps. They are on the GPU where there is one.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from xml.etree import ElementTree

from neuido.data.files.writing import write_text

ROOT = Path(__file__).parents[1]
FILES = (
    "multibody/test_contact_grid.py",
    "colliders/test_solids.py",
    "colliders/test_solid_gradients.py",
    "colliders/test_hertz.py",
)
EXACT = 1e-9
"""Size below which a number is written as a power of ten."""


def measured(file: str, fast: bool) -> tuple[list[tuple], int]:
    """Run the tests of a file; return the balances of those that passed, (what, case, found, exact), and how many failed."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        chosen = ["-m", "not slow"] if fast else []
        subprocess.run(
            [sys.executable, "-m", "pytest", "-q", "--junitxml", report, ROOT / "tests" / "physics" / file, *chosen], check=False
        )
        cases = list(ElementTree.parse(report).iter("testcase"))
    failed = [case for case in cases if case.find("failure") is not None or case.find("error") is not None]
    kept = (each for case in cases if case not in failed for each in case.iter("property") if each.get("name") == "balance")
    return [tuple(json.loads(each.get("value") or "")) for each in kept], len(failed)


def line(what: str, case: str, found: float, exact: float) -> str:
    """Return a row of the table."""
    off = f"{abs(found / exact - 1):.2g}" if exact else "–"
    value = f"{found:.1e}" if abs(found) < EXACT else f"{found:.6g}"
    return f"| {what} | {case} | {value} | {exact:.6g} | {off} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "research" / "results" / "balances.md")
    parser.add_argument("--fast", action="store_true", help="leave the slow tests out")
    given = parser.parse_args()
    rows, failed = [], 0
    for file in FILES:
        own, wrong = measured(file, given.fast)
        rows, failed = rows + own, failed + wrong
    head = [
        "# Balances of contact",
        "",
        f"{len(rows)} values of tests that passed; {failed} tests failed.",
        "",
        "Momentum, angular momentum, weight and torque hold to rounding, or to what is left of a motion. Restitution and Hertz's forces",
        "come nearer to the closed form with the grid, and stand at two of them. A derivative is that of a sum of results along a random",
        "direction; the exact value beside it is one by finite differences in float64.",
        "",
    ]
    table = ["| balance or closed form | case | found | exact | relative error |", "| --- | --- | ---: | ---: | ---: |"]
    write_text(given.out, "\n".join([*head, *table, *(line(*row) for row in sorted(rows, key=lambda row: row[0]))]) + "\n")
    print(f"{len(rows)} values, {failed} failures: {given.out}")


if __name__ == "__main__":
    main()
