"""Recognise the quantity of a column from its title, in English or another language, and the unit that stands in it."""

import re
import unicodedata
from collections.abc import Sequence

from neuido.data.importers.tables.units import measures
from neuido.errors import UserError


def _axis(words: str, letters: str, number: str, axis: str) -> str:
    """Return the pattern of a quantity along one of two axes: `stress 1`, `stress_x`, `s1`."""
    return rf"({words})[ _.#]*({number}{{1,2}}|{axis}{{1,2}})|({letters})[ _]?{number}"


def _green(number: str, axis: str) -> str:
    """Return the pattern of a Green strain along one of two axes: `Green strain 1`, `Green-Lagrange strain E11`, `green_xx`."""
    return rf".*green.*[ _.#-]e?[ _]?({number}{{1,2}}|{axis}{{1,2}})|e[ _]?({number}{number}|{axis}{axis})[ _-]green.*"


def _place(axis: str) -> str:
    """Return the pattern of a coordinate: `x`, `pos_x`, `X-Position`, `x-Koordinate`."""
    return rf"{axis}|{axis}[ _-]?(pos|coord|koord)\w*|(pos|coord|koord)\w*[ _-]?{axis}"


MEANINGS = {  # quantity: pattern of its title; the first match counts
    "rate": r".*(strain|shear|displacement|speed|loading|dehn\w*)[ _]*(rate|geschwindigkeit).*|.*geschwindigkeit|.*speed.*|.*velocity.*|"
    r"vitesse.*|velocidad.*",
    "relaxation_modulus": r"relaxation modulus|g\(t\)|e\(t\)|relaxationsmodul",
    "compliance": r"(creep )?compliance|j\(t\)|nachgiebigkeit",
    "storage_modulus": r"storage modulus|[ge]'|speichermodul",
    "loss_modulus": r"loss modulus|[ge]''|[ge]\"|verlustmodul",
    "frequency": r"(angular )?frequency|ang\.? frequency|omega|ω|(kreis)?frequenz",
    "viscosity": r".*viscosity.*|viskosit.t|eta",
    "true_stress": r"true stress.*|cauchy.*|wahre spannung|contrainte vraie|(esfuerzo|tensi.n) (verdader|real).*",
    "log_strain": r"le[ _]?(11|xx)|true strain.*|log\w* strain|hencky.*|wahre dehnung|"
    r"d.formation (vraie|logarithmique)|deformaci.n (verdader|real|logar).*",
    "green_strain_1": _green("1", "x"),
    "green_strain_2": _green("2", "y"),
    "green_strain": r".*green.*(strain|lagrange|dehnung).*",
    "second_piola_stress": r"(.* )?(2nd|second|2\.) ?(piola|pk).*|(s_?)?pk ?(2|ii)( stress)?",
    "stretch_1": _axis("stretch|lambda", "λ|l", "1", "x") + "|f[ _]?(11|xx)",
    "stretch_2": _axis("stretch|lambda", "λ|l", "2", "y") + "|f[ _]?(22|yy)",
    "strain_1": _axis("strain|eps|epsilon", "e|ε", "1", "x"),
    "strain_2": _axis("strain|eps|epsilon", "e|ε", "2", "y"),
    "nominal_stress_1": _axis(r"\w* ?stress|sigma", "s|p", "1", "x") + "|p[ _]?(11|xx)",
    "nominal_stress_2": _axis(r"\w* ?stress|sigma", "s|p", "2", "y") + "|p[ _]?(22|yy)",
    "force_1": _axis("force|load|kraft", "f", "1", "x"),
    "force_2": _axis("force|load|kraft", "f", "2", "y"),
    "displacement_1": _axis("extension|displacement|elongation", "u", "1", "x"),
    "displacement_2": _axis("extension|displacement|elongation", "u", "2", "y"),
    "shear_stress": r"shear stress|schubspannung|tau|contrainte de cisaillement|(esfuerzo|tensi.n) (cortante|de corte|tangencial)",
    "shear": r"shear strain|amount of shear|shear|scherung|gleitung|gamma|γ|cisaillement|distorsi.n",
    "nominal_stress": r".*stress.*|.*spannung.*|sigma|σ|.*contrainte.*|.*esfuerzo.*|tensión.*|"
    r"(sforzo|tensione|tensao|spanning|naprezenie)( .*)?|напряжение.*|.*应力|.*応力",
    "stretch": r"(?!.*(force|load|length))stretch.*|streck(ung|grad|verh.ltnis).*|lambda|λ|.longation relative",
    "strain": r"ne[ _]?(11|xx)|[µμ]ε|.*strain.*|.*dehnung.*|epsilon|ε|.*stauchung.*|.*verformung.*|.*déformation.*|deformación.*|"
    r"(deformazione|deformacao|rek|vervorming|tojning|odkszta[łl]cenie)( .*)?|(относительная )?деформация.*|.*应变|.*ひずみ|.*歪み?",
    "force": r"(?!.*(cell|rate|step)).*(force|load|kraft|effort|fuerza|carga|charge).*|f|"
    r"(forza|carico|forca|kracht|belasting|si[łl]a|obciazenie)( .*)?|(нагрузка|усилие|сила).*|.*(载荷|荷载|负荷|荷重)|(试验)?力",
    "displacement": r"(?![xyz][ _-]|(.*\.)?pos\w*[ ._-]?[xyz]$)"
    r".*(extension|displacement|crosshead|stroke|elongation|gap change|travel|traverse|verl.ngerung|distance$|position|deflection|"
    r"compression|deformation).*|.*(standard|pr.f|traversen)?weg|"
    r"allongement|.*d.placement.*|course.*|enfoncement|.crasement|fl.che|desplazamiento.*|alargamiento|carrera|maschinenhub|"
    r"(spostamento|corsa|allungamento|deslocamento|alongamento|verplaatsing|forskjutning|przemieszczenie|wyd[łl]uzenie)( .*)?|"
    r"(перемещение|удлинение).*|.*(位移|变形|伸长|変位)|伸び|ストローク",
    "time": r".*time.*|.*zeit.*|t|temps.*|tiempo.*|tempo|tijd|czas|время|.*时间|.*時間|(elapsed )?(sec|second|sekunde|seconde|segundo)s?n?",
    "frame": r"frames?( ?#)?|frame[ _]?(idx|index|no\.?|nr\.?|number|id)|"
    r"(video )?bild(nummer|nr)?|image( ?(no|nr|number)\.?)?|slice|trame|fotograma|index|idx",
    "recording": r"recording|take|trial|run|experiment|clip|video|sequence|throw|"
    r"aufnahme|durchgang|versuch|wurf|messung|essai|prise|toma|ensayo",
    "id": r"(particle|marker|point|track|object|node|label)?[ _-]?(id|label)|particle|marker|point|track|node|object|bead|"
    r"punkt(nr|nummer)?|partikel|marke|marqueur|particule|marcador|part.cula",
    "angle": r"(.* )?angle|theta|θ|phi|φ|.*winkel|rotation|.*[ _]angle|.ngulo",
    "x": _place("x") + r"|abscisse|abscisa",
    "y": _place("y") + r"|h|height\w*|h.he|hauteur|altura|ordonn.e|ordenada",
    "z": _place("z"),
}
_UNITS = r"%|percent|m?N|k?N|kgf|lbf|[kMG]?Pa|N/mm\^?[2²]|psi|ksi|mm/mm|m/m|[mcµu]?m|[mnµu]?s|sec|min|pixels?|px|deg|rad|°|мм|с|к?Н|[кМ]?Па"
UNIT_IN_TITLE = re.compile(rf"[(\[<]([^()\[\]<>]*)[)\]>]\s*$|(?:[\s_]in\s|\s*[/,;:]\s*|[\s_])({_UNITS})$")
"""The unit at the end of a title: in brackets, or after `in`, a slash, a comma or a blank."""
POINT = re.compile(r"(?P<name>.*?\w)[ _.:/-]*(?P<axis>[xyz])|(?P<first>[xyz])[ _.:-]*(?P<rest>\w.*)")
"""Title of a coordinate of a named point: `ball_x`, `nose.y`, `Marker 3 Z`, `Marker 1/0/X`, `x1`, `X_ball`."""
_NO_POINT = re.compile(
    r"f|m|v|a|q|w|u|n|velocity|speed|vel|acc\w*|acceleration|omega|force|moment|torque|rot\w*|angle|kraft|geschwindigkeit|"
    r"beschleunigung|e|ma|inde|fle|std|sd|err\w*|sigma|area|"
    r"(.*[ _])?(rotation|velocity|speed|force)"
)
"""What stands before an axis and is no point, or before the last letter of another word."""
_SIBLINGS = {"strain": "displacement", "displacement": "strain", "nominal_stress": "force", "force": "nominal_stress", "stretch": "force"}
"""Quantities that share words, as an elongation in mm or in percent, and are told apart by the unit."""
_EXPECTED = {"strain": "", "displacement": "m", "nominal_stress": "Pa", "force": "N", "stretch": ""}
_LOADS = {"nominal_stress", "nominal_stress_1", "true_stress", "second_piola_stress", "force", "force_1", "shear_stress"}
SPECIMEN = re.compile(r"(specimen|sample|probe|test|versuch)[ _]?(id|no\.?|nr\.?|number|name|label|index|nummer)?")
"""Title of a column that says which specimen a row belongs to."""


def bare_title(title: str) -> str:
    """Return a title in small letters without its unit, and without what stands in brackets."""
    bare = re.sub(r"\s*[\[<][^\[\]<>]*[\]>]|\s+\([^()]*\)|(?<=\w{2})\([^()]*\)", "", title)
    found = UNIT_IN_TITLE.search(bare)
    if found and found.start() > 0:
        bare = bare[: found.start()]
    return bare.strip(" \t:;,").lower()


def find_columns(titles: Sequence[str], given: dict[str, str] | None = None, units: Sequence[str] | None = None) -> dict[str, int]:
    """Find the column of each quantity; return the column indices by quantity.

    Args:
        titles: Titles of the columns.
        given: Title of the column of a quantity; it takes precedence over recognition.
        units: Unit of each column, where known; an elongation in percent is a strain, and a strain in mm a displacement.

    Raises:
        UserError: A quantity of `given` is unknown, or no column has its title.
    """
    found: dict[str, int] = {}
    for quantity, title in (given or {}).items():
        if quantity not in MEANINGS:
            raise UserError(f"--columns has the unknown quantity {quantity!r}: choose from {', '.join(MEANINGS)}")
        if title not in titles:
            raise UserError(f"--columns.{quantity}: no column has the title {title!r}; the titles are {', '.join(filter(None, titles))}")
        found[quantity] = list(titles).index(title)
    for i, title in enumerate(titles):
        bare = bare_title(title)
        if i in found.values() or not bare:
            continue
        plain = "".join(letter for letter in unicodedata.normalize("NFD", bare) if not unicodedata.combining(letter))
        quantity = next((name for name, pattern in MEANINGS.items() if re.fullmatch(pattern, bare) or re.fullmatch(pattern, plain)), None)
        if quantity is None:
            continue
        unit, base = units[i] if units is not None else "", re.sub(r"_[12]$", "", quantity)
        if unit and base in _SIBLINGS and not measures(unit, _EXPECTED[base]) and measures(unit, _EXPECTED[_SIBLINGS[base]]):
            quantity = _SIBLINGS[base] + quantity[len(base) :]
        if quantity == "id" and bare.startswith("track") and "id" not in (given or {}):
            found["id"] = i  # beside it stands a number of each row, not of each point
        found.setdefault(quantity, i)
    return found | _by_company(titles, units, found)


def _by_company(titles: Sequence[str], units: Sequence[str] | None, found: dict[str, int]) -> dict[str, int]:
    """Return the stress whose letter tells it only beside another column: `P` at a stretch, `S11` at a logarithmic strain `LE11`."""
    if found.keys() & _LOADS:
        return {}
    bare = {bare_title(title): i for i, title in enumerate(titles) if i not in found.values()}
    if "p" in bare and found.keys() & {"stretch", "stretch_1"}:
        force = units is not None and units[bare["p"]] and measures(units[bare["p"]], "N")
        return {"force" if force else "nominal_stress": bare["p"]}
    if "s11" in bare and "log_strain" in found:
        return {"true_stress": bare["s11"]}
    return {}


def named_points(titles: Sequence[str]) -> dict[str, dict[str, int]]:
    """Find the columns of points whose titles join a name and an axis; return the column of each axis by point.

    Titles that name another quantity are none, and a point has x and y at least.
    """
    taken, points = set(find_columns(titles).values()), dict[str, dict[str, int]]()
    for i, title in enumerate(titles):
        found = POINT.fullmatch(bare_title(title)) if i not in taken else None
        if found is None:
            continue
        name, axis = (found["name"], found["axis"]) if found["axis"] else (found["rest"], found["first"])
        name = re.sub(r"[ _.:-]*(pos\w*|coord\w*)$", "", name) or name
        if not _NO_POINT.fullmatch(name):
            points.setdefault(name, {}).setdefault(axis, i)
    return {name: axes for name, axes in points.items() if {"x", "y"} <= set(axes)}
