"""Recognise the quantity of a column from its title, in English or German."""

import re

from neuido.errors import UserError

MEANINGS = {  # quantity: pattern of its title; the first match counts
    "true_stress": r"true stress|cauchy|wahre spannung",
    "log_strain": r"true strain|log\w* strain|hencky|wahre dehnung",
    "stretch_1": r"(stretch|lambda|λ|l)[ _]?1",
    "stretch_2": r"(stretch|lambda|λ|l)[ _]?2",
    "nominal_stress_1": r"(\w* ?stress|s|sigma|p)[ _]?1",
    "nominal_stress_2": r"(\w* ?stress|s|sigma|p)[ _]?2",
    "shear_stress": r"shear stress|schubspannung",
    "shear": r"shear strain|amount of shear|shear|scherung|gleitung",
    "nominal_stress": r".*stress.*|.*spannung.*|sigma",
    "stretch": r"stretch.*|streck.*|lambda|λ",
    "strain": r".*strain.*|.*dehnung.*|epsilon|stauchung.*",
    "force": r".*force.*|.*load.*|.*kraft.*|f",
    "displacement": r".*(extension|displacement|crosshead|stroke|elongation|gap change|weg|traverse|verl.ngerung|position).*",
    "time": r".*time.*|.*zeit.*|t",
    "frame": r"frame#?|frames?|bild(nummer)?",
    "id": r"id|particle|marker|point|punkt",
    "x": r"x|x[ _]?pos\w*|pos\w*[ _]?x",
    "y": r"y|y[ _]?pos\w*|pos\w*[ _]?y|height\w*|h.he",
    "z": r"z|z[ _]?pos\w*|pos\w*[ _]?z",
}


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
        bare = re.sub(r"\s*[\(\[].*?[\)\]]|[_ ](in )?(%|k?N|[kMG]?Pa|m?m|m?s)$", "", title).strip().lower()
        if i in found.values() or not bare:
            continue
        for quantity, pattern in MEANINGS.items():
            if quantity not in found and re.fullmatch(pattern, bare):
                found[quantity] = i
                break
    return found
