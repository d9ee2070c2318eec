"""The answer of a diagnosis in plain words, for the terminal and the top of the page."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from neuido.discrepancy.report.reader_units import Units, rounded

LEADING = ("yield_stress", "damping_ratio", "coefficient", "ratio")
"""Derived quantities that replace the fitted parameters of an effect in words."""
MORE = 3.0
"""Ratio of the residual with the named effects to its floor, above which something more is missing."""
MORE_LEFT = ", and something more that no effect here explains"
"""End of the first sentence where something more is missing."""
STANDS_ABOVE = 1.5
"""Ratio of residual to noise above which the answer `none` states the ratio."""
MOST_SAID = 4
"""Largest number of values or effects in a sentence. A table lists all."""
TELLING = 1.05
"""Least ratio of a rival's error to that of the named effect at which a sentence compares them."""
NUMBERS = ("no", "one", "two", "three")
Content = Mapping[str, Any]


class Words(NamedTuple):
    """Paragraphs of an answer, each empty where there is nothing to say."""

    finding: str
    """What is missing, and how large it is."""
    error: str
    """The error before and after, beside the noise."""
    sure: str
    """How sure the answer is, and against which rivals."""
    not_excluded: str
    """Which other effects could still be there, and how large."""
    next: str
    """What to measure next."""
    notes: str
    """What was left out, and what makes a motion doubtful."""

    @property
    def paragraphs(self) -> tuple[str, ...]:
        """Paragraphs that are not empty."""
        return tuple(part for part in self if part)


def words_of(c: Content, units: Units | None = None) -> Words:
    """Return the words for one part of diagnosis.json."""
    units = units or Units.of([c])
    return Words(_finding(c, units), _error(c, units), _sure(c), _not_excluded(c, units), _next(c), _notes(c))


def _notes(c: Content) -> str:
    """Return sentences on skipped steps, on doubtful motions, and on what the data cannot tell."""
    out = []
    if c["left_out"]:
        out.append(f"The search ended before {listed([worded(step) for step in c['left_out']])}: the same command with {more(c)} goes on.")
    out += [f"The prediction of {name} is doubtful, {'; '.join(events)}." for name, events in c.get("doubts", {}).items()]
    if "unseen" in c:
        out.append(c["unseen"])
    return " ".join(out)


def more(c: Mapping[str, Any]) -> str:
    """Return what a search that was cut off needs to continue: more effort or more minutes."""
    return "more effort" if c.get("work", {}).get("ended_by") == "effort" else "more minutes"


def titles() -> dict[str, str]:
    """Return the titles of the effects of the library, by name."""
    from neuido.physics.effects.library import LIBRARY

    return {entry.name: entry.title for entry in LIBRARY}


def title(name: str) -> str:
    """Return the title of an effect; for one outside the library its name with spaces."""
    return titles().get(name, name.replace("_", " "))


def named(name: str) -> str:
    """Return the title of an effect with its identifier for options and files: "linear air drag (drag_linear)"."""
    return f"{title(name)} ({name})"


FIGURES = {
    "young": "Young's modulus",
    "poisson": "Poisson's ratio",
    "density": "density",
    "yield_stress": "yield stress",
    "friction_angle": "friction angle",
    "gravity": "gravity",
    "stiffness": "factor on the law's stress",
}
"""Names of the declared values in words."""


ORDINALS = ("first", "second", "third", "fourth", "fifth")
_DIRECTIONS = {  # effect: what its parameters x, y and z are
    "uniform_acceleration": "acceleration along {}",
    "magnus": "rate about {}",
    "position_force": "place along {}",
    "local_force": "place along {}",
    "stiffness_gradient": "slope of log stiffness along {}",
}
_WORDS = {
    "gravity.g": "acceleration",
    "drag_linear.k": "drag coefficient",
    "drag_quadratic.k": "drag coefficient",
    "position_force.k": "stiffness over mass",
    "time_force.interval": "time between two knots",
    "viscosity_shear.eta": "shear viscosity",
    "viscosity_bulk.zeta": "bulk viscosity",
    "maxwell.ratio": "stiffness that relaxes, over that of the law",
    "maxwell.time": "relaxation time",
    "hysteresis.eta": "loss factor",
    "strain_stiffening.k": "stiffening coefficient",
    "second_invariant.c": "coefficient",
    "tension_compression.r": "stiffness added in compression, over the shear modulus",
    "fibre.c": "fibre stiffness",
    "fibre.azimuth": "azimuth of the fibre",
    "fibre.elevation": "elevation of the fibre",
    "yield.inverse": "one over the yield stress",
    "hardening.h": "hardening modulus",
    "softening.s": "softening coefficient",
    "kinematic_hardening.h": "hardening modulus",
    "rate_yield.eta": "viscosity",
    "stiffness_gradient.log_ratio": "log of the stiffness in a ball over that outside",
    "stiffness_gradient.radius": "radius of the ball",
    "stiffness_gradient.cx": "centre of the ball along x",
    "stiffness_gradient.cy": "centre of the ball along y",
    "stiffness_gradient.cz": "centre of the ball along z",
    "stiffness_gradient.width": "width of the ball's edge",
    "stiffness_change.rate": "rate of change",
    "friction.mu": "friction coefficient beside the declared one",
    "stick.rate": "rate of sticking",
    "restitution.rate": "rate of damping",
    "cohesion.c": "cohesion",
    "added_mass.c": "added share of the mass",
    "swelling.rate": "rate of growth",
    "spin_decay.k": "rate of decay",
    "relaxation_spectrum.first": "shortest relaxation time",
    "relaxation_spectrum.last": "longest relaxation time",
    "fractional.ratio": "stiffness that relaxes, over that of the law",
    "fractional.exponent": "exponent",
    "fractional.time": "time in the middle of the decay",
    "mullins.share": "share of the stress that is lost",
    "mullins.width": "width of the softening",
    "permanent_set.share": "share of the strain that stays",
    "compaction.k": "coefficient",
    "compaction.lock": "strain at which it locks",
    "creep.rate": "creep rate",
    "creep.exponent": "exponent",
    "creep.stress": "reference stress",
    "cyclic_hardening.q": "change of the yield stress",
    "cyclic_hardening.b": "rate of saturation",
    "rate_power.k": "consistency",
    "rate_power.n": "exponent",
    "power_law.n": "exponent",
    "power_law.reference": "reference rate",
    "carreau.n": "exponent",
    "carreau.time": "time constant",
    "bingham.yield": "yield stress",
    "herschel_bulkley.yield": "yield stress",
    "herschel_bulkley.n": "exponent",
    "herschel_bulkley.reference": "reference rate",
    "dry_friction.c": "deceleration",
    "local_force.a0": "largest acceleration",
    "local_force.w": "reach",
    "lift.k": "lift coefficient",
    "lift.d": "drag coefficient",
    "buoyancy.q": "density of the fluid over that of the body",
    "bounce_friction.mu": "friction coefficient",
    "bounce_speed.p": "exponent of the speed",
    "thixotropy.c": "largest rise of the viscosity",
    "thixotropy.breakdown": "time of breakdown",
    "thixotropy.build": "rate of build-up",
}


def parameter_words(effect: str, parameter: str) -> str:
    """Return a parameter of an effect in words; one of an effect outside the library is its name with spaces."""
    if found := _WORDS.get(f"{effect}.{parameter}"):
        return found
    name, number = (parameter[:-1], parameter[-1]) if parameter[-1:].isdigit() else (parameter, "")
    if effect in _DIRECTIONS and name in ("x", "y", "z") and not number:
        return _DIRECTIONS[effect].format(name)
    if effect == "time_force" and number:
        return f"acceleration along {name} at the {ORDINALS[int(number)]} knot"
    if effect == "relaxation_spectrum" and number:
        return f"share of the {ORDINALS[int(number) - 1]} relaxation time"
    if effect == "nonlinear_backstress" and number:
        return f"{'modulus' if name == 'h' else 'rate of saturation'} of the {ORDINALS[int(number) - 1]} backstress"
    return parameter.replace("_", " ")


def worded(text: str) -> str:
    """Replace the identifiers of effects in a text by their titles."""
    import re

    words = titles()
    return re.sub(
        r"(?<![\w.])[a-z]+(?:_[a-z]+)*(?![\w.]*\.\w)(?!\w)",
        lambda found: words.get(found[0], found[0]) if "_" in found[0] else found[0],
        text,
    )


def listed(parts: Sequence[str], last: str = "and") -> str:
    """Join parts to a list in words: "a, b and c"."""
    parts = list(parts)
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} {last} {parts[-1]}" if parts else ""


def leading(parameters: Mapping[str, Any]) -> list[str]:
    """Return the names of the parameters that give the size of an effect: mostly one, and all components of a vector."""
    derived = [key for key in LEADING if key in parameters]
    if derived:
        return derived[:1]
    keys = [key for key, p in parameters.items() if not isinstance(p["value"], list)]
    first = parameters[keys[0]]["unit"] if keys else ""
    return [key for key in keys if parameters[key]["unit"] == first][:MOST_SAID]


def size_of(parameters: Mapping[str, Any], units: Units) -> str:
    """Return the leading parameters of an effect with their 90 % intervals: "k = 3.00 per second (90 %: 2.98–3.02)"."""
    from neuido.discrepancy.report.reader_units import SPOKEN

    out = []
    for key in leading(parameters):
        p = parameters[key]
        value, interval = units.figures(p["value"], p.get("interval90", (None, None)), p["unit"])
        unit = SPOKEN.get(p["unit"], units.label(p["unit"]))
        told = f" (90 %: {interval})" if interval and "interval90" in p else ""
        out.append(f"{key.replace('_', ' ')} = {value}{f' {unit}' if unit else ''}{told}")
    return ", ".join(out)


def _class_of(e: Content) -> str:
    """Return the title of an effect, or the titles of all effects of its class."""
    return listed([title(name) for name in e["class"]], "or")


def _finding(c: Content, units: Units) -> str:
    answer, effects = c["answer"], c["effects"]
    why = "; ".join(c["why"])
    out = [f"{why[0].upper()}{why[1:]}."] if why else []
    if answer in ("effect", "class"):
        over = most_over(c["error"])
        more = over > MORE
        out.append(_missing(effects, units, more=MORE_LEFT if more else ""))
        if more:
            out.append(f"What is left is {over:.0f} times what noise and discretisation leave.")
        out += [f"A limit and no size, since a later fit moved it: {e['at_limit']}." for e in effects if e.get("at_limit")]
        out += [_ordinary(row, units) for row in c["power"] if _denied(row, effects)]
    elif answer == "none":
        out.append("Nothing is missing that these data could show.")
        out += [_ordinary(row, units) for row in c["power"] if row.get("ordinary")]
        over = c["error"].get("left_over_noise")
        if over is not None and over > STANDS_ABOVE:
            out.append(f"What remains stands at {over:.1f} times the noise, so an effect that does less would not be seen.")
    elif answer == "unknown":
        out.append("Something is missing that none of the known effects explains.")
    elif answer == "insufficient":
        out.append("These data do not say whether something is missing.")
    else:
        out.append("The search was cut off before every effect was tried: nothing is named yet.")
        for lead in c["leads"]:
            ratio = f", which divides the error by {rounded(lead['error_ratio'])}" if lead.get("error_ratio") else ""
            size = size_of(lead["parameters"], units)
            out.append(f"In the lead so far, and no answer: {title(lead['name'])}{f' ({size})' if size else ''}{ratio}.")
        if c["untried"]:
            out.append(f"Not tried: {listed([title(name) for name in c['untried']])}.")
    return " ".join(out)


def _denied(row: Content, effects: Sequence[Content]) -> bool:
    """Return whether the data, with what was named, leave such a body less of an effect than it has; a named drag is a drag of any law."""
    if not row.get("ordinary") or row["up_to"] is None or row["up_to"] >= row["ordinary"]:
        return False
    kind = row["name"].partition("_")[0]
    return all(name.partition("_")[0] != kind for e in effects for name in e["class"])


def _ordinary(row: Content, units: Units) -> str:
    """Return a sentence on an effect that such a body has, whether the data exclude its size or not."""
    size = units.said(row["ordinary"], row["unit"])
    has = f"A smooth sphere of this mass and size has a {title(row['name'])} of about {size}"
    if row["up_to"] is None:
        return f"{has}, and these data set no limit to it."
    limit = units.said(row["up_to"], row["unit"])
    if row["up_to"] >= row["ordinary"]:
        return f"{has}, which these data cannot tell from none: up to {limit} agrees with them."
    return f"{has}, and these data exclude more than {limit}: check the length scale, the clock and gravity."


def most_over(error: Content) -> float:
    """Return how many times its floor the error is that is left: of the whole, or of the worst recording where that is known."""
    return max(error.get(key) or 0.0 for key in ("left_over_floor", "worst_over_floor"))


def _missing(effects: Sequence[Content], units: Units, *, more: str = "") -> str:
    """Return a sentence on the missing effects, which ends with `more`, and a second one where the data cannot tell effects apart."""
    if len(effects) == 1:
        (e,) = effects
        size = size_of(e["parameters"], units)
        if len(e["class"]) == 1:
            return f"The model lacks {title(e['name'])}{f': {size}' if size else ''}{more}."
        as_first = f" As {title(e['name'])}: {size}." if size else ""
        return f"The model lacks {_class_of(e)}{more}; these data cannot tell them apart.{as_first}"
    said = [f"{_class_of(e)}{f', {size}' if (size := size_of(e['parameters'], units)) else ''}" for e in effects]
    apart = " The data cannot tell apart what is joined by “or”." if any(len(e["class"]) > 1 for e in effects) else ""
    count = NUMBERS[len(effects)] if len(effects) < len(NUMBERS) else len(effects)
    return f"The model lacks {count} effects: {'; and '.join(said)}{more}.{apart}"


def scored_by(scores: Content) -> str:
    """Return the key of the error that counts: `held_out` where there is one, else `fit`."""
    return "held_out" if scores.get("held_out") is not None else "fit"


def _error(c: Content, units: Units) -> str:
    e = c["error"]
    key = scored_by(e["after"])
    before, after = (units.said(e[when].get(key), e["unit"]) for when in ("before", "after"))
    named = "Held-out error" if key == "held_out" else "Error of the fit"
    change = f"{before} before, {after} after" if c["effects"] else after
    origin = sorted(set(e.get("noise_from", {}).values()))
    noise = f"noise {units.said(e['noise_floor'], e['unit'])}" if e.get("noise_floor") is not None else "noise not known"
    noise += f" ({listed(origin)})" if origin and origin != ["stated"] else ""
    grid = e.get("discretisation_floor") or 0.0
    return f"{named} {change}; {noise}" + (f", discretisation {units.said(grid, e['unit'])}." if grid > 0 else ".")


def _sure(c: Content) -> str:
    out, named = [], {name for e in c["effects"] for name in e["class"]}
    for e in c["effects"]:
        sentence = ""
        if e.get("p_value") is not None:
            sentence = f"Chance brings such a gain with p = {e['p_value']:.2g} by a linear model of the fits"
        tried = [m for m in c["models"] if m["step"] == e["step"] and m.get("error_ratio")]
        rivals = [m for m in tried if m["name"] not in named]
        own = next((m for m in tried if m["name"] == e["name"]), None)
        if own and rivals:
            best = max(rivals, key=lambda m: m["error_ratio"])
            times = own["error_ratio"] / best["error_ratio"]
            if times >= TELLING:
                rival = f"the nearest rival, {title(best['name'])}, leaves {rounded(times, 2)} times the error"
                sentence = f"{sentence}; {rival}" if sentence else f"{rival[0].upper()}{rival[1:]}"
        if sentence:
            out.append(
                f"{title(e['name']).capitalize()}: {sentence[0].lower()}{sentence[1:]}." if len(c["effects"]) > 1 else f"{sentence}."
            )
    if c.get("scale_error"):
        first, last = (f"{100 * abs(x):.2g}" for x in c["scale_error"])
        amount = first if first == last else f"{first} to {last}"
        longer = "long" if c["scale_error"][0] > 0 else "short"
        out.append(f"A scale error would explain it as well, lengths measured {amount} % too {longer}: measure a known length.")
    if c.get("gravity"):
        out.append(_gravity(c["gravity"]))
    return " ".join(out)


def _gravity(gravity: Content) -> str:
    """Return a sentence on what looks like the gravity that was found."""
    errors = {name: 100 * gravity[name] for name in ("length", "time")}
    length, time = (f"{name}s measured {abs(x):.2g} % too {'long' if x > 0 else 'short'}" for name, x in errors.items())
    found, declared = (f"{gravity[key]:.3g}" for key in ("found", "declared"))
    return (
        f"That is a gravity of {found} in place of {declared} m/s²; it is 9.78 to 9.83 on the ground, "
        f"and {length} or {time} would look the same: check both first."
    )


def _not_excluded(c: Content, units: Units) -> str:
    largest: dict[str, Content] = {}
    for row in c["power"]:
        before = largest.get(row["name"])
        if before is None or (before["up_to"] is not None and (row["up_to"] is None or _share(row) > _share(before))):
            largest[row["name"]] = row
    sized = sorted((row for row in largest.values() if row["up_to"] is not None), key=_share, reverse=True)
    free = [row["name"] for row in largest.values() if row["up_to"] is None]
    out = []
    if sized:
        said = [
            f"{title(r['name'])} ({parameter_words(r['name'], r['parameter'])} up to {units.said(r['up_to'], r['unit'])}; {r['parameter']})"
            for r in sized[:MOST_SAID]
        ]
        more = f" and {len(sized) - MOST_SAID} others, listed in the report" if len(sized) > MOST_SAID else ""
        out.append(f"Not excluded: {listed(said) if not more else ', '.join(said)}{more}.")
    if free:
        shown = listed([title(name) for name in free[:MOST_SAID]]) if len(free) <= MOST_SAID else ""
        shown = shown or f"{', '.join(title(name) for name in free[:MOST_SAID])} and {len(free) - MOST_SAID} others"
        out.append(f"These data set no limit to {shown}.")
    return " ".join(out)


def _share(row: Content) -> float:
    """Return the share of its range that an effect may reach without being excluded."""
    if row["up_to"] is None:
        return math.inf
    return row["up_to"] / row["largest"] if row.get("largest") else 0.0


def _next(c: Content) -> str:
    proposal = c.get("next_experiment")
    if proposal:
        a, b = (title(name) for name in proposal["tells_apart"])
        odds = rounded(math.exp(min(proposal["expected_log_odds"], 600.0)), 2)
        return f"Measure next: {proposal['change']}. It tells {a} from {b}, with expected odds of {odds} to 1."
    return f"What would help: {listed(c['would_help'], 'or')}." if c["would_help"] else ""
