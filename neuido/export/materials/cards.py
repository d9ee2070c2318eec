"""Material cards: the constants of a classical model in the syntax of another program, with units and conversions as comments."""

import os
import re
from pathlib import Path

from neuido.data.files.writing import write_text
from neuido.errors import UserError, suggest
from neuido.export.materials.model_constants import Constants, Units, read_constants, units_of
from neuido.export.materials.structural_cards import abaqus_card, ansys_card
from neuido.export.materials.xml_cards import febio_card, mujoco_card

CARDS = {"abaqus": abaqus_card, "ansys": ansys_card, "febio": febio_card, "mujoco": mujoco_card}
ENDINGS = {"abaqus": ".inp", "ansys": ".mac", "febio": ".xml", "mujoco": ".xml"}


def write_card(
    source: str | os.PathLike, to: str, path: str | os.PathLike | None = None, *, units: str = "si", name: str = "neuido"
) -> Path:
    """Write the constants of a model as a material card.

    Args:
        source: Folder of a diagnosis (its corrected model), an experiment, a material test or a simulation; or a YAML file with a model.
        to: abaqus, ansys, febio or mujoco.
        path: File to write; `NAME` with the program's ending in the working folder where absent.
        units: `si` (m, kg, s, Pa) or `mm` (mm, tonne, s, MPa).
        name: Name of the material: letters, digits, `-` and `_`.

    Raises:
        UserError: No classical model there, or a law that does not map.
    """
    if to not in CARDS:
        raise UserError(f"to = {to!r}{suggest(to, CARDS) or ';'} the cards are {', '.join(CARDS)}")
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_-]{0,63}", name):
        raise UserError(f"name = {name!r}: a material's name starts with a letter and has letters, digits, - and _ (64 at most)")
    target = Path(path).expanduser() if path is not None else Path(name + ENDINGS[to])
    system, constants = units_of(units), read_constants(Path(source).expanduser())
    write_text(target, card_text(constants, to, system, name))
    return target


def card_text(constants: Constants, to: str, units: Units, name: str = "neuido") -> str:
    """Return a card."""
    lines, notes = CARDS[to](constants, name, units)
    law = f"{constants.law}: E = {constants.young:.6g} Pa, nu = {constants.poisson:.6g}, density = {constants.density:.6g} kg/m^3"
    head = [f"material of {constants.source}, written by neuido", f"units: {units.words}", law]
    if constants.effects:
        head.append("effects (SI): " + ", ".join(f"{key} = {value:.6g}" for key, value in constants.effects.items()))
    head += [*notes, *constants.left_out()]
    if to == "abaqus":
        return "\n".join([*(f"** {line}" for line in head), *lines]) + "\n"
    if to == "ansys":
        return "\n".join([*(f"! {line}" for line in head), *lines]) + "\n"
    return "\n".join(["<!--", *(f"  {line.replace('--', '- -')}" for line in head), "-->", *lines]) + "\n"
