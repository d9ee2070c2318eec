"""Remake the table by which evidences are judged, of blind cases whose fits were kept.

    python benchmarks/calibrate.py RUN [RUN ...] [--table neuido/discrepancy/inference/calibration.csv]

RUN is the folder of `benchmarks/blind.py --statistics`. A case counts if its search came to its end and, where effects of the library were
there, one of its kept fits has the true ones near their optimum: what the search did not find says nothing of the decision. No simulation
is run. The command prints the table, and how each of its cases would be judged by the others (leave one out). Seeds that made the table
are no blind test of the evidence any more: do not report them.
"""

import argparse
import csv
import io
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import blind
import blind_scores

from neuido.data.files.writing import write_text
from neuido.discrepancy.inference.calibration import TABLE, calibration_of
from neuido.discrepancy.inference.evidence import Evidence, evidences, judged
from neuido.discrepancy.inference.statistics import read_fits

COLUMNS = ("run", "case", "kind", "solver", "behind", "beyond")


def cases(run: Path) -> Iterator[tuple[dict[str, Any], list[Evidence]]]:
    """Yield the row of each case of a run that counts, and its evidences."""
    for folder in sorted(path for path in (run / "cases").iterdir() if path.is_dir() and path.name != "keys"):
        for stored in sorted((run / "answers" / "none" / folder.name / "fits").glob("*.npz")):
            key, (case, fits) = blind.key_of(folder), read_fits(stored)
            group = blind_scores.group_of(key)
            if group == "outside" or case.facts["cut"] or not any(not fit.record.effects for fit in fits):
                continue
            null = group in ("null", "nuisance")
            kept = [fit.record for fit in fits]
            true = (
                [r for r in kept if not r.effects] if null else blind_scores.near_the_truth(key, case, blind_scores.of_the_truth(key, kept))
            )
            for end in blind_scores.of_the_truth(key, [case.after]):  # an older version kept no fit of the answer, which may be better
                true = [r for r in true if np.all(np.sqrt(r.errors) < blind_scores.AT_NOISE * np.sqrt(end.errors))]
            if not true:
                continue
            found, own = evidences(case, fits), {r.digest for r in true}
            best = next(e for e in found if e.record.digest in own)
            kind = "none" if null else "+".join(one["kind"] for one in key["undeclared"])
            figures = (math.ceil(100.0 * v) / 100.0 for v in (found[0].value - best.value, best.beyond))
            yield dict(zip(COLUMNS, (run.name, folder.name, kind, key.get("solver", ""), *figures), strict=True)), found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--table", type=Path, default=TABLE)
    options = parser.parse_args()
    made = [one for run in options.runs for one in cases(run.resolve())]
    rows = [row for row, _ in made]
    stream = io.StringIO()
    writer = csv.DictWriter(stream, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(options.table, stream.getvalue())
    print(stream.getvalue())
    for row, found in made:
        verdict = judged(found, calibration_of([other for other in rows if other is not row]))
        named = " or ".join("+".join(one) for one in verdict.sets)
        print(f"{row['run']} {row['case']} ({row['kind']}): {verdict.answer} {named}, lead {verdict.lead:.1f}, p = {verdict.p_value:.3f}")
    whole = calibration_of(rows)
    print(f"a model is named from a lead of {whole.least_lead():.1f} on ({len(whole.nulls)} nulls)")
    print(f"sets are told apart by {whole.class_margin():.1f} ({len(whole.effects)} cases with effects)")
    print(f"something unknown adds more than {whole.unknown_threshold():.1f} ({len(rows)} cases)")


if __name__ == "__main__":
    main()
