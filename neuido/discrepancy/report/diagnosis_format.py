"""The format of diagnosis.json: its JSON Schema, the check of a file, and the conversion of older files."""

import copy
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from neuido.data.files.parsing import naming, read_json
from neuido.errors import UserError

FORMAT = "neuido-diagnosis/2"
OLDER = "neuido-diagnosis/1"
ANSWERS = ("effect", "class", "none", "unknown", "insufficient", "unfinished")
VERDICTS = ("named", "class", "lead", "rejected", "weighed")
"""Verdicts on an effect that was tried.

It is named; the data cannot tell it from the named one (class); it leads in a search that was cut off; it is rejected for a stated reason;
or it was compared and explains less (weighed).
"""
KINDS = ("experiment", "material test", "track", "plane specimen")
Schema = dict[str, Any]
TEXT: Schema = {"type": "string", "minLength": 1}
ANY_TEXT: Schema = {"type": "string"}
NUMBER: Schema = {"type": "number"}
MAYBE: Schema = {"type": ["number", "null"]}
STEP: Schema = {"type": "integer", "minimum": 1}
CHANCE: Schema = {"anyOf": [{"type": "number", "minimum": 0, "maximum": 1}, {"type": "null"}]}
VECTOR: Schema = {"type": "array", "items": NUMBER, "minItems": 3, "maxItems": 3}


def listing(entry: Schema, **more: Any) -> Schema:
    """Return the schema of a list."""
    return {"type": "array", "items": entry, **more}


def mapping(entry: Schema) -> Schema:
    """Return the schema of a mapping by name."""
    return {"type": "object", "additionalProperties": entry}


def record(required: Schema, optional: Schema | None = None) -> Schema:
    """Return the schema of a mapping with fixed keys; later versions may add keys."""
    return {"type": "object", "properties": required | (optional or {}), "required": list(required)}


FIGURE: Schema = {"anyOf": [MAYBE, listing(NUMBER)]}
INTERVAL: Schema = {"type": "array", "minItems": 2, "maxItems": 2, "description": "90 % interval; null: no bound"}
QUANTITY = record({"value": FIGURE, "unit": ANY_TEXT, "interval90": INTERVAL})
MEASURED = record({"value": FIGURE, "unit": ANY_TEXT})
SCORES = record({"fit": MAYBE, "by_recording": mapping(MAYBE)}, {key: MAYBE for key in ("held_out", "validation", "test")})
AXIS = record({"label": TEXT, "unit": ANY_TEXT})
PLANE = record({"point": VECTOR, "normal": VECTOR}, {"contact": ANY_TEXT, "friction": MAYBE})


def schema() -> Schema:
    """Return the JSON Schema of `neuido-diagnosis/2`."""
    effect = record(
        {
            "name": TEXT,
            "class": listing(TEXT, minItems=1),
            "parameters": mapping(QUANTITY),
            "p_value": CHANCE,
            "where": ANY_TEXT,
            "step": STEP,
        },
        {"title": TEXT, "form": ANY_TEXT, "p_value_of": ANY_TEXT, "at_limit": TEXT},
    )
    error = record(
        {"measure": TEXT, "unit": TEXT, "noise_floor": MAYBE, "discretisation_floor": MAYBE, "before": SCORES, "after": SCORES},
        {
            "left_over_floor": MAYBE,
            "left_over_noise": MAYBE,
            "worst_over_floor": MAYBE,
            "noise_from": mapping({"enum": ["stated", "estimated", "assumed"]}),
            "amounts": record({"before": mapping(NUMBER), "after": mapping(NUMBER)}),
            "one_setting": record({"before": SCORES, "after": SCORES}),
            "contact_height": record({"before": NUMBER, "after": NUMBER, "unit": TEXT}),
        },
    )
    model = record(
        {"step": STEP, "name": TEXT, "verdict": {"enum": list(VERDICTS)}, "reason": ANY_TEXT, "parameters": mapping(MEASURED)},
        {"form": ANY_TEXT, "error_ratio": MAYBE, "log_evidence": MAYBE, "score": MAYBE, "cosine": MAYBE},
    )
    power = record({"name": TEXT, "parameter": TEXT, "unit": ANY_TEXT, "up_to": MAYBE}, {"largest": MAYBE, "ordinary": NUMBER})
    recording = record(
        {"role": {"enum": ["fit", "held_out"]}},
        {
            "quantity": TEXT,
            "axis": AXIS,
            "timed": {"type": "boolean"},
            "channels": listing(TEXT),
            "parts": listing(TEXT),
            "mode": TEXT,
            "gravity": VECTOR,
            "colliders": listing(PLANE),
            "inset": NUMBER,
            "frame_times": listing(NUMBER),
        },
    )
    stage = record(
        {"stage": TEXT, "unit": TEXT, **{key: listing(MAYBE) for key in ("times", "before", "after", "noise")}},
    )
    work = record(
        {
            "simulations": {"type": "integer", "minimum": 0},
            "reused": {"type": "integer", "minimum": 0},
            "effort": NUMBER,
            "effort_unit": TEXT,
        },
        {
            "limit": MAYBE,
            "ended_by": {"enum": ["effort", "time", ""]},
            "by_step": mapping(record({"simulations": NUMBER, "effort": NUMBER})),
        },
    )
    change = record({"change": TEXT, "expected_log_odds": NUMBER})
    following = record(
        {"change": TEXT, "tells_apart": listing(TEXT, minItems=2, maxItems=2), "expected_log_odds": NUMBER, "others": listing(change)}
    )
    part = record(
        {
            "answer": {"enum": list(ANSWERS)},
            "words": listing(ANY_TEXT),
            "why": listing(ANY_TEXT),
            "would_help": listing(ANY_TEXT),
            "effects": listing(effect),
            "leads": listing(record({"name": TEXT, "parameters": mapping(MEASURED)}, {"error_ratio": MAYBE})),
            "untried": listing(TEXT),
            "declared": mapping(QUANTITY),
            "after": mapping(QUANTITY),
            "error": error,
            "models": listing(model),
            "chance": listing(record({"step": STEP, "p_value": CHANCE, "error_ratio95": MAYBE, "of": ANY_TEXT})),
            "power": listing(power),
            "rejected": listing(record({"name": TEXT, "reason": ANY_TEXT})),
            "recordings": mapping(recording),
            "stages": mapping(listing(stage)),
            "places": mapping({"type": "object"}),
            "settings_not_run": mapping(listing(ANY_TEXT)),
            "next_experiment": {"anyOf": [following, {"type": "null"}]},
            "ceiling": mapping({"type": "object"}),
            "left_out": listing(ANY_TEXT),
            "work": work,
            "seconds": NUMBER,
            "device": TEXT,
            "version": TEXT,
        },
        {
            "body": TEXT,
            "experiment": TEXT,
            "solver": TEXT,
            "reach": NUMBER,
            "not_predicted": mapping(ANY_TEXT),
            "doubts": mapping(listing(TEXT)),
            "unseen": TEXT,
            "scale_error": {"type": "array", "items": NUMBER},
            "gravity": record(dict.fromkeys(("declared", "found", "length", "time"), NUMBER)),
            "silhouettes": {"type": "object"},
        },
    )
    head = {"format": {"const": FORMAT}, "experiment": TEXT, "kind": {"enum": list(KINDS)}}
    several = record({"bodies": listing({"allOf": [part, {"required": ["body"]}]}, minItems=1)})
    return {"type": "object", "properties": head, "required": list(head), "if": {"required": ["bodies"]}, "then": several, "else": part}


def read(path: Path) -> dict[str, Any]:
    """Read a diagnosis.json in the form of `neuido-diagnosis/2`; what an older file lacks is empty.

    Raises:
        UserError: The file is no valid JSON, has another format, or does not match its schema.
    """
    content = read_json(path)
    found = content.get("format") if isinstance(content, dict) else None
    if found not in (FORMAT, OLDER):
        raise UserError(f"{path}: format = {found!r} must be {FORMAT} or {OLDER}; run `neuido diagnose` again")
    with naming(path, f"is not as {found} says"):
        content = upgraded(content) if found == OLDER else content
        check(content, path)
    return content


def check(content: Mapping[str, Any], path: Path | str) -> None:
    """Check content against the schema.

    Raises:
        UserError: The content does not match; the message names the place.
    """
    from jsonschema import Draft202012Validator
    from jsonschema.exceptions import best_match

    error = best_match(Draft202012Validator(schema()).iter_errors(content))
    if error is not None:
        place = ".".join(map(str, error.absolute_path)) or "the file"
        raise UserError(f"{path}: {place}: {error.message[:200]}")


def upgraded(content: Mapping[str, Any]) -> dict[str, Any]:
    """Convert a `neuido-diagnosis/1` to `neuido-diagnosis/2`."""
    out = copy.deepcopy(dict(content))
    out["format"] = FORMAT
    parts = out.get("bodies", [out])
    for c in parts:
        c.setdefault("experiment", out.get("experiment", "experiment"))
        for key in ("why", "would_help", "leads", "untried", "left_out", "models", "chance"):
            c.setdefault(key, [])
        for key in ("settings_not_run", "places", "stages", "ceiling"):
            c.setdefault(key, {})
        c.setdefault("next_experiment", None)
        c["power"] = c.pop("not_excluded", [])
        for i, e in enumerate(c["effects"]):
            e.setdefault("step", i + 1)
        e = c["error"]
        c.setdefault(
            "recordings", {name: {"role": "fit"} for name in e["before"]["by_recording"]} if e["before"].get("held_out") is None else {}
        )
        c.setdefault("work", {"simulations": 0, "reused": 0, "effort": 0.0, "effort_unit": "not told"})
        c.setdefault("seconds", 0.0)
        c.setdefault("device", "not told")
        c.setdefault("version", "not told")
    out.setdefault("kind", _kind(parts[0]))
    from neuido.discrepancy.report.wording import words_of

    for c in parts:
        c["words"] = list(words_of(c).paragraphs)
    return out


def _kind(c: Mapping[str, Any]) -> str:
    """Guess the kind of data of an older file by the unit of its errors."""
    return "material test" if c["error"]["unit"] == "Pa" else "track" if "body" in c else "experiment"
