"""What a diagnosis leaves behind: diagnosis.json (`neuido-diagnosis/1`), model_after.yaml, trace.json, the predicted motion, the report."""

import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

import neuido
from neuido.data.files.storage import write_text
from neuido.data.files.values import file_name
from neuido.data.files.writing import atomic_write, make_real_folder
from neuido.discrepancy.inference.attribution import Diagnosis
from neuido.discrepancy.inference.floors import Part, Round, Trial
from neuido.discrepancy.inference.intervals import would_help
from neuido.discrepancy.inference.judging import ALPHA
from neuido.discrepancy.problems.declared_model import beside
from neuido.discrepancy.problems.problem import Problem
from neuido.discrepancy.problems.settings import CONTACT_HEIGHT
from neuido.discrepancy.report import ceiling, next_experiment, page, residual
from neuido.errors import UserError

FORMAT = "neuido-diagnosis/1"
VERSION = neuido.__version__
UNSURE = ("insufficient", "unknown")
P_VALUE = "chance of the largest gain over all effects in a linear model of the fits, without the search and the refits of its draws"
"""What the p-value is of; a fit is not linear, and a search tries more than one start."""
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
    """Write all files; each appears when it is whole, diagnosis.json last.

    Args:
        out: Folder.
        found: Diagnoses with the seconds that each took; several are the bodies of a track folder.
        kind: `experiment`, `material test` or `track`.
        device: Where it ran.
        seed: Of the ceiling's network.
        seconds: In place of the measured ones.
        tell: Called with a line of progress.
    """
    tell = tell or (lambda line: None)
    details = []
    for diagnosis, spent in found:
        begun = time.monotonic()
        made = describe(diagnosis, device=device, seed=seed, tell=tell)
        made.content["seconds"] = round(spent + time.monotonic() - begun, 1) if seconds is None else seconds
        details.append(made)
    tell("writing")
    predicted = make_real_folder(out / "predicted", "the folder")
    for made in details:
        for name, arrays in made.motion.items():
            _save(predicted / f"{file_name(name, 'the name of a recording')}.npz", arrays)
    models = {_body(d): beside(out, d.problem.model_after(d.after, [t.candidate.name for t in d.effects])) for d, _ in found}
    model = {"bodies": models} if len(found) > 1 else next(iter(models.values()))
    write_text(out / "model_after.yaml", yaml.safe_dump(_plain(model), sort_keys=False, default_flow_style=None))
    traces = [trace(d) for d, _ in found]
    write_json(out / "trace.json", {"bodies": traces} if len(found) > 1 else traces[0])
    content = [made.content for made in details]
    if len(found) > 1:
        name = found[0][0].problem.name.rpartition(": ")[0]
        whole: dict[str, Any] = {"format": FORMAT, "experiment": name, "bodies": content}
    else:
        whole = content[0]
    write_text(out / "report.html", page.page(details, [d for d, _ in found], kind=kind))
    write_json(out / "diagnosis.json", whole)


def describe(d: Diagnosis, *, device: str, seed: int = 0, tell: Callable[[str], None] | None = None) -> page.Details:
    """The content of diagnosis.json and what the report shows beside it."""
    tell = tell or (lambda line: None)
    tell("motion before and after")
    motion, failed = motions(d)
    series = {name: _stages(d, name, arrays) for name, arrays in motion.items() if "positions" in arrays}
    tell("ceiling")
    ceilings = {when: ceiling.of(d, when, seed=seed) for when in ("before", "after")}
    tell("next experiment")
    content = {
        "format": FORMAT,
        "experiment": d.problem.name,
        "answer": d.answer,
        "why": list(d.why),
        "would_help": would_help(d.problem.labels.get("kind", ""), discretised=d.problem.settings > 1) if d.answer in UNSURE else [],
        "effects": [_effect(d, r, series) for r in d.rounds if r.chosen is not None],
        "leads": [_lead(t) for t in d.leads],
        "untried": untried(d),
        "declared": _declared(d, d.before, d.declared_intervals),
        "after": _declared(d, d.after, d.intervals),
        "error": {
            "measure": d.problem.measure,
            "unit": d.problem.unit,
            "noise_floor": d.floors["noise"],
            "noise_from": dict(d.noise_from),
            "left_over_floor": d.over.get("floor"),
            "left_over_noise": d.over.get("noise"),
            "discretisation_floor": d.floors["discretisation"],
            **{when: errors(d, when) for when in ("before", "after")},
            **_settings(d),
        },
        "rejected": rejected(d),
        "not_excluded": [{"name": h.name, "parameter": h.parameter, "unit": h.unit, "up_to": h.up_to} for h in d.hidden],
        "settings_not_run": {name: list(own) for name, own in d.unable.items()},
        "next_experiment": next_experiment.propose(d),
        "ceiling": {when: {"held_out": c.held_out, "fit": c.fit} for when, c in ceilings.items()},
        "left_out": list(d.left_out),
        "places": {name: _place(d, name, arrays) for name, arrays in motion.items() if "positions" in arrays},
        "solver": d.problem.setting_name(d.setting),
        "seconds": 0.0,
        "device": device,
        "version": VERSION,
    }
    if failed:
        content["not_predicted"] = failed
    if "body" in d.problem.labels:
        content["body"] = d.problem.labels["body"]
    drawn = d.problem.silhouettes(d) if hasattr(d.problem, "silhouettes") else {}
    if drawn:
        content["silhouettes"] = {name: own["scores"] for name, own in drawn.items()}
        for name, own in drawn.items():
            motion[name] |= {key: np.round(255 * own[key]).astype(np.uint8) for key in ("masks", "drawn_before", "drawn_after")}
    return page.Details(_plain(content), motion, series, ceilings, drawn)


def _settings(d: Diagnosis) -> dict[str, Any]:
    """Of what is discretised: the amounts of the other settings in the prediction, and the errors without them."""
    if d.problem.settings == 1:
        return {}
    names = [d.problem.setting_name(s) for s in d.problem.others(d.setting)]
    amounts = {when: dict(zip(names, own)) for when, own in d.amounts.items()}
    heights = {when: point.get(CONTACT_HEIGHT, 0.0) for when, point in (("before", d.before), ("after", d.after))}
    out: dict[str, Any] = {"amounts": amounts, "one_setting": {when: errors(d, when, one_setting=True) for when in ("before", "after")}}
    return out | ({"contact_height": {**heights, "unit": "m"}} if any(heights.values()) else {})


def errors(d: Diagnosis, when: str, *, one_setting: bool = False) -> dict[str, Any]:
    """Errors of the parts that are fitted, of those that are held out, and by recording; joined ones weigh each datum alike.

    Of what is held out the `validation` part has steered the search, and the `test` part, where there is one, has not.

    The prediction is a simulation under the setting in use, and the differences of the others to it in the amounts that the fitted
    recordings hold; `one_setting`: the simulation alone.
    """
    own = (d.one_setting if one_setting else d.errors)[when]

    def joined(parts: Sequence[Part]) -> float | None:
        counts = [np.count_nonzero(p.rows) for p in parts]
        return math.sqrt(sum(n * own[p.name] ** 2 for n, p in zip(counts, parts)) / sum(counts)) if parts else None

    fitted, validation = ([p for p in d.parts if p.fitted == which] for which in (True, False))
    out = {"fit": joined(fitted), "held_out": joined([*validation, *d.sealed])}
    return out | {"validation": joined(validation), "test": joined(d.sealed), "by_recording": dict(own)}


def rejected(d: Diagnosis) -> list[dict[str, str]]:
    """Every candidate that is neither an effect nor in the class of one, with the reason of the round that weighed it best.

    A search that was cut off rejects nothing (`untried`).
    """
    ruled_out = [{"name": name, "reason": reason} for name, reason in d.problem.labels.get("excluded", {}).items()]
    if d.answer == "unfinished":
        return ruled_out
    kept = {t.candidate.name for r in d.rounds for t in (r.members if r.chosen is not None else [])}
    reasons: dict[str, str] = {}
    near = "what is left without it is noise, or so near to it that no effect could lower it enough"
    behind = "its direction in the data stays behind those of the effects that were fitted in full"
    for r in d.rounds:
        for t in r.trials:
            name = t.candidate.name
            if name not in kept and name not in reasons and (t.reason or d.why):
                reasons[name] = t.reason or d.why[0]
        for key, reason in r.unfitted.items():
            name = key.partition(":")[0]
            if name not in kept:
                reasons.setdefault(name, reason)
    for c in d.problem.candidates:
        if c.name not in kept and c.name not in reasons:
            reasons[c.name] = behind if any(r.trials for r in d.rounds) else near
    return [{"name": name, "reason": reason} for name, reason in reasons.items()] + ruled_out


def untried(d: Diagnosis) -> list[str]:
    """Candidates that a search which was cut off has not fitted."""
    if d.answer != "unfinished":
        return []
    fitted = {t.candidate.name for r in d.rounds for t in r.trials}
    return list(dict.fromkeys(c.name for c in d.problem.candidates if c.name not in fitted))


def _lead(t: Trial) -> dict[str, Any]:
    """What leads in a search that was cut off: its figures so far, without intervals, and how far it lowers the error."""
    own = {p.name.partition(".")[2]: {"value": t.fit.point.get(p.name, p.value), "unit": p.unit} for p in t.candidate.parameters}
    return {"name": t.candidate.name, "error_ratio": math.exp(min(t.gain, 700.0)), "parameters": own}


def _effect(d: Diagnosis, r: Round, series: Mapping[str, list[residual.Series]]) -> dict[str, Any]:
    """One entry of `effects`."""
    c = r.chosen.candidate
    parameters = {}
    for p in c.parameters:
        value = d.after.get(p.name, p.value)
        low, high = d.intervals.get(p.name, (value, value))
        parameters[p.name.partition(".")[2]] = {"value": value, "unit": p.unit, "interval90": [low, high]}
    names = list(dict.fromkeys([c.name, *(t.candidate.name for t in r.members)]))
    out = {
        "name": c.name,
        "class": names,
        "parameters": _derived(d, c.name, parameters),
        "p_value": r.p_value,
        "p_value_of": P_VALUE,
        "where": _where(c.where, series),
    }
    if c.form:
        out["form"] = c.form
    return out


def _derived(d: Diagnosis, name: str, own: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """The parameters, and those figures of them that people use."""

    def mapped(key: str, unit: str, f: Callable[[float], float]) -> dict[str, Any]:
        ends = sorted(f(v) for v in own[key]["interval90"])
        return {"value": f(own[key]["value"]), "unit": unit, "interval90": ends}

    more: dict[str, dict[str, Any]] = {}
    if name == "yield" and all(v > 0 for v in own["inverse"]["interval90"]):
        more["yield_stress"] = mapped("inverse", "Pa", lambda v: 1.0 / v)
    if name == "hysteresis":
        more["damping_ratio"] = mapped("eta", "1", lambda v: 0.5 * v)
    if name == "friction":
        declared = {p.friction for r in getattr(d.problem, "measured", ()) for p in r.scene.colliders}
        if len(declared) == 1:
            more["coefficient"] = mapped("mu", "1", lambda v: v + next(iter(declared)))
    if "log_ratio" in own:
        more["ratio"] = mapped("log_ratio", "1", math.exp)
        radius = own["radius"]
        more["centre"] = {"value": [own[k]["value"] for k in ("cx", "cy", "cz")], "unit": "m",
                          "interval90": [[own[k]["interval90"][i] for k in ("cx", "cy", "cz")] for i in (0, 1)],
                          "of": "the centre of the body at t = 0"}  # fmt: skip
        more["radius"] = radius
    return own | more


def _where(stage: str, series: Mapping[str, list[residual.Series]]) -> str:
    """The stage, and the place in time where the residual stood out most."""
    best = None
    for name, rows in series.items():
        s = residual.telling(rows)
        if s is None:
            continue
        i = int(np.argmax(s.before / np.maximum(s.noise, 1e-300)))
        over = float(s.before[i] / max(s.noise[i], 1e-300))
        if best is None or over > best[0]:
            best = (over, s.name, float(s.times[i]), name)
    if best is None or best[0] < 2:
        return stage
    return f"{stage}; the residual stands out most in the stage {best[1]} of {best[3]}, {best[0]:.0f} times its noise at {best[2]:.3g} s"


def _declared(d: Diagnosis, point: Mapping[str, float], intervals: Mapping[str, tuple[float, float]]) -> dict[str, Any]:
    out = {}
    for p in d.problem.declared:
        value = point.get(p.name, p.value)
        out[p.name] = {"value": value, "unit": p.unit, "interval90": list(intervals.get(p.name, (value, value)))}
    return out


def motions(d: Diagnosis) -> tuple[dict[str, dict[str, np.ndarray]], dict[str, str]]:
    """What was measured and what is predicted before and after, for each recording, as the errors of the diagnosis count it.

    And why, of each recording that is left out because it does not move there.

    Bodies: `positions` (1), `measured`, `before` and `after` (T, N, 3) [m], the clock, the ruler and the launch at their most probable
    values and the other settings in their amounts, `before_model` and `after_model` without all that, `t` (T,). Others: the data as
    vectors, with `times` and `groups` (which channel a row is of).
    """
    out: dict[str, dict[str, np.ndarray]] = {}
    failed: dict[str, str] = {}
    problem: Problem = d.problem
    for n, recording in enumerate(problem.recordings):
        own = {when: ceiling.as_seen(d, when, n) for when in ("before", "after")}
        if not getattr(problem, "tracked", hasattr(problem, "motion")):
            out[recording.name] = {"times": recording.times, "groups": recording.groups, "measured": recording.y, **own}
            continue
        r = problem.measured[n]
        arrays = {"positions": np.array(1), "t": r.t.numpy(), "measured": r.x.double().numpy()}
        seen = r.seen.numpy()
        try:
            models = {when: problem.motion(point, n, d.setting) for when, point in (("before", d.before), ("after", d.after))}
        except UserError as error:
            failed[recording.name] = str(error)
            continue
        for when, model in models.items():
            shown = model.copy()
            shown[1:][seen[1:]] = own[when].reshape(-1, 3)
            arrays |= {when: shown, f"{when}_model": model}
        out[recording.name] = arrays
    return out, failed


def _stages(d: Diagnosis, name: str, arrays: Mapping[str, np.ndarray]) -> list[residual.Series]:
    n = [r.name for r in d.problem.recordings].index(name)
    r = d.problem.measured[n]
    mass = float(r.body.volume.double().sum()) * float(d.after.get("density", d.problem.experiment.model["density"]))
    return residual.stages(arrays["measured"], arrays["t"], arrays["before"], arrays["after"], mass=mass, sigma=d.final["before"].noise[n],
                           planes=r.scene.colliders, margin=1.5 * r.scene.dx)  # fmt: skip


def _place(d: Diagnosis, name: str, arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Where on the body the force that is missing before is largest."""
    n = [r.name for r in d.problem.recordings].index(name)
    where, excess = residual.place(arrays["measured"], arrays["t"], arrays["before"], sigma=d.final["before"].noise[n])
    centre = d.problem.measured[n].body.x.double().mean(dim=0).numpy()
    return {"from_centre": list(where - centre), "unit": "m", "over_median": excess}


def trace(d: Diagnosis) -> dict[str, Any]:
    """Every figure that the decisions rest on, for benchmarks and ablations."""
    names = [
        {"name": p.name, "recording": d.problem.recordings[p.recording].name, "fitted": p.fitted, "rows": int(p.rows.sum())}
        for p in d.parts
    ]
    return _plain({
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
    """Write JSON all at once; figures that are not finite become null."""
    write_text(path, json.dumps(content, indent=1, allow_nan=False) + "\n")


def _body(d: Diagnosis) -> str:
    return d.problem.labels.get("body", d.problem.name)


def _save(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    with atomic_write(path) as hidden, hidden.open("wb") as stream:
        np.savez_compressed(stream, **arrays)


def _plain(value: Any) -> Any:
    """The same with Python's own numbers; what is not finite becomes null."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [_plain(v) for v in value]
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value
