"""Scores of diagnoses against the sealed keys of `neuido undeclared`, and the answers of ablations.

A key is a mapping written by `neuido.data.undeclared`, or a truth.yaml of the same form. A diagnosis is the content of diagnosis.json, and
a trace is the content of trace.json.
"""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import beta

NAMED = ("effect", "class")
FROM_TRACE = ("plain-bic", "no-unknown", "take-smallest-error")
"""Ablations that can be computed from the results of a full diagnosis."""


def score(key: Mapping[str, Any], diagnosis: Mapping[str, Any]) -> dict[str, Any]:
    """Return the scores of one case.

    `exact` means that the named effects are the true ones. `in_class` means that each true effect is in the class of a different named
    effect. Both require the right number of named effects. `found` is the number of true effects that are in a class.
    """
    true = key.get("undeclared") or []
    outside = any(one.get("outside_library") for one in true)
    effects = diagnosis.get("effects") or []
    answer = diagnosis["answer"]
    named, classes = _named(diagnosis)
    wanted = [set(one["diagnosis_names"]) for one in true if not one.get("outside_library")]
    pairs = _pairs(wanted, classes)
    exact = [i for i, j in pairs if named[j] in wanted[i]]
    whole = len(named) == len(wanted)
    errors, covered = [], []
    known = [one for one in true if not one.get("outside_library")]
    for i, j in pairs:
        one, effect = known[i], effects[j]
        if effect["name"] not in one["diagnosis_names"]:
            continue
        asked = _sizes(one, effect["parameters"])
        if asked:
            off = [effect["parameters"][name]["value"] - value for name, value in asked.items()]
            errors.append(math.hypot(*off) / math.hypot(*asked.values()))
            intervals = [(value, effect["parameters"][name]["interval90"]) for name, value in asked.items()]
            covered += [_inside(value, interval) for value, interval in intervals if interval is not None]
    for name, figure in (diagnosis.get("after") or {}).items():
        if covered and name in (key.get("material") or {}) and whole and len(exact) == len(wanted) and not outside:
            covered.append(_inside(key["material"][name], figure["interval90"]))
    error = diagnosis["error"]
    before, after = (error[when].get("held_out") or error[when].get("fit") for when in ("before", "after"))
    floor = math.hypot(error["noise_floor"], error["discretisation_floor"])
    reference = max((r.get("reference_rms_m", 0.0) for r in key.get("recordings", [])[:1]), default=0.0)
    apart = min((r["separation_rms_m"] for r in key.get("recordings", [])[:1] if "separation_rms_m" in r), default=math.nan)
    return {
        "group": group_of(key),
        "measured": key.get("measured", "body"),
        "kind": "+".join(one["kind"] for one in true) or "none",
        "solver": key.get("solver", ""),
        "snr": apart / math.hypot(key.get("noise") or math.nan, reference),
        "answer": answer,
        "named": "+".join(named),
        "classes": " ".join("|".join(sorted(c)) for c in classes),
        "class_size": max((len(c) for c in classes), default=0),
        "exact": bool(wanted) and whole and len(exact) == len(wanted),
        "in_class": bool(wanted) and whole and len(pairs) == len(wanted),
        "found": len(pairs),
        "effects": len(wanted),
        "near": outside and any(c & set(one.get("near", ())) for c in classes for one in true),
        "parameter_error": float(np.median(errors)) if errors else math.nan,
        "covered": sum(covered),
        "intervals": len(covered),
        "before": before,
        "after": after,
        "floor": floor,
        "noise": error["noise_floor"],
        "seconds": diagnosis.get("seconds", math.nan),
    }


def _named(diagnosis: Mapping[str, Any]) -> tuple[list[str], list[set[str]]]:
    """Return the effects that a diagnosis names, and the class of each."""
    effects = (diagnosis.get("effects") or []) if diagnosis["answer"] in NAMED else []
    return [e["name"] for e in effects], [{e["name"], *e.get("class", ())} for e in effects]


NEAR = 0.25
"""Relative distance from the true sizes up to which a fit of the true effects counts as near its optimum; noise alone is another sign."""
AT_NOISE = 1.1
"""Times the noise that a fit of the true effects may leave in each part to count as near its optimum."""


def replayed(key: Mapping[str, Any], diagnosis: Mapping[str, Any], case: Any, decision: Any) -> dict[str, Any]:
    """Return what a replayed case says of the search and of the decision.

    `tried`: all true effects were fitted together. `reached`: one of these fits ended near its optimum. `named`: each true effect is in the
    class of a different named effect. `same`: the replay gives the answer, the effects and the classes of the diagnosis.

    Args:
        key: The truth.
        diagnosis: The content of diagnosis.json.
        case: A `CaseRecord`.
        decision: What `decide` says of it.
    """
    true = key.get("undeclared") or []
    outside = any(one.get("outside_library") for one in true)
    fits = [end for r in case.judged for fit in r.fits for end in (fit, fit.finished) if end is not None]
    own = of_the_truth(key, fits)
    reached = near_the_truth(key, case, own)
    effects = [{"name": name.partition(":")[0], "class": list(c), "parameters": {}}
               for name, c in zip(decision.effects, decision.classes, strict=True)]  # fmt: skip
    now = score(key, {**diagnosis, "answer": decision.answer, "effects": effects})
    live, classes = _named(diagnosis)
    same = diagnosis["answer"] == decision.answer and live == [e["name"] for e in effects] and classes == [set(c) for c in decision.classes]
    return {
        "group": group_of(key),
        "kind": now["kind"],
        "solver": key.get("solver", ""),
        "tried": bool(own),
        "reached": bool(reached),
        "named": now["in_class"],
        "outside": outside,
        "answer": decision.answer,
        "effects": now["named"],
        "same": same,
        "effort": sum(w["effort"] for w in case.work.values()),
    }


def by_evidence(key: Mapping[str, Any], diagnosis: Mapping[str, Any], case: Any, verdict: Any) -> dict[str, Any]:
    """Return what the evidence of stored fits says of a case.

    An effect's class holds what takes its place in a set of the verdict that has the best one's other effects. A search that was cut off
    is as unfinished here as in the diagnosis.

    Args:
        key: The truth.
        diagnosis: The content of diagnosis.json.
        case: A `CaseRecord`.
        verdict: Of `judged`, none where the declared model has no statistics.
    """
    if verdict is None:
        return {"evidence_answer": "", "evidence_sets": "", "evidence_lead": math.nan, "evidence_p": math.nan, "evidence_named": False}
    sets = [[name.partition(":")[0] for name in one] for one in verdict.sets]
    effects = []
    for name in sets[0] if sets else []:
        rest = [other for other in sets[0] if other != name]
        others = {n for one in sets if len(one) == len(sets[0]) and set(rest) <= set(one) for n in set(one) - set(rest)}
        effects.append({"name": name, "class": sorted({name} | others), "parameters": {}})
    answer = "unfinished" if case.facts["cut"] else "insufficient" if case.facts["wrong"] else verdict.answer
    now = score(key, {**diagnosis, "answer": answer, "effects": effects})
    named = " or ".join("+".join(one) for one in sets) or verdict.answer
    return {
        "evidence_answer": answer,
        "evidence_sets": named,
        "evidence_lead": verdict.lead,
        "evidence_p": verdict.p_value,
        "evidence_named": now["in_class"],
    }


def of_the_truth(key: Mapping[str, Any], fits: Sequence[Any]) -> list[Any]:
    """Return the fits of the true effects of the library and no others."""
    known = [one for one in key.get("undeclared") or [] if not one.get("outside_library")]
    return [fit for fit in fits if known and _is_of(fit.effects, known)]


def near_the_truth(key: Mapping[str, Any], case: Any, fits: Sequence[Any]) -> list[Any]:
    """Return those fits of the true effects of a `CaseRecord` that ended near their optimum."""
    known = [one for one in key.get("undeclared") or [] if not one.get("outside_library")]
    noise = [case.recordings[n][3] for n, *_ in case.parts]
    return [fit for fit in fits if _is_near(fit, known) or all(e < (AT_NOISE * s) ** 2 for e, s in zip(fit.errors, noise, strict=True))]


def _is_of(effects: Sequence[str], known: Sequence[Mapping[str, Any]]) -> bool:
    """Whether a fit has the true effects and no others."""
    names = [{name.partition(":")[0]} for name in effects]
    wanted = [set(one["diagnosis_names"]) for one in known]
    return len(names) == len(wanted) and len(_pairs(wanted, names)) == len(wanted)


def _is_near(fit: Any, known: Sequence[Mapping[str, Any]]) -> bool:
    """Whether the sizes of a fit are near the true ones, those of every effect that has sizes to compare."""
    compared = 0
    for one in known:
        names = {name.partition(":")[0] for name in fit.effects} & set(one["diagnosis_names"])
        own = {p.partition(".")[2]: value for p, value in fit.point.items() if p.partition(".")[0] in names}
        asked = _sizes(one, own)
        if asked:
            compared += 1
            off = math.hypot(*(own[name] - value for name, value in asked.items()))
            if off > NEAR * math.hypot(*asked.values()):
                return False
    return compared == len(known)


def recall(rows: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Return search recall and decision accuracy of replayed cases as text."""

    def share(count: int, of: int) -> str:
        return f"{count} of {of} ({100 * count / of:.0f} %)" if of else "none made"

    out = {}
    for name, groups in {"one effect": ("one",), "two effects": ("two",)}.items():
        own = [r for r in rows if r["group"] in groups]
        reached = [r for r in own if r["reached"]]
        out[f"{name}: true effects fitted"] = share(sum(r["tried"] for r in own), len(own))
        out[f"{name}: fitted near the optimum (search recall)"] = share(len(reached), len(own))
        out[f"{name}: of these named (decision accuracy)"] = share(sum(r["named"] for r in reached), len(reached))
    nulls = [r for r in rows if r["group"] in ("null", "nuisance")]
    out["nulls on which an effect is named"] = share(sum(r["answer"] in NAMED for r in nulls), len(nulls))
    out["outside the library: unknown or insufficient"] = share(
        sum(r["answer"] in ("unknown", "insufficient") for r in rows if r["outside"]), sum(r["outside"] for r in rows)
    )
    told = [r for r in rows if r.get("evidence_answer")]
    if told:
        out["evidence (experimental): nulls on which an effect is named"] = share(
            sum(r["evidence_answer"] in NAMED for r in told if r in nulls), sum(r in nulls for r in told)
        )
        for name, group in {"one effect": "one", "two effects": "two"}.items():
            own = [r for r in told if r["group"] == group and r["reached"]]
            out[f"evidence (experimental): {name}, of those fitted near the optimum in class"] = share(
                sum(r["evidence_named"] for r in own), len(own)
            )
        outside = [r for r in told if r["outside"]]
        out["evidence (experimental): outside the library: unknown"] = share(
            sum(r["evidence_answer"] == "unknown" for r in outside), len(outside)
        )
    out["replay equal to the diagnosis"] = share(sum(r["same"] for r in rows), len(rows))
    efforts = [r["effort"] for r in rows]
    out["particle-substeps a case, median"] = f"{float(np.median(efforts)):.3g}" if efforts else "none"
    return out


def group_of(key: Mapping[str, Any]) -> str:
    """Return the group of a case: null, nuisance (a null with wrong nuisance parameters), one, two or outside."""
    true = key.get("undeclared") or []
    if not true:
        return "nuisance" if key.get("nuisances") else "null"
    if any(one.get("outside_library") for one in true):
        return "outside"
    return "one" if len(true) == 1 else "two"


def _pairs(wanted: Sequence[set[str]], classes: Sequence[set[str]]) -> list[tuple[int, int]]:
    """Return a maximum matching between true effects and classes that contain them."""
    best: list[tuple[int, int]] = []
    slots = [*range(len(classes)), *[-1] * len(wanted)]
    for order in set(itertools.permutations(slots, len(wanted))):
        found = [(i, j) for i, j in enumerate(order) if j >= 0 and wanted[i] & classes[j]]
        best = max(best, found, key=len)
    return best


def _sizes(one: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, float]:
    """Return the true values of the parameters that a diagnosis estimates, by its names; vectors by component."""
    flat: dict[str, float] = {}
    for name, value in one["parameters"].items():
        if name in one.get("sizes", (name,)) and name not in ("centre", "radius"):
            flat |= dict(zip("xyz", value)) if isinstance(value, list) else {name: value}
    asked = {name: float(value) for name, value in flat.items() if name in given}
    return asked if len(asked) == len(flat) and any(asked.values()) else {}


def _inside(value: float, interval: Sequence[float]) -> bool:
    return interval[0] <= value <= interval[1]


def upper_bound(count: int, of: int, level: float = 0.95) -> float:
    """Return the one-sided Clopper-Pearson upper bound of a proportion at `level`."""
    return 1.0 if count >= of else float(beta.ppf(level, count + 1, of - count))


def summary(rows: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Return the entries of a column of the table as text."""

    def of(*groups: str) -> list[Mapping[str, Any]]:
        return [r for r in rows if r["group"] in groups]

    def share(test: Callable[[Mapping[str, Any]], Any], among: Sequence[Mapping[str, Any]]) -> str:
        count = sum(bool(test(r)) for r in among)
        return f"{count} of {len(among)} ({100 * count / len(among):.0f} %)" if among else "none made"

    def median(values: Sequence[float], form: str = "{:.3g}") -> str:
        good = [v for v in values if math.isfinite(v)]
        return form.format(float(np.median(good))) if good else "none"

    nulls, known, outside = of("null", "nuisance"), of("one", "two"), of("outside")
    alarms = sum(r["answer"] in NAMED for r in nulls)
    named = [r for r in known if r["answer"] in NAMED]
    clear = [r for r in known if r["snr"] >= 10]
    dim = [r for r in known if r["snr"] < 10]
    covered, intervals = sum(r["covered"] for r in known), sum(r["intervals"] for r in known)
    right = [r for r in known if r["in_class"]]
    return {
        "false alarms on nulls": share(lambda r: r["answer"] in NAMED, nulls),
        "their 95 % upper bound": f"{100 * upper_bound(alarms, len(nulls)):.0f} %" if nulls else "none made",
        "of these with wrong nuisances": share(lambda r: r["answer"] in NAMED, of("nuisance")),
        "nulls answered none": share(lambda r: r["answer"] == "none", nulls),
        "in class": share(lambda r: r["in_class"], known),
        "exact": share(lambda r: r["exact"], known),
        "in class, effect >= 10 times the floor": share(lambda r: r["in_class"], clear),
        "in class, smaller effects": share(lambda r: r["in_class"], dim),
        "missed (no effect named)": share(lambda r: r["answer"] not in NAMED, known),
        "class size, median and largest": f"{median([r['class_size'] for r in named])}, {max((r['class_size'] for r in named), default=0)}",
        "two effects, both in class": share(lambda r: r["found"] == 2, of("two")),
        "two effects, at least one in class": share(lambda r: r["found"] >= 1, of("two")),
        "outside the library: unknown": share(lambda r: r["answer"] == "unknown", outside),
        "outside: a near effect named": share(lambda r: r["answer"] in NAMED and r["near"], outside),
        "outside: another effect named": share(lambda r: r["answer"] in NAMED and not r["near"], outside),
        "median parameter error": median([100 * r["parameter_error"] for r in known], "{:.3g} %"),
        "coverage of 90 % intervals": f"{covered} of {intervals} ({100 * covered / intervals:.0f} %)" if intervals else "none",
        "held-out error, before / after, median": median([r["before"] / r["after"] for r in right]),
        "held-out after <= 1.5 sqrt(noise^2 + disc^2)": share(lambda r: r["after"] <= 1.5 * r["floor"], right),
        "seconds, median": median([r["seconds"] for r in rows]),
        "failed": share(lambda r: r["answer"] == "failed", rows),
    }


def table(columns: Mapping[str, Mapping[str, str]]) -> str:
    """Return a table in Markdown with a column for each ablation."""
    lines = ["| " + " | ".join(["", *columns]) + " |", "| " + " | ".join(["---"] * (len(columns) + 1)) + " |"]
    for name in next(iter(columns.values())):
        lines.append("| " + " | ".join([name, *(column[name] for column in columns.values())]) + " |")
    return "\n".join(lines)


def ablated(how: str, diagnosis: Mapping[str, Any], trace: Mapping[str, Any]) -> dict[str, Any]:
    """Return the answer of an ablation, computed from the fits of the full diagnosis.

    * `plain-bic` adds effects as long as they lower the Bayesian information criterion of the fitted recordings with independent noise.
    * `take-smallest-error` always names the candidate of the first round with the smallest fitted error.
    * `no-unknown` names the best candidate if the answer is `unknown`.

    If no candidate was fitted, because the declared model already reaches the noise, the answer is unchanged.
    """
    out = dict(diagnosis)
    rounds = [r for r in trace["rounds"] if r["trials"]]
    if not rounds:
        return out
    fitted = [i for i, part in enumerate(trace["parts"]) if part["fitted"]]
    rows = sum(trace["parts"][i]["rows"] for i in fitted)

    def mean(squares: Sequence[float | None]) -> float:
        total = sum((math.inf if squares[i] is None else squares[i]) * trace["parts"][i]["rows"] for i in fitted)
        return total / rows

    chosen: list[Mapping[str, Any]] = []
    if how == "take-smallest-error":
        chosen = [min(rounds[0]["trials"], key=lambda t: mean(t["mean_squares"]))]
    elif how == "no-unknown":
        if diagnosis["answer"] != "unknown":
            return out
        able = [t for t in rounds[0]["trials"] if all(v is not None for v in t["mean_squares"])]
        chosen = [min(able, key=lambda t: t["score"])] if able else []
    elif how == "plain-bic":
        for r in rounds:
            here = mean(r["mean_squares"])
            gains = [rows * (math.log(here) - np.log(mean(t["mean_squares"]))) - t["parameters"] * math.log(rows) for t in r["trials"]]
            best = int(np.argmax(gains))
            if gains[best] <= 0:
                break
            chosen.append(r["trials"][best])
            if r["chosen"] != chosen[-1]["key"]:
                break  # the next round started from another effect
    else:
        raise ValueError(f"{how} does not follow from a trace")
    out["answer"] = "effect" if chosen else "none"
    out["effects"] = [
        {"name": t["name"], "class": [t["name"]],
         "parameters": {name.partition(".")[2]: {"value": value, "interval90": None} for name, value in t["point"].items()
                        if name.partition(".")[0] == t["name"]}}
        for t in chosen
    ]  # fmt: skip
    if chosen:
        unit = diagnosis["error"]["before"]["held_out"]
        held = [i for i, part in enumerate(trace["parts"]) if not part["fitted"]]
        if held and unit:
            ratio = sum(chosen[-1]["mean_squares"][i] or math.inf for i in held) / sum(trace["rounds"][0]["mean_squares"][i] for i in held)
            out["error"] = {**diagnosis["error"], "after": {**diagnosis["error"]["after"], "held_out": unit * math.sqrt(ratio)}}
    return out
