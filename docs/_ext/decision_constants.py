"""The page of the constants that a diagnosis decides by, read from the sources, with the distribution behind each."""

import ast
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[2] / "neuido" / "discrepancy" / "inference"

LEVEL, DERIVED, ROUNDING, NULLS, CASES, ONE, CHOSEN = "level", "derived", "rounding", "nulls", "cases", "one seed", "judgement"
BEHIND = {
    LEVEL: "a level or a quantile that is stated: no measurement is behind it, and none is needed",
    DERIVED: "follows from another figure of this page",
    ROUNDING: "allows for rounding: any small value gives the same answers",
    NULLS: "gains of blind nulls",
    CASES: "blind cases of several seeds, named or not",
    ONE: "cases of one blind seed, or a single case",
    CHOSEN: "chosen by hand, without a distribution",
}
STATED = (LEVEL, DERIVED, ROUNDING)
"""Kinds that are not set by hand."""
DECIDES = {  # of the present decision: module -> constant -> what is behind it
    "judging": {
        "ALPHA": LEVEL, "LED_AWAY": CASES, "CLASS_RATIO": CHOSEN, "CLASS_RATIO_ABOVE": CASES, "CLASS_RATIO_EXACT": CHOSEN,
        "LEAST_GAIN_EXACT": DERIVED, "RIVAL": CASES, "WITHIN": CHOSEN, "ABOVE": DERIVED, "CLEAR": CASES, "GAIN_IN_FLOOR": NULLS,
        "GAIN_AT_FLOOR": NULLS, "GAIN_TO_NOISE": DERIVED, "EXACT": CHOSEN, "BROUGHT_BACK": CASES, "BACK_GAIN": DERIVED, "FEW": ONE,
        "FORETELLS": DERIVED, "SEEN": CHOSEN, "IMPLAUSIBLE": CHOSEN, "STANDS_OUT": CHOSEN, "LIKE_A_GRID": DERIVED,
    },
    "comparing": {"LEAST_GAIN": ONE},
    "discretisation": {"UNSEEN": CHOSEN},
    "bootstrap": {"NOISE_ALONE": CHOSEN},
    "floors": {"BOUND": CHOSEN, "REACH": CHOSEN, "PARSIMONY": CHOSEN},
    "next_effect": {"UNEXPLAINED_EXACT": CHOSEN, "UNSURE": LEVEL},
    "choosing": {"HANDICAP": CHOSEN, "UNASKED": DERIVED},
    "intervals": {"TOLD": LEVEL, "AT_BOUND": ROUNDING},
    "attribution": {"MOST": CHOSEN},
    "decision": {"ENOUGH": CHOSEN},
}  # fmt: skip
UNNAMED = [  # what follows from those figures in the code of the present decision: module, function, value, what it does
    (
        "choosing",
        "first_rounds",
        "2 LEAST_GAIN",
        "what an effect must leave less, by a method whose declared model is not the best one: LEAST_GAIN, of squares",
    ),
    ("pairs", "look_ahead", "2 LEAST_GAIN", "what two effects must gain of which none gains enough alone: LEAST_GAIN for each"),
]
SHADOW = {  # of the decision by evidence, which is reported beside it: see `neuido.discrepancy.inference.evidence`
    "evidence": {"KINDS": LEVEL, "WIDE": CHOSEN, "LEAST": CHOSEN},
    "calibration": {"ALPHA": LEVEL},
}
SEARCHES = {  # constants of the same files that steer the search, or only what is computed
    "stand_ins": {
        "NEAR_IT",
        "ALIKE",
        "HALF",
        "PROMISING",
        "INSTEAD",
        "INSTEAD_ONE_BY_ONE",
        "SCANNED",
        "FROM_THERE",
        "NO_MORE",
        "STEP",
        "STEPS",
    },
    "comparing": {"NEARLY"},
    "discretisation": {"ROUGH", "ALIKE"},
    "floors": {"LED"},
    "next_effect": {"CONFIRMED", "PLAIN", "AS_WELL", "MEMBERS"},
    "choosing": {"CLEARLY", "LOOKS", "AS_SURE"},
    "intervals": {"QUANTILE", "NORMAL", "ROOM", "NEARBY", "FREE_AT", "HALF_TURN", "FIRST_STEP", "TRIES", "PROFILED", "AT_LEAST", "CLOSE"},
    "likelihood": {"SCALES"},
    "calibration": {"TABLE"},
}  # fmt: skip


def file_of(module: str) -> Path:
    """Return the file of a module, in whichever of the rooms of inference it is."""
    return next(PACKAGE.rglob(f"{module}.py"))


def constants(module: str) -> dict[str, tuple[str, str]]:
    """Return the value and the docstring of each constant of a module."""
    out, body = {}, ast.parse(file_of(module).read_text()).body
    for node, after in zip(reversed(body), [None, *reversed(body)][: len(body)], strict=True):
        if not isinstance(node, ast.Assign):
            continue
        told = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
        said = " ".join(str(after.value.value).split()) if told else ""
        (target,) = node.targets
        names = [n.id for n in ast.walk(target) if isinstance(n, ast.Name) and n.id.isupper()]
        several = isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple)
        values = node.value.elts if several else [node.value] * len(names)
        out |= {name: (ast.unparse(value), said) for name, value in zip(names, values, strict=True)}
    return out


def counts() -> tuple[int, int]:
    """Return how many figures are set by hand in the present decision, and in the one by evidence; see `STATED`."""
    present = sum(kind not in STATED for own in DECIDES.values() for kind in own.values())
    return present, sum(kind not in STATED for own in SHADOW.values() for kind in own.values())


def constant_page() -> str:
    """Return the page."""
    present, shadow = counts()
    lines = [
        "# Constants of the decision",
        "",
        f"What a diagnosis answers, given its fits, depends on **{present} figures that are set by hand**, beside the levels that are",
        "stated and what follows from these figures. The decision by evidence, which is computed beside it and names",
        f"nothing yet, has **{shadow}**.",
        "How the rules work together is under [how a diagnosis decides](../explanation/diagnosis.md).",
        "",
        "What is behind a figure:",
        "",
        *(f"* *{kind}*: {text}." for kind, text in BEHIND.items()),
    ]
    for title, chosen in (("Present decision", DECIDES), ("Decision by evidence (experimental)", SHADOW)):
        lines += ["", f"## {title}", "", "| constant | value | behind it | what it does |", "| --- | --- | --- | --- |"]
        for module, own in chosen.items():
            known = constants(module)
            for name, kind in own.items():
                value, said = known[name]
                lines.append(f"| `{module}.{name}` | `{value}` | {kind} | {said.replace('|', chr(92) + '|')} |")
        if chosen is DECIDES:
            lines += [f"| in `{module}.{function}` | {value} | {DERIVED} | {text} |" for module, function, value, text in UNNAMED]
    return "\n".join(lines) + "\n"
