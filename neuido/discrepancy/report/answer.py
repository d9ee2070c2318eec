"""The files that a diagnosis writes: diagnosis.json, model_after.yaml, trace.json, predicted motions and the report."""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from neuido.data.files.values import file_name
from neuido.data.files.writing import make_real_folder, remove, write_arrays, write_text
from neuido.discrepancy.inference.floors import Round, Trial
from neuido.discrepancy.inference.search.attribution import Diagnosis
from neuido.discrepancy.inference.search.judging import ALPHA
from neuido.discrepancy.problems.declared_model import beside
from neuido.discrepancy.report import page
from neuido.discrepancy.report.answer_content import describe, plain
from neuido.discrepancy.report.diagnosis_format import FORMAT
from neuido.discrepancy.report.reader_units import Units
from neuido.discrepancy.report.wording import words_of

Found = Sequence[tuple[Diagnosis, float]]


def write(
    out: Path,
    found: Found,
    *,
    kind: str,
    device: str,
    seed: int = 0,
    seconds: float | None = None,
    tell: Callable[[str], None] | None = None,
) -> None:
    """Write all files of a diagnosis; each appears when it is complete, diagnosis.json last.

    Args:
        out: Folder for the files.
        found: Diagnoses with the time that each took [s]. Several are the bodies of a track folder.
        kind: `experiment`, `material test` or `track`.
        device: Device of the simulations.
        seed: Seed of the network that estimates the ceiling.
        seconds: Time to report [s] in place of the measured one.
        tell: Function that is called with a line of progress.
    """
    tell = tell or (lambda line: None)
    made: list[tuple[dict[str, Any], dict[str, dict[str, np.ndarray]]]] = []
    for diagnosis, spent in found:
        begun = time.monotonic()
        content, motion = describe(diagnosis, device=device, seed=seed, tell=tell)
        content["seconds"] = round(spent + time.monotonic() - begun, 1) if seconds is None else seconds
        made.append((content, motion))
    tell("writing")
    predicted = make_real_folder(out / "predicted", "the folder")
    motions = {f"{file_name(name, 'the name of a recording')}.npz": arrays for _, motion in made for name, arrays in motion.items()}
    for name, arrays in motions.items():
        _save(predicted / name, arrays)
    for other in predicted.glob("*.npz"):  # left by a diagnosis of other recordings
        if other.name not in motions:
            remove(other)
    models = {_body(d): beside(out, d.problem.model_after(d.after, [t.candidate.name for t in d.effects])) for d, _ in found}
    model = {"bodies": models} if len(found) > 1 else next(iter(models.values()))
    write_text(out / "model_after.yaml", yaml.safe_dump(plain(model), sort_keys=False, default_flow_style=None))
    traces = [trace(d) for d, _ in found]
    write_json(out / "trace.json", {"bodies": traces} if len(found) > 1 else traces[0])
    contents = [content for content, _ in made]
    units = Units.of(contents)
    for content in contents:
        content["words"] = list(words_of(content, units).paragraphs)
    name = found[0][0].problem.name.rpartition(": ")[0] if len(found) > 1 else contents[0]["experiment"]
    whole: dict[str, Any] = {"format": FORMAT, "experiment": name, "kind": kind}
    whole |= {"bodies": contents} if len(found) > 1 else contents[0]
    write_text(out / "report.html", page.page(contents, [motion for _, motion in made], kind=kind, name=name))
    write_json(out / "diagnosis.json", whole)


def trace(d: Diagnosis) -> dict[str, Any]:
    """Return all numbers on which the decisions rest, for benchmarks and ablations."""
    names = [
        {"name": p.name, "recording": d.problem.recordings[p.recording].name, "fitted": p.fitted, "rows": int(p.rows.sum())}
        for p in d.parts
    ]
    return plain({
        "format": "neuido-trace/1",
        "experiment": d.problem.name,
        "answer": d.answer,
        "parts": names,
        "simulations": d.evaluations,
        "setting": d.setting,
        "alpha": ALPHA,
        "rounds": [_round(d, r) for r in d.rounds],
        "before": dict(d.before),
        "after": dict(d.after),
    })  # fmt: skip


def _round(d: Diagnosis, r: Round) -> dict[str, Any]:
    """Return the numbers of one step of a search: noise, floors, the null distribution and every trial."""
    quantiles = (0.5, 0.9, 0.95, 0.99)
    null = np.asarray(r.null)
    return {
        "base": dict(r.base),
        "mean_squares": list(r.errors),
        "noise": [r.floor.noise[p.recording] for p in d.parts],
        "discretisation": np.sqrt(r.floor.spread_squares(d.parts)).tolist(),
        "floors": list(r.floors),
        "p_value": r.p_value,
        "chosen": r.chosen.candidate.key if r.chosen else None,
        "members": [t.candidate.key for t in r.members],
        "null": {"quantiles": {str(q): float(np.quantile(null, q)) for q in quantiles} if len(null) else {}, "sample": list(null)},
        "trials": [_trial(r, t) for t in r.trials],
    }


def _trial(r: Round, t: Trial) -> dict[str, Any]:
    """Return the numbers of the fit of one candidate."""
    c = t.candidate
    return {
        "key": c.key,
        "name": c.name,
        "point": dict(t.fit.point),
        "parameters": len(c.parameters),
        "cost": t.fit.cost,
        "data": len(t.fit.residual),
        "evaluations": t.fit.evaluations,
        "converged": t.fit.converged,
        "mean_squares": list(t.errors),
        "gain": t.gain,
        "score": t.score,
        "cosine": r.cosines.get(c.key),
        "reason": t.reason,
    }


def write_json(path: Path, content: Any) -> None:
    """Write JSON to a file, which appears when it is complete.

    Raises:
        ValueError: A number is not finite (`plain` makes it null).
    """
    write_text(path, json.dumps(content, indent=1, allow_nan=False) + "\n")


def _body(d: Diagnosis) -> str:
    return d.problem.labels.get("body", d.problem.name)


def _save(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    write_arrays(path, arrays)
