"""Recognise the quantity of a column from its title, in English or German, and the unit that stands in it."""

import re

from neuido.errors import UserError


def _axis(words: str, letters: str, number: str, axis: str) -> str:
    """Return the pattern of a quantity along one of two axes: `stress 1`, `stress_x`, `s1`."""
    return rf"({words})[ _.#]*({number}|{axis})|({letters})[ _]?{number}"


MEANINGS = {  # quantity: pattern of its title; the first match counts
    "rate": r".*(strain|shear|displacement|speed|loading|dehn\w*)[ _]*(rate|geschwindigkeit).*|.*geschwindigkeit|.*speed.*|.*velocity.*",
    "relaxation_modulus": r"relaxation modulus|g\(t\)|e\(t\)|relaxationsmodul",
    "compliance": r"(creep )?compliance|j\(t\)|nachgiebigkeit",
    "storage_modulus": r"storage modulus|[ge]'|speichermodul",
    "loss_modulus": r"loss modulus|[ge]''|[ge]\"|verlustmodul",
    "frequency": r"(angular )?frequency|ang\.? frequency|omega|ω|(kreis)?frequenz",
    "viscosity": r".*viscosity.*|viskosit.t|eta",
    "true_stress": r"true stress.*|cauchy.*|wahre spannung",
    "log_strain": r"true strain.*|log\w* strain|hencky.*|wahre dehnung",
    "stretch_1": _axis("stretch|lambda", "λ|l", "1", "x"),
    "stretch_2": _axis("stretch|lambda", "λ|l", "2", "y"),
    "strain_1": _axis("strain|eps|epsilon", "e|ε", "1", "x"),
    "strain_2": _axis("strain|eps|epsilon", "e|ε", "2", "y"),
    "nominal_stress_1": _axis(r"\w* ?stress|sigma", "s|p", "1", "x"),
    "nominal_stress_2": _axis(r"\w* ?stress|sigma", "s|p", "2", "y"),
    "force_1": _axis("force|load|kraft", "f", "1", "x"),
    "force_2": _axis("force|load|kraft", "f", "2", "y"),
    "displacement_1": _axis("extension|displacement|elongation", "u", "1", "x"),
    "displacement_2": _axis("extension|displacement|elongation", "u", "2", "y"),
    "shear_stress": r"shear stress|schubspannung|tau",
    "shear": r"shear strain|amount of shear|shear|scherung|gleitung|gamma|γ",
    "nominal_stress": r".*stress.*|.*spannung.*|sigma|σ",
    "stretch": r"(?!.*(force|load|length))stretch.*|streck(ung|grad|verh.ltnis).*|lambda|λ",
    "strain": r".*strain.*|.*dehnung.*|epsilon|ε|.*stauchung.*",
    "force": r"(?!.*(cell|rate|step)).*(force|load|kraft).*|f",
    "displacement": r".*(extension|displacement|crosshead|stroke|elongation|gap change|travel|traverse|verl.ngerung|position|deflection|"
    r"compression|deformation).*|.*(standard|pr.f|traversen)?weg",
    "time": r".*time.*|.*zeit.*|t",
    "frame": r"frame#?|frames?|bild(nummer)?",
    "id": r"id|particle|marker|point|punkt",
    "angle": r"(.* )?angle|theta|θ|phi|φ|winkel|rotation",
    "x": r"x|x[ _]?pos\w*|pos\w*[ _]?x",
    "y": r"y|y[ _]?pos\w*|pos\w*[ _]?y|height\w*|h.he",
    "z": r"z|z[ _]?pos\w*|pos\w*[ _]?z",
}
_UNITS = r"%|percent|m?N|k?N|kgf|lbf|[kMG]?Pa|N/mm\^?[2²]|psi|ksi|mm/mm|m/m|[mcµu]?m|ms|s|sec|min|pixels?|px"
UNIT_IN_TITLE = re.compile(rf"[(\[<]([^()\[\]<>]*)[)\]>]\s*$|(?:[\s_]in\s|\s*[/,;:]\s*|[\s_])({_UNITS})$")
"""The unit at the end of a title: in brackets, or after `in`, a slash, a comma or a blank."""
SPECIMEN = re.compile(r"(specimen|sample|probe|test|versuch)[ _]?(id|no\.?|nr\.?|number|name|label|index|nummer)?")
"""Title of a column that says which specimen a row belongs to."""


def bare_title(title: str) -> str:
    """Return a title in small letters without its unit, and without what stands in brackets."""
    bare = re.sub(r"\s*[\[<][^\[\]<>]*[\]>]|\s+\([^()]*\)|(?<=\w{2})\([^()]*\)", "", title)
    found = UNIT_IN_TITLE.search(bare)
    if found and found.start() > 0:
        bare = bare[: found.start()]
    return bare.strip(" \t:;,").lower()


def find_columns(titles: list[str], given: dict[str, str] | None = None) -> dict[str, int]:
    """Find the column of each quantity; return the column indices by quantity.

    Args:
        titles: Titles of the columns.
        given: Title of the column of a quantity; it takes precedence over recognition.

    Raises:
        UserError: A quantity of `given` is unknown, or no column has its title.
    """
    found: dict[str, int] = {}
    for quantity, title in (given or {}).items():
        if quantity not in MEANINGS:
            raise UserError(f"--columns has the unknown quantity {quantity!r}: choose from {', '.join(MEANINGS)}")
        if title not in titles:
            raise UserError(f"--columns.{quantity}: no column has the title {title!r}; the titles are {', '.join(filter(None, titles))}")
        found[quantity] = titles.index(title)
    for i, title in enumerate(titles):
        bare = bare_title(title)
        if i in found.values() or not bare:
            continue
        for quantity, pattern in MEANINGS.items():
            if re.fullmatch(pattern, bare):
                found.setdefault(quantity, i)
                break
    return found
