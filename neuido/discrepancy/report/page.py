"""The page of a diagnosis: one HTML file, made from diagnosis.json and the predicted motions, that loads nothing from elsewhere."""

import json
import math
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from neuido.discrepancy.report import motion_player, plots
from neuido.discrepancy.report.reader_units import WRITTEN, Units, reach, rounded
from neuido.discrepancy.report.wording import FIGURES, Words, leading, listed, parameter_words, scored_by, title, worded, words_of

LIMIT = 6_000_000
"""Largest size of a page [bytes]."""
CURVE_POINTS = 24_000
"""Number of points of all curves on a page. With many recordings each curve has fewer."""
PARTS = Path(__file__).parent / "page_parts"
ANSWERS = {
    "effect": "an effect is missing",
    "class": "one of several effects is missing",
    "none": "nothing is missing",
    "unknown": "something unknown is missing",
    "insufficient": "the data do not say",
    "unfinished": "the search was cut off",
}
VERDICTS = {"named": "named", "class": "not told from it", "lead": "in the lead", "rejected": "rejected", "weighed": ""}
HELD_OUT = {
    "validation": "validation: held out of the fits, not of the choice of effects",
    "test": "test: not looked at before the answer was there",
}
"""Descriptions of the errors of held-out recordings."""
Motion = Mapping[str, Mapping[str, np.ndarray]]


class Table(NamedTuple):
    """A table with its heading."""

    heading: str
    head: tuple[str, ...]
    rows: Sequence[Sequence[str]]
    note: str = ""
    more: Sequence[str] = ()
    """Paragraphs below the table."""


class Section(NamedTuple):
    """Content of the page for one body."""

    name: str
    answer: str
    words: Words
    effects: Table
    tables: Sequence[Table]
    notes: Sequence[str]
    parts: Sequence[Mapping[str, Any]]
    """Headings, each with the numbers of its plots."""
    pictures: Sequence[tuple[str, str]]
    """Captions and data URLs of silhouettes."""


def page(contents: Sequence[Mapping[str, Any]], motions: Sequence[Motion], *, kind: str = "", name: str = "") -> str:
    """Return the page as HTML; curves and motions are thinned out until it is smaller than `LIMIT`.

    Args:
        contents: Part of diagnosis.json for each body, in the form of `neuido-diagnosis/2`.
        motions: Arrays of the recordings of each body, as in `predicted`.
        kind: `experiment`, `material test` or `track`.
        name: Name of the experiment. Empty: that of the first part.
    """
    units = Units.of(contents, reach=max(reach(m, c["error"]["unit"]) for c, m in zip(contents, motions)))
    share = 1.0
    while True:
        made = _page(contents, motions, kind, name or contents[0]["experiment"], units, share)
        if len(made.encode()) <= LIMIT or share < 0.05:
            return made
        share *= 0.6


def _page(contents: Sequence[Mapping[str, Any]], motions: Sequence[Motion], kind: str, name: str, units: Units, share: float) -> str:
    figures: list[dict[str, Any]] = []
    count = max(sum(len(m) for m in motions), 1)
    rows = max(int(share * min(plots.MOST_ROWS, CURVE_POINTS // count)), 40)
    room = share * motion_player.ROOM / len(contents)
    sections = [_section(c, m, units, figures, rows, room) for c, m in zip(contents, motions, strict=True)]
    summary = None
    if len(contents) > 1:
        summary = Table("All bodies", ("body", "answer", "size", "error before", "error after", "noise"), _summary(contents, units))
    return (
        environment()
        .get_template("page.html.j2")
        .render(
            name=name,
            kind=kind,
            sections=sections,
            summary=summary,
            several=len(sections) > 1,
            payload=json_in_html(figures),
            plotly=plotly_script() if figures else "",
            style=_part("page.css"),
            script=_part("page.js"),
            footer=_footer(contents),
        )
    )


@cache
def environment() -> Any:
    """Return the Jinja environment of the page's templates, which escapes all inserted text."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    return Environment(loader=FileSystemLoader(PARTS), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)


@cache
def _part(name: str) -> Any:
    from markupsafe import Markup

    return Markup((PARTS / name).read_text(encoding="utf-8"))


@cache
def plotly_script() -> Any:
    """Return Plotly's JavaScript from the Python package, safe inside a script element."""
    from markupsafe import Markup

    text = files("plotly").joinpath("package_data/plotly.min.js").read_text(encoding="utf-8")
    return Markup(text.replace("</script", "<\\/script").replace("<!--", "<\\!--"))


def json_in_html(value: Any) -> Any:
    """Return a value as JSON for a script element; characters that could end the element are escaped."""
    from markupsafe import Markup

    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    return Markup(text.translate({ord(c): f"\\u{ord(c):04x}" for c in "<>&\u2028\u2029"}))


def _section(c: Mapping[str, Any], motion: Motion, units: Units, figures: list[dict[str, Any]], rows: int, room: float) -> Section:
    parts: list[dict[str, Any]] = []

    def add(heading: str, made: Sequence[Mapping[str, Any]], *, form: str = "plot", note: str = "") -> None:
        if made:
            first = len(figures)
            figures.extend({"form": form} | dict(one) for one in made)
            parts.append({"heading": heading, "form": form, "numbers": range(first, len(figures)), "note": note})

    bodies = {name: arrays for name, arrays in motion.items() if "positions" in arrays}
    others = {name: arrays for name, arrays in motion.items() if "groups" in arrays and "positions" not in arrays}
    pictures: list[tuple[str, str]] = []
    if bodies:
        add("Motion before and after", [motion_player.player(bodies, c, units, room=room)], form="player")
        add("Error over time", [plots.error_over_time(name, arrays, c, units, rows) for name, arrays in bodies.items()])
        add("Where on the body", [motion_player.residual_map(bodies, c, units)], form="map", note=_places(c, units))
        add("Forces on the body", [p for name, arrays in bodies.items() for p in plots.force_plots(name, arrays, c)])
        add("Which stage", plots.stage_plots(c), note=WEAK)
    elif any("nodes" in arrays for arrays in motion.values()):
        add("The specimen before and after", [p for name, arrays in others.items() for p in plots.specimen_plots(name, arrays, c, units)],
            note=FIELD)  # fmt: skip
    elif any("masks" in arrays for arrays in motion.values()):
        from neuido.discrepancy.report import silhouette_pictures  # loads torch, which no other page needs

        pictures = silhouette_pictures.pictures(motion, c)
    else:
        add("Data before and after", [p for name, arrays in others.items() for p in plots.data_plots(name, arrays, c, units, rows)])
    steps = list(dict.fromkeys(m["step"] for m in c["models"]))
    for step in steps:
        own = [m for m in c["models"] if m["step"] == step]
        chance = next((row["error_ratio95"] for row in c["chance"] if row["step"] == step), None)
        made = plots.ranking(own, chance)
        if made:
            add("Rivals" if len(steps) == 1 else f"Rivals, step {step}", [made])
    return Section(
        name=c.get("body", c["experiment"]),
        answer=ANSWERS[c["answer"]],
        words=words_of(c, units),
        effects=_effects(c, units),
        tables=[
            t
            for t in (_errors(c, units), _silhouettes(c), *_models(c, units), _power(c, units), _rejected(c), _figures(c, units))
            if t.rows
        ],
        notes=_notes(c),
        parts=parts,
        pictures=pictures,
    )


FIELD = "Colours and arrows show measured minus predicted displacements; in a recording the largest arrow is a twelfth of the specimen."
WEAK = "What is missing, by the weak residual, which differentiates no measured position; grey: what noise alone makes of it."
SIZES = "The size that each other effect is smaller than with a probability of 90 %, to first order, given the fitted recordings."


def _places(c: Mapping[str, Any], units: Units) -> str:
    said = []
    for name, p in c["places"].items():
        factor, unit = units.scaled("m")
        at = ", ".join(rounded(factor * v, 2) for v in p["from_centre"])
        said.append(
            f"{name}: the missing force is largest {at} {unit} (x, y, z) from the centre, {rounded(p['over_median'], 2)} times its median."
        )
    return " ".join(said)


def _quantity(value: Any, unit: str, units: Units) -> str:
    """Return a value for a table in the unit of the page, without the unit; a vector in brackets."""
    factor = units.scaled(unit)[0]
    if isinstance(value, list):
        return f"({', '.join(_quantity(v, unit, units) for v in value)})"
    return "" if value is None else rounded(factor * value) if math.isfinite(value) else "infinite"


def _effects(c: Mapping[str, Any], units: Units) -> Table:
    rows = []
    for e in c["effects"]:
        for key, p in e["parameters"].items():
            value, interval = _quantity(p["value"], p["unit"], units), ""
            if not isinstance(p["value"], list):
                value, interval = units.figures(p["value"], p["interval90"], p["unit"])
            chance = "" if e.get("p_value") is None else f"{e['p_value']:.2g}"
            rows.append((title(e["name"]), e["name"], key, value, interval, units.label(p["unit"]), chance, e["where"]))
    head = ("effect", "identifier", "figure", "value", "90 % interval", "unit", "p", "where it shows")
    return Table("What is missing", head, rows)


def _errors(c: Mapping[str, Any], units: Units) -> Table:
    e = c["error"]
    factor, unit = units.scaled(e["unit"])
    found = [(plots.heading(name, c), b, e["after"]["by_recording"].get(name)) for name, b in e["before"]["by_recording"].items()]
    found += [
        (text, e["before"][key], e["after"][key])
        for key, text in (("fit", "all that is fitted"), *HELD_OUT.items())
        if e["before"].get(key) is not None
    ]
    rows = []
    for name, before, after in found:
        ratio = "" if None in (before, after) else rounded(before / max(after, 1e-300))
        rows.append((name, *("" if v is None else rounded(factor * v) for v in (before, after)), ratio))
    origin = listed(sorted(set(e.get("noise_from", {}).values()))) or "origin not told"
    noise = "not known" if e["noise_floor"] is None else units.said(e["noise_floor"], e["unit"])
    grid = e["discretisation_floor"] or 0.0
    more = [f"Floors: noise {noise} ({origin})" + (f", discretisation {units.said(grid, e['unit'])}." if grid > 0 else ".")]
    if "one_setting" in e:
        more += _settings(e, units)
    return Table("Errors", ("recording", f"before [{unit}]", f"after [{unit}]", "before / after"), rows, more=more)


def _silhouettes(c: Mapping[str, Any]) -> Table:
    rows = [
        (name, role.replace("_", " "), when, *(rounded(scores[when][role][key]) for key in ("iou", "outline_px", "outline_mm", "psnr")))
        for name, scores in c.get("silhouettes", {}).items()
        for role in scores["before"]
        for when in ("before", "after")
    ]
    return Table("Silhouettes", ("recording", "frames", "", "overlap (IoU)", "outline [px]", "outline [mm]", "PSNR [dB]"), rows)


def _settings(e: Mapping[str, Any], units: Units) -> list[str]:
    """Return sentences on the amounts of other settings in the predictions, and on the error of one simulation without them."""
    amounts = [
        f"{name}: {rounded(e['amounts']['before'][name], 2)} before, {rounded(v, 2)} after" for name, v in e["amounts"]["after"].items()
    ]
    out = []
    if amounts:
        held = "The predictions hold the differences of other settings, in the amounts that the fitted recordings ask for: "
        out.append(f"{held}{'; '.join(amounts)}.")
    scored = scored_by(e["one_setting"]["after"])
    before, after = (units.said(e["one_setting"][when][scored], e["unit"]) for when in ("before", "after"))
    alone = f"One simulation without them leaves {before} before and {after} after."
    if height := e.get("contact_height"):
        places = " and ".join(f"{units.said(height[when], 'm')} {when}" for when in ("before", "after"))
        alone += f" The colliders of that grid are higher than they are declared by {places}: a grid's floor is a layer of its nodes."
    return [*out, alone]


def _models(c: Mapping[str, Any], units: Units) -> list[Table]:
    """Return a table for each step with the effects that were tried and their fitted values, the best first."""
    steps: dict[int, list[Mapping[str, Any]]] = {}
    for m in c["models"]:
        steps.setdefault(m["step"], []).append(m)
    out = []
    for step, models in steps.items():
        rows = []
        for m in models:
            said = [
                f"{key} = {_quantity(p['value'], p['unit'], units)}{_unit_suffix(units.label(p['unit']))}"
                for key, p in list(m["parameters"].items())[:6]
            ]
            ratio = "" if not m.get("error_ratio") else rounded(m["error_ratio"])
            cosine = "" if m.get("cosine") is None else f"{m['cosine']:.2f}"
            evidence = "" if m.get("log_evidence") is None else rounded(m["log_evidence"])
            rows.append(
                (plots.label_of(m), m["name"], ", ".join(said), ratio, evidence, cosine, worded(m["reason"]) or VERDICTS[m["verdict"]])
            )
        told = next((row for row in c["chance"] if row["step"] == step), None)
        note = ""
        if told and told["p_value"] is not None:
            note = f"p = {told['p_value']:.2g}: {told['of']}."
        head = ["effect", "identifier", "fitted", "error ratio", "evidence", "cosine to the best", "verdict"]
        shown = [i for i in range(len(head)) if i not in (4, 5) or any(row[i] for row in rows)]
        heading = "Effects that were tried" if len(steps) == 1 else f"Effects that were tried, step {step}"
        out.append(Table(heading, tuple(head[i] for i in shown), [[row[i] for i in shown] for row in rows], note))
    return out


def _unit_suffix(unit: str) -> str:
    return "" if unit == WRITTEN["1"] else f" {unit}"


def _power(c: Mapping[str, Any], units: Units) -> Table:
    rows = []
    for row in c["power"]:
        size = "any size" if row["up_to"] is None else rounded(units.scaled(row["unit"])[0] * row["up_to"])
        rows.append(
            (
                title(row["name"]),
                row["name"],
                f"{parameter_words(row['name'], row['parameter'])} ({row['parameter']})",
                size,
                units.label(row["unit"]),
            )
        )
    return Table("Not excluded", ("effect", "identifier", "figure", "up to", "unit"), rows, SIZES)


def _rejected(c: Mapping[str, Any]) -> Table:
    tried = {m["name"] for m in c["models"]}
    rows = [(title(r["name"]), r["name"], worded(r["reason"])) for r in c["rejected"] if r["name"] not in tried]
    return Table("Not fitted in full" if tried else "Rejected", ("effect", "identifier", "reason"), rows)


def _figures(c: Mapping[str, Any], units: Units) -> Table:
    rows = []
    for name, b in c["declared"].items():
        cells = [cell for own in (b, c["after"].get(name, b)) for cell in units.figures(own["value"], own["interval90"], own["unit"])]
        rows.append((FIGURES.get(name, name.replace("_", " ")), name, units.label(b["unit"]), *cells))
    return Table("The model's own figures", ("figure", "identifier", "unit", "before", "90 % interval", "after", "90 % interval"), rows)


def _notes(c: Mapping[str, Any]) -> list[str]:
    out = [
        f"{place}: {listed(settings)} does not run there, and takes no part in the discretisation error."
        for place, settings in c["settings_not_run"].items()
    ]
    out += [f"{place} is not shown: {reason}." for place, reason in c.get("not_predicted", {}).items()]
    share = c["ceiling"].get("after", {})
    fit, held = (None if share.get(key) is None else 100 * min(max(share[key], 0.0), 1.0) for key in ("fit", "held_out"))
    if fit is not None:
        there = "" if held is None else f", and {held:.0f} % of it on what was held out"
        out.append(
            f"A small network explains {fit:.0f} % of what remains beside noise where it was fitted{there}: the ceiling of any effect."
        )
    if c.get("next_experiment") and c["next_experiment"]["others"]:
        said = [f"{o['change']} (expected log odds {rounded(o['expected_log_odds'], 2)})" for o in c["next_experiment"]["others"]]
        out.append(f"Other changes that tell them apart: {'; '.join(said)}.")
    return out


def _summary(contents: Sequence[Mapping[str, Any]], units: Units) -> list[tuple[str, ...]]:
    rows = []
    for c in contents:
        said, e = [], c["error"]
        for effect in c["effects"]:
            keys = leading(effect["parameters"])
            value = ", ".join(_summary_figure(key, effect["parameters"][key], units) for key in keys)
            said.append(f"{listed([title(name) for name in effect['class']], 'or')}{f': {value}' if value else ''}")
        scored = scored_by(e["after"])
        before, after = (units.said(e[when][scored], e["unit"]) for when in ("before", "after"))
        noise = "" if e["noise_floor"] is None else units.said(e["noise_floor"], e["unit"])
        rows.append((c.get("body", c["experiment"]), ANSWERS[c["answer"]], "; ".join(said), before, after, noise))
    return rows


def _summary_figure(key: str, p: Mapping[str, Any], units: Units) -> str:
    value, interval = units.figures(p["value"], p["interval90"], p["unit"])
    return f"{key.replace('_', ' ')} = {value}{_unit_suffix(units.label(p['unit']))}{f' ({interval})' if interval else ''}"


def _footer(contents: Sequence[Mapping[str, Any]]) -> str:
    seconds = sum(c["seconds"] for c in contents)
    runs = [c["work"]["simulations"] for c in contents]
    ran = f", {sum(runs)} simulations" if all(runs) else ""
    return f"neuido {contents[0]['version']}, {seconds:.0f} s on {contents[0]['device']}{ran}."
