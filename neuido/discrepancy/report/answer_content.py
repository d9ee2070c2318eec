"""The content of diagnosis.json (`neuido-diagnosis/2`) of a finished diagnosis, and the motions that its page shows."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from neuido.discrepancy.inference.floors import Part, Round, Trial, unphysical
from neuido.discrepancy.inference.power import Compatible
from neuido.discrepancy.inference.search.attribution import Diagnosis
from neuido.discrepancy.inference.search.intervals import would_help
from neuido.discrepancy.inference.search.judging import ALPHA
from neuido.discrepancy.problems.problem import Problem
from neuido.discrepancy.problems.settings import CONTACT_HEIGHT
from neuido.discrepancy.problems.tracks.scale_error import gravity_found, rival_scale
from neuido.discrepancy.report import ceiling, next_experiment, residual
from neuido.discrepancy.report.reader_units import reach
from neuido.discrepancy.report.wording import title
from neuido.errors import UserError
from neuido.installation import __version__

VERSION = __version__
UNSURE = ("insufficient", "unknown")
P_VALUE = "chance of the largest gain over all effects in a linear model of the fits, without the search and the refits of its draws"
"""Meaning of the p-value. Fits are not linear, and a search tries more than one start."""
PATHS = {"biaxial": "stretch along the stress", "simple_shear": "amount of shear"}
COMPONENTS = "xyz"
Motion = dict[str, dict[str, np.ndarray]]


def describe(d: Diagnosis, *, device: str, seed: int = 0, tell: Callable[[str], None] | None = None) -> tuple[dict[str, Any], Motion]:
    """Return the content of diagnosis.json for one body, and the arrays of each recording for its plots (`motions`).

    The words are still empty, because their units depend on all bodies that are diagnosed together.

    Args:
        d: Result of the inference.
        device: Device of the simulations.
        seed: Seed of the network that estimates the ceiling.
        tell: Function that is called with a line of progress.
    """
    tell = tell or (lambda line: None)
    tell("motion before and after")
    motion, failed = motions(d)
    series = {name: _stages(d, name, arrays) for name, arrays in motion.items() if "positions" in arrays}
    doubtful = doubts(d)
    tell("ceiling")
    ceilings = {when: ceiling.of(d, when, seed=seed) for when in ("before", "after")}
    tell("next experiment")
    content = {
        "experiment": d.problem.name,
        "answer": d.answer,
        "words": [],
        "why": list(d.why),
        "would_help": would_help(d.problem.labels.get("kind", ""), discretised=d.problem.settings > 1) if d.answer in UNSURE else [],
        "effects": [_effect(d, r, series, step) for step, r in enumerate(d.rounds, 1) if r.chosen is not None],
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
            "worst_over_floor": d.over.get("worst"),
            "discretisation_floor": d.floors["discretisation"],
            **{when: errors(d, when) for when in ("before", "after")},
            **_settings(d),
        },
        "models": [model for step, r in enumerate(d.rounds, 1) for model in _models(d, r, step)],
        "chance": [_chance(r, step) for step, r in enumerate(d.rounds, 1) if r.trials],
        "power": [_power(d, one) for one in d.power],
        "rejected": rejected(d),
        "recordings": recordings_of(d.problem),
        "stages": {name: [_series(s) for s in own] for name, own in series.items()},
        "places": {name: _place(d, name, arrays) for name, arrays in motion.items() if "positions" in arrays},
        "settings_not_run": {name: list(own) for name, own in d.unable.items()},
        "next_experiment": next_experiment.propose(d),
        "ceiling": {when: {"held_out": c.held_out, "fit": c.fit} for when, c in ceilings.items()},
        "left_out": list(d.left_out),
        "work": _work(d),
        "solver": d.problem.setting_name(d.setting),
        "seconds": 0.0,
        "device": device,
        "version": VERSION,
    }
    if failed:
        content["not_predicted"] = failed
    if doubtful:
        content["doubts"] = doubtful
    if "unseen" in d.problem.labels:
        content["unseen"] = d.problem.labels["unseen"]
    size = sum(len(r.chosen.candidate.parameters) for r in d.rounds if r.chosen is not None)
    if content["effects"] and (scale := rival_scale(d.problem, d.before, d.after, size)) is not None:
        content["scale_error"] = scale
    named = {name for e in content["effects"] for name in e["class"]}
    if "gravity" in named and (gravity := gravity_found(inner(d.problem), d.after)) is not None:
        content["gravity"] = gravity
    if "body" in d.problem.labels:
        content["body"] = d.problem.labels["body"]
    drawn = d.problem.silhouettes(d) if hasattr(d.problem, "silhouettes") else {}
    if drawn:
        content["silhouettes"] = {name: own["scores"] for name, own in drawn.items()}
        for name, own in drawn.items():
            motion[name] |= {key: np.round(255 * own[key]).astype(np.uint8) for key in ("masks", "drawn_before", "drawn_after")}
            content["recordings"][name] |= {"inset": float(own["inset"]), "frame_times": [float(t) for t in own["times"]]}
    content["reach"] = reach(motion, d.problem.unit)
    return plain(content), motion


def inner(problem: Problem) -> Any:
    """Return the problem itself, without the store of predictions around it."""
    return getattr(problem, "problem", problem)


def recordings_of(problem: Problem) -> dict[str, dict[str, Any]]:
    """Return the entry of each recording in diagnosis.json: role, quantity, scene, channels."""
    own = inner(problem)
    out = {}
    for n, recording in enumerate(problem.recordings):
        made: dict[str, Any] = {"role": recording.role}
        if hasattr(own, "tests"):
            made |= _test(own.tests.tests[n])
        elif hasattr(own, "measured"):
            scene = own.measured[n].scene
            made |= {"gravity": [float(g) for g in scene.gravity], "colliders": [_plane(p) for p in scene.colliders]}
            if getattr(own, "series", ()):
                made["parts"] = [series.name for series in own.series[n]]
        elif hasattr(own, "pictured"):
            made |= {"quantity": "displacement", "parts": [part.name for part in own.experiment.boundary]}
        elif hasattr(own, "axes"):
            made |= {"quantity": "position", "timed": True, "channels": [COMPONENTS[a] for a in own.axes]}
        out[recording.name] = made
    return out


def _test(test: Any) -> dict[str, Any]:
    """Return the entry of a material test: mode of loading, stress that was measured, and axis of its plots."""
    shear = test.mode == "simple_shear"
    channels = test.stress.shape[1]
    out = {
        "mode": test.mode.replace("_", " "),
        "quantity": "shear stress" if shear else "true stress" if test.true_stress else "nominal stress",
        "axis": {"label": PATHS.get(test.mode, "stretch"), "unit": "1"},
        "timed": test.time is not None,
    }
    return out | ({"channels": [f"direction {i + 1}" for i in range(channels)]} if channels > 1 else {})


def _plane(plane: Any) -> Mapping[str, Any]:
    made = {"point": [float(v) for v in plane.point], "normal": [float(v) for v in plane.normal]}
    return made | {"contact": plane.contact, "friction": float(plane.friction)}


def abscissa(problem: Problem, n: int) -> np.ndarray | None:
    """Return the stretch or shear of each value of a material test, (n,); None for other data, which are drawn over time."""
    own = inner(problem)
    if not hasattr(own, "tests"):
        return None
    path, channels = own.tests.tests[n].path, own.tests.tests[n].stress.shape[1]
    return np.broadcast_to(path, (len(path), channels)).reshape(-1) if path.shape[1] in (1, channels) else np.repeat(path[:, 0], channels)


def _models(d: Diagnosis, r: Round, step: int) -> list[dict[str, Any]]:
    """Return the effects that a step has fitted, first the named one, then its class, then the others by score."""
    kept = {id(t) for t in r.members} if r.chosen is not None else set()
    leads = {id(t) for t in d.leads}
    out = []
    for t in sorted(r.trials, key=lambda t: (t is not r.chosen, id(t) not in kept, t.score)):
        verdict = (
            "named" if t is r.chosen else "class" if id(t) in kept else "lead" if id(t) in leads else "rejected" if t.reason else "weighed"
        )
        figures = {p.name.partition(".")[2]: {"value": t.fit.point.get(p.name, p.value), "unit": p.unit} for p in t.candidate.parameters}
        one = {"step": step, "name": t.candidate.name, "verdict": verdict, "reason": t.reason or "", "parameters": figures}
        one |= {"error_ratio": math.exp(min(t.gain, 700.0)), "score": t.score, "cosine": r.cosines.get(t.candidate.key)}
        out.append(one | ({"form": t.candidate.form} if t.candidate.form else {}))
    return out


def _chance(r: Round, step: int) -> dict[str, Any]:
    """Return the p-value of a step, and the error ratio that chance exceeds in 5 % of the draws."""
    return {"step": step, "p_value": r.p_value, "error_ratio95": math.exp(min(r.by_chance(ALPHA), 700.0)), "of": P_VALUE}


def _power(d: Diagnosis, one: Compatible) -> dict[str, Any]:
    """Return the largest size of an effect that the data allow, with the largest and, if it is known, the ordinary size."""
    p = d.problem.parameter(f"{one.name}.{one.parameter}")
    ordinary = d.problem.labels.get("ordinary", {}).get(p.name)
    return {**one._asdict(), "largest": max(abs(p.lower), abs(p.upper))} | ({} if ordinary is None else {"ordinary": ordinary})


def _series(s: residual.Series) -> dict[str, Any]:
    """Return the missing quantity of one stage over time, before, after and by noise alone."""
    own = {key: list(getattr(s, key)) for key in ("times", "before", "after", "noise")}
    return {"stage": s.name, "unit": s.unit} | own


def _work(d: Diagnosis) -> dict[str, Any]:
    """Return the numbers of simulations, their cost, and what ended the search."""
    unit = "particle-substeps" if d.problem.settings > 1 else "data"
    sums = {key: sum(getattr(w, key) for w in d.work.values()) for key in ("simulations", "reused", "effort")}
    steps = {step: {"simulations": w.simulations, "effort": w.effort} for step, w in d.work.items()}
    limit = d.budget.work if math.isfinite(d.budget.work) else None
    return sums | {"effort_unit": unit, "limit": limit, "ended_by": d.budget.ended_by, "by_step": steps}


def _settings(d: Diagnosis) -> dict[str, Any]:
    """Return the amounts of other settings in the predictions, and the errors without them; empty if nothing is discretised."""
    if d.problem.settings == 1:
        return {}
    names = [d.problem.setting_name(s) for s in d.problem.others(d.setting)]
    amounts = {when: dict(zip(names, own)) for when, own in d.amounts.items()}
    heights = {when: point.get(CONTACT_HEIGHT, 0.0) for when, point in (("before", d.before), ("after", d.after))}
    out: dict[str, Any] = {"amounts": amounts, "one_setting": {when: errors(d, when, one_setting=True) for when in ("before", "after")}}
    return out | ({"contact_height": {**heights, "unit": "m"}} if any(heights.values()) else {})


def errors(d: Diagnosis, when: str, *, one_setting: bool = False) -> dict[str, Any]:
    """Return the errors of fitted and held-out data, and of each recording; every value has the same weight.

    Args:
        d: Result of the inference.
        when: `before` or `after`.
        one_setting: Whether the prediction is one simulation, without the differences of other settings in fitted amounts.

    Returns:
        `fit`, `held_out` and its parts `validation` (which steered the search) and `test` (which did not), and `by_recording`. An error
        without data is None.
    """
    own = (d.one_setting if one_setting else d.errors)[when]

    def joined(parts: Sequence[Part]) -> float | None:
        counts = [np.count_nonzero(p.rows) for p in parts]
        return math.sqrt(sum(n * own[p.name] ** 2 for n, p in zip(counts, parts)) / sum(counts)) if parts else None

    fitted, validation = ([p for p in d.parts if p.fitted == which] for which in (True, False))
    out = {"fit": joined(fitted), "held_out": joined([*validation, *d.sealed])}
    return out | {"validation": joined(validation), "test": joined(d.sealed), "by_recording": dict(own)}


def rejected(d: Diagnosis) -> list[dict[str, str]]:
    """Return the candidates that are neither named nor in a class, each with the first reason that a step gave.

    A search that was cut off rejects only what was excluded before it (see `untried`).
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
    """Return the candidates that a search did not fit before it was cut off; empty if it was completed."""
    if d.answer != "unfinished":
        return []
    fitted = {t.candidate.name for r in d.rounds for t in r.trials}
    able = [c for c in d.problem.candidates if not c.needs or c.needs in fitted]
    return list(dict.fromkeys(c.name for c in able if c.name not in fitted))


def _lead(t: Trial) -> dict[str, Any]:
    """Return the entry of a leading effect in a search that was cut off: parameters without intervals, and error ratio."""
    own = {p.name.partition(".")[2]: {"value": t.fit.point.get(p.name, p.value), "unit": p.unit} for p in t.candidate.parameters}
    return {"name": t.candidate.name, "error_ratio": math.exp(min(t.gain, 700.0)), "parameters": own}


def _effect(d: Diagnosis, r: Round, series: Mapping[str, list[residual.Series]], step: int) -> dict[str, Any]:
    """Return the entry of the effect that a step has named."""
    c = r.chosen.candidate
    parameters = {}
    for p in c.parameters:
        value = d.after.get(p.name, p.value)
        low, high = d.intervals.get(p.name, (value, value))
        parameters[p.name.partition(".")[2]] = {"value": value, "unit": p.unit, "interval90": [low, high]}
    names = list(dict.fromkeys([c.name, *(t.candidate.name for t in r.members)]))
    out = {
        "name": c.name,
        "title": title(c.name),
        "step": step,
        "class": names,
        "parameters": _derived(d, c.name, parameters),
        "p_value": r.p_value,
        "p_value_of": P_VALUE,
        "where": _where(c.where, series),
    }
    if c.form:
        out["form"] = c.form
    limit = unphysical(c, {p.name: d.after.get(p.name, p.value) for p in c.parameters})  # refits after it was named may have moved it
    if limit:
        out["at_limit"] = limit
    return out


def _derived(d: Diagnosis, name: str, own: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Add quantities in common use to the parameters of an effect, such as a yield stress or a damping ratio."""

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
    """Return the stage in which an effect shows, with the recording and time at which the residual exceeds its noise most."""
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


def doubts(d: Diagnosis) -> dict[str, list[str]]:
    """Return the events that make a predicted motion doubtful, such as matter that turned inside out, by recording."""
    problem, out = inner(d.problem), dict[str, list[str]]()
    if not hasattr(problem, "doubts"):
        return out
    for n, recording in enumerate(problem.recordings):
        for when, point in (("before", d.before), ("after", d.after)):
            try:
                events = problem.doubts(point, n, d.setting)
            except UserError:  # `motions` reports this error
                continue
            if events:
                out.setdefault(recording.name, []).extend(f"{when}: {event.words}" for event in events)
    return out


def motions(d: Diagnosis) -> tuple[dict[str, dict[str, np.ndarray]], dict[str, str]]:
    """Return the measured and predicted arrays of each recording, and the error message of each that cannot be simulated.

    Tracked bodies have `positions` (1), `t` (T,) [s], and `measured`, `before` and `after` (T, N, 3) [m]. Predictions include the most
    probable nuisances and the other settings in their amounts; `before_model` and `after_model` are without them. Other data are vectors
    (n,) with `times`, `groups` (channel of each value) and, of a material test, `axis` (stretch or shear). Plane specimens have the arrays
    of `PlaneProblem.pictured` too.
    """
    out: dict[str, dict[str, np.ndarray]] = {}
    failed: dict[str, str] = {}
    problem: Problem = d.problem
    for n, recording in enumerate(problem.recordings):
        own = {when: ceiling.as_seen(d, when, n) for when in ("before", "after")}
        if not getattr(problem, "tracked", hasattr(problem, "motion")):
            over = abscissa(problem, n)
            out[recording.name] = {"times": recording.times, "groups": recording.groups, "measured": recording.y, **own}
            out[recording.name] |= {} if over is None else {"axis": over}
            if hasattr(inner(problem), "pictured"):
                out[recording.name] |= inner(problem).pictured({"before": d.before, "after": d.after}, n)
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
            shown[1:][seen[1:]] = own[when][: problem.coordinates(n)].reshape(-1, 3)
            arrays |= {when: shown, f"{when}_model": model}
        if hasattr(inner(problem), "pictured"):
            arrays |= inner(problem).pictured({"before": d.before, "after": d.after}, n, d.setting)
        out[recording.name] = arrays
    return out, failed


def _stages(d: Diagnosis, name: str, arrays: Mapping[str, np.ndarray]) -> list[residual.Series]:
    """Compute the missing quantity of each stage of a recording (`residual.stages`)."""
    n = [r.name for r in d.problem.recordings].index(name)
    r = d.problem.measured[n]
    mass = float(r.body.volume.double().sum()) * float(d.after.get("density", d.problem.experiment.model["density"]))
    return residual.stages(arrays["measured"], arrays["t"], arrays["before"], arrays["after"], mass=mass, sigma=d.final["before"].noise[n],
                           planes=r.scene.colliders, margin=1.5 * r.scene.dx)  # fmt: skip


def _place(d: Diagnosis, name: str, arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Return the place on the body where the missing force (before) is largest, from the centre [m], and its ratio to the median."""
    n = [r.name for r in d.problem.recordings].index(name)
    where, excess = residual.place(arrays["measured"], arrays["t"], arrays["before"], sigma=d.final["before"].noise[n])
    centre = d.problem.measured[n].body.x.double().mean(dim=0).numpy()
    return {"from_centre": list(where - centre), "unit": "m", "over_median": excess}


def plain(value: Any) -> Any:
    """Return a value with Python's own numbers and lists, as JSON needs them; numbers that are not finite become None."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [plain(v) for v in value]
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value
