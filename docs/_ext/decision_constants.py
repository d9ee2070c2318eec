"""The page of the constants that a diagnosis decides by, read from the sources, with the distribution behind each."""

import ast
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[2] / "neuido" / "discrepancy" / "inference"

LEVEL, NULLS, CASES, ONE, CHOSEN = "level", "nulls", "cases", "one seed", "judgement"
BEHIND = {
    LEVEL: "a level or a quantile that is stated: no measurement is behind it, and none is needed",
    NULLS: "gains of blind nulls",
    CASES: "blind cases of several seeds, named or not",
    ONE: "cases of one blind seed, or a single case",
    CHOSEN: "chosen by hand, without a distribution",
}
DECIDES = {  # of the present decision: module -> constant -> what is behind it
    "judging": {
        "ALPHA": LEVEL, "LED_AWAY": CASES, "CLASS_RATIO": CHOSEN, "CLASS_RATIO_ABOVE": CHOSEN, "CLASS_RATIO_EXACT": CHOSEN,
        "LEAST_GAIN_EXACT": CHOSEN, "GAIN_AT_FLOOR": NULLS, "GAIN_IN_FLOOR": NULLS, "EXACT": CHOSEN, "BROUGHT_BACK": CASES,
        "BACK_GAIN": CASES,
        "GAIN_TO_NOISE": NULLS, "FIT_GAIN": ONE, "FIT_LEAD": ONE, "FEW": ONE, "FORETELLS": ONE, "SEEN": CHOSEN, "IMPLAUSIBLE": CHOSEN,
        "STANDS_OUT": CHOSEN, "WITHIN": CHOSEN, "LIKE_A_GRID": CASES,
    },
    "comparing": {"LEAST_GAIN": ONE},
    "discretisation": {"UNSEEN": CHOSEN},
    "bootstrap": {"NOISE_ALONE": CHOSEN},
    "floors": {"BOUND": CHOSEN, "REACH": CHOSEN, "PARSIMONY": CHOSEN},
    "next_effect": {"UNEXPLAINED": CHOSEN, "UNEXPLAINED_EXACT": CHOSEN},
    "choosing": {"UNASKED": ONE},
    "intervals": {"TOLD": LEVEL, "AT_BOUND": CHOSEN},
    "attribution": {"MOST": CHOSEN},
}  # fmt: skip
UNNAMED = [  # figures of the present decision that stand in its code: module, function, value, what it does
    ("judging", "gain_over_floor", "log(1.5)", "how far above its floor a residual is where the least gain is enough"),
    ("judging", "as_good", "3 and -0.1", "further parameters with which a rival must be better, and by how much in its score"),
    ("judging", "is_rival", "0.4", "share of the best gain that a member of a class needs"),
    ("choosing", "first_rounds", "log(1.2)", "what another method must do better by, to take the place of the suggested one"),
    ("choosing", "first_rounds", "2 LEAST_GAIN", "the same for an effect by a method whose declared model is not the best one"),
    ("attribution", "drop", "LEAST_GAIN / 2", "what an effect must foretell beside the others, to be kept"),
    ("pairs", "look_ahead", "2 LEAST_GAIN", "what two effects must gain of which none gains enough alone"),
    ("next_effect", "unexplained", "2", "deviations of an estimated noise that widen the limit of what is unknown"),
    ("decision", "enough", "3 and 10", "data for each free figure, and beside them"),
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
    "choosing": {"CLEARLY", "LOOKS", "AS_SURE", "EARLY"},
    "intervals": {"QUANTILE", "NORMAL", "ROOM", "NEARBY", "FREE_AT"},
    "attribution": {"FURTHER"},
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
    """Return how many figures are set by hand in the present decision, and in the one by evidence; levels are stated, not set."""
    present = sum(kind != LEVEL for own in DECIDES.values() for kind in own.values()) + len(UNNAMED)
    return present, sum(kind != LEVEL for own in SHADOW.values() for kind in own.values())


def constant_page() -> str:
    """Return the page."""
    present, shadow = counts()
    lines = [
        "# Constants of the decision",
        "",
        f"What a diagnosis answers, given its fits, depends on **{present} figures that are set by hand**, beside the levels that are",
        f"stated. The goal is five. The decision by evidence, which is computed beside it and names nothing yet, has **{shadow}**.",
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
            lines += [f"| in `{module}.{function}` | {value} | {CHOSEN} | {text} |" for module, function, value, text in UNNAMED]
    return "\n".join(lines) + "\n"
