"""The report of a diagnosis: one self-contained HTML page. Without matplotlib it has the tables and the player of the motion alone."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from neuido.data.files.html_page import escaped, table
from neuido.data.files.html_page import page as html_page
from neuido.discrepancy.inference.attribution import Diagnosis
from neuido.discrepancy.inference.judging import ALPHA
from neuido.discrepancy.report import figures, next_experiment
from neuido.discrepancy.report.ceiling import Ceiling
from neuido.discrepancy.report.diagnosis import MORE
from neuido.discrepancy.report.residual import Series

STYLE = """h2{font-size:1.15em}
.answer{font-size:1.2em;padding:.6em 1em;background:#f3f6f9;border-left:4px solid #1f77b4}
canvas{border:1px solid #ddd;background:#fff;touch-action:none;max-width:100%}
.player{margin-bottom:1.2em}.player label{margin-right:.8em}.b{color:#c0392b}.a{color:#1f77b4}"""
WEAK = "The missing force by the weak residual, which differentiates no measured position; grey: what noise alone makes of it."
NOTHING = "<p>The residual is noise alone: no effect was fitted.</p>"
SENTENCES = {
    "effect": "The declared model lacks {names}.",
    "class": "The declared model lacks an effect; these recordings cannot tell {names} apart.",
    "none": "Nothing is missing: what remains is what noise, nuisances and the discretisation bring.",
    "unknown": "Something is missing that none of the known effects explains.",
    "insufficient": "These recordings do not say whether something is missing.",
    "unfinished": "The time was up before every effect was tried: nothing is named yet.",
}
MORE_LEFT = (
    "The declared model lacks {names}, and something more that no effect here explains: what is left is {over:.0f} times what noise and "
    "discretisation would leave."
)
STANDS = " What remains stands at {noise:.1f} times the noise: an effect that does less would not be seen (see Not excluded)."
SIZES = "Sizes up to which an effect would not have been named here, to first order; empty: any size that it may have."
HELD_OUT = {
    "validation": "validation: held out of the fits, not of the choice of effects",
    "test": "test: not looked at before the answer was there",
}
"""What each error of held-out recordings is of."""


STANDS_ABOVE = 1.5
"""Times the noise above which the answer `none` says where the residual stands."""


@dataclass(eq=False)
class Details:
    """What is computed from a diagnosis for its report."""

    content: dict[str, Any]
    """Of diagnosis.json."""
    motion: dict[str, dict[str, np.ndarray]]
    """Arrays of each recording: measured, before, after, and what they are over."""
    stages: dict[str, list[Series]] = field(default_factory=dict)
    """Of each recording of a body."""
    ceilings: dict[str, Ceiling] = field(default_factory=dict)
    """`before` and `after`."""
    silhouettes: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Of each recording of a filmed body: masks, those drawn before and after, and their scores."""


def page(details: Sequence[Details], diagnoses: Sequence[Diagnosis], *, kind: str) -> str:
    """The whole page.

    Args:
        details: What `answer.describe` made of each diagnosis.
        diagnoses: The diagnoses.
        kind: `experiment`, `material test` or `track`.
    """
    name = diagnoses[0].problem.name if len(diagnoses) == 1 else diagnoses[0].problem.name.rpartition(": ")[0]
    parts = [f"<h1>Diagnosis of the {escaped(kind)} {escaped(name)}</h1>"]
    for made, d in zip(details, diagnoses, strict=True):
        if len(diagnoses) > 1:
            parts.append(f"<h1>{escaped(made.content.get('body', d.problem.name))}</h1>")
        parts += _one(made, d)
    seconds = sum(made.content["seconds"] for made in details)
    device, version = details[0].content["device"], details[0].content["version"]
    simulations = sum(d.evaluations for d in diagnoses)
    parts.append(f'<p class="note">neuido {escaped(version)}, {seconds:.0f} s on {escaped(device)}, {simulations} simulations.</p>')
    return html_page(name, "\n".join(part for part in parts if part), style=STYLE)


def _one(made: Details, d: Diagnosis) -> list[str]:
    c = made.content
    names = " and ".join(" or ".join(e["class"]) for e in c["effects"])
    bodies = {name: arrays for name, arrays in made.motion.items() if "positions" in arrays}
    out = [f'<p class="answer">{escaped(_answer(c, names))}</p>', _effects(c), _leads(c), _errors(c)]
    if c["left_out"]:
        out.append(
            f'<p class="note">{escaped("The time was up before: " + "; ".join(c["left_out"]) + ". More minutes go on from here.")}</p>'
        )
    for place, settings in c["settings_not_run"].items():
        lost = f"{place}: {', '.join(settings)} does not run there, and takes no part in the discretisation error."
        out.append(f'<p class="note">{escaped(lost)}</p>')
    for place, reason in c.get("not_predicted", {}).items():
        out.append(f'<p class="note">{escaped(f"{place} is not shown: {reason}.")}</p>')
    if bodies:
        out += [
            "<h2>Motion before and after</h2>",
            figures.player(bodies),
            figures.error_curves(bodies, c["error"]["noise_floor"], c["error"]["discretisation_floor"]),
        ]
        out += [
            "<h2>Where on the body</h2>",
            figures.residual_maps(bodies),
            "<h2>Which stage</h2>",
            _stages(made),
            figures.stage_curves(made.stages),
        ]
        out.append(f'<p class="note">{WEAK}</p>')
        for place, p in c["places"].items():
            at = ", ".join(_said(v, 3) for v in p["from_centre"])
            where = f"{place}: the missing force is largest at ({at}) m from the centre, {_said(p['over_median'], 3)} times the median."
            out.append(f"<p>{escaped(where)}</p>")
    elif made.silhouettes:
        out += figures.section(made.silhouettes)
    elif made.motion:
        out += ["<h2>Data before and after</h2>", figures.data_curves(made.motion, d.problem.unit)]
    out += _ranking(d)
    out += _sizes(c)
    if c["rejected"]:
        out += ["<h2>Rejected</h2>", table(("effect", "reason"), [(r["name"], r["reason"]) for r in c["rejected"]])]
    out += ["<h2>Fitted figures</h2>", _figures(c)]
    share = made.ceilings["after"]
    fit, held = (100 * min(max(value, 0.0), 1.0) for value in (share.fit, share.held_out))
    there = "" if math.isnan(share.held_out) else f", and {held:.0f} % of it on what was held out"
    if not math.isnan(share.fit):
        most = f"{fit:.0f} % of what remains beside noise where it was fitted{there}"
        out.append(f"<p>A small network explains {most}: the ceiling of any effect.</p>")
    out += ["<h2>Next experiment</h2>", f"<p>{escaped(next_experiment.summary(c['next_experiment']))}</p>"]
    if c["next_experiment"]:
        out.append(
            table(("other changes", "expected log odds"), [(o["change"], o["expected_log_odds"]) for o in c["next_experiment"]["others"]])
        )
    return out


def _answer(c: dict[str, Any], names: str) -> str:
    """The answer in a few sentences, what is wrong with the recordings first."""
    out = SENTENCES[c["answer"]].format(names=names or "it")
    over, noise = c["error"]["left_over_floor"], c["error"]["left_over_noise"]
    if c["effects"] and over is not None and over > MORE:
        out = MORE_LEFT.format(names=names, over=over)
    if c["answer"] == "none" and noise is not None and noise > STANDS_ABOVE:
        out += STANDS.format(noise=noise)
    if c["why"]:
        why = "; ".join(c["why"])
        out = f"{why[0].upper()}{why[1:]}. {out}"
    if c["would_help"]:
        out += f" What would help: {'; '.join(c['would_help'])}."
    return out


def _leads(c: dict[str, Any]) -> str:
    """What leads in a search that was cut off, and what it has not tried."""
    out = ""
    for lead in c["leads"]:
        figures = ", ".join(f"{key} = {_said(p['value'], 3)} {p['unit']}" for key, p in lead["parameters"].items())
        told = f"In the lead so far: {lead['name']} ({figures}), which lowers the error {lead['error_ratio']:.2f}-fold. It is no answer."
        out += f"<p>{escaped(told)}</p>"
    return out + (f"<p>{escaped('Not tried: ' + ', '.join(c['untried']) + '.')}</p>" if c["untried"] else "")


def _sizes(c: dict[str, Any]) -> list[str]:
    """How large each effect may be without having been seen."""
    rows = [(h["name"], h["parameter"], "" if h["up_to"] is None else _said(h["up_to"], 3), h["unit"]) for h in c["not_excluded"]]
    heads = ("effect", "parameter", "up to", "unit")
    return ["<h2>Not excluded</h2>", f"<p>{SIZES}</p>", table(heads, rows)] if rows else []


def _effects(c: dict[str, Any]) -> str:
    rows = []
    for e in c["effects"]:
        for key, p in e["parameters"].items():
            if isinstance(p["value"], list):
                value = ", ".join(f"{v:.4g}" for v in p["value"])
                rows.append((e["name"], key, value, p["unit"], "", f"{e['p_value']:.3g}", e["where"]))
            else:
                low, high = p["interval90"]
                rows.append((e["name"], key, p["value"], p["unit"], f"{_said(low)} to {_said(high)}", f"{e['p_value']:.3g}", e["where"]))
    return table(("effect", "parameter", "value", "unit", "90 % interval", "p (linear model)", "where"), rows) if rows else ""


def _errors(c: dict[str, Any]) -> str:
    e = c["error"]
    rows = [(name, before, e["after"]["by_recording"][name]) for name, before in e["before"]["by_recording"].items()]
    for name, label in (("fit", "all that is fitted"), *HELD_OUT.items()):
        if e["before"].get(name) is not None:
            rows.append((label, e["before"][name], e["after"][name]))
    rows = [(label, before, after, None if None in (before, after) else before / max(after, 1e-300)) for label, before, after in rows]
    known = ", ".join(dict.fromkeys(e.get("noise_from", {}).values())) or "not told whence"
    floors = f"Floors: noise {e['noise_floor']:.3g} {e['unit']} ({known}), discretisation {e['discretisation_floor']:.3g} {e['unit']}."
    out = f"<h2>Error [{escaped(e['unit'])}]</h2>" + table(("recording", "before", "after", "ratio"), rows) + f"<p>{escaped(floors)}</p>"
    return out + _settings(e)


def _settings(e: dict[str, Any]) -> str:
    """What other settings take part in the predictions, and what one simulation leaves without them."""
    if "one_setting" not in e:
        return ""
    held = "The predictions hold the differences of other settings, in the amounts that the fitted recordings ask for."
    rows = [(name, e["amounts"]["before"][name], amount) for name, amount in e["amounts"]["after"].items()]
    scored = "held_out" if e["one_setting"]["after"]["held_out"] is not None else "fit"
    before, after = (e["one_setting"][when][scored] for when in ("before", "after"))
    alone = f"One simulation without them leaves {_said(before, 3)} {e['unit']} before and {_said(after, 3)} {e['unit']} after."
    if height := e.get("contact_height"):
        places = " and ".join(f"{1e3 * height[when]:.3g} mm {when}" for when in ("before", "after"))
        alone += f" The colliders of that grid are higher than they are declared by {places}: a grid's floor is a layer of its nodes."
    return f"<p>{held}</p>" + table(("other setting", "amount before", "amount after"), rows) + f"<p>{escaped(alone)}</p>"


def _said(value: float | None, digits: int = 4) -> str:
    """A figure; none is one that is not finite, where a recording cannot be predicted."""
    return "infinite" if value is None else f"{value:.{digits}g}"


def _stages(made: Details) -> str:
    rows = []
    for recording, series in made.stages.items():
        for s in series:
            rows.append((recording, s.name, s.unit, s.size(s.before), s.size(s.after), s.size(s.noise), math.sqrt(s.excess(s.before))))
    return table(("recording", "stage", "unit", "missing before", "missing after", "noise", "before, in noise"), rows)


def _ranking(d: Diagnosis) -> list[str]:
    out = []
    for i, r in enumerate(d.rounds):
        kept = {id(t) for t in r.members} if r.chosen is not None else set()
        trials = sorted(r.trials, key=lambda t: (id(t) not in kept, t.score))
        threshold = r.by_chance(ALPHA)
        out.append(f"<h2>Ranking{f', step {i + 1}' if len(d.rounds) > 1 else ''}</h2>")
        out.append(figures.ranking([(t.candidate.key, t.gain, id(t) in kept) for t in trials], threshold))
        rows = []
        for t in trials:
            values = ", ".join(
                f"{p.name.partition('.')[2]} = {t.fit.point.get(p.name, p.value):.3g} {p.unit}" for p in t.candidate.parameters[:6]
            )
            verdict = t.reason or ("chosen" if t is r.chosen else "not told from it" if id(t) in kept else "")
            cosine = r.cosines.get(t.candidate.key)
            rows.append((t.candidate.key, values, f"{math.exp(t.gain):.2f}", "" if cosine is None else f"{cosine:.2f}", verdict))
        out.append(table(("effect", "parameters", "error ratio", "cosine to the best", "verdict"), rows))
        chance = f"chance brings {math.exp(threshold):.2f} at 95 %, from {len(r.null)} draws"
        told = f"p = {r.p_value:.3g}, of the largest gain over all candidates in a linear model of the fits; {chance}."
        out.append(f'<p class="note">{told}</p>' if trials else NOTHING)
    return out


def _figures(c: dict[str, Any]) -> str:
    rows = []
    for name in c["declared"]:
        b, a = c["declared"][name], c["after"][name]
        spans = (" to ".join(_said(v) for v in own["interval90"]) for own in (b, a))
        rows.append((name, b["unit"], b["value"], next(spans), a["value"], next(spans)))
    return table(("figure", "unit", "before", "90 % interval", "after", "90 % interval"), rows) if rows else "<p>None was free.</p>"
