"""Material cards for FEBio and MuJoCo.

Sources of the syntax: FEBio User's Manual 4, section 4.1 Material ("neo-Hookean", "natural neo-Hookean", "isotropic elastic",
"Mooney-Rivlin", "Gent", "uncoupled viscoelastic"), with the energies of its theory manual; MuJoCo XML Reference, `flexcomp` and its
`elasticity`.
"""

import math
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from neuido.errors import UserError
from neuido.export.materials.model_constants import ELASTIC_WORDS, Constants, Units
from neuido.export.materials.structural_cards import polynomial

BULK_OVER_SHEAR = 1e3
"""Bulk over shear modulus of a material that was fitted as incompressible: FEBio's uncoupled materials need a finite one."""
MOST_BRANCHES = 6
"""Relaxation times of FEBio's viscoelastic material."""
GRID = ("4 4 4", 0.02)
"""Points and spacing [m] of the block in MuJoCo's card."""
STEP = 0.1
"""Its time step, over the time of an elastic wave from point to point: MuJoCo steps flexes explicitly, with 2 ms unless told."""


def _text(parent: Element, name: str, value: float) -> None:
    SubElement(parent, name).text = f"{value:.9g}"


def febio_card(c: Constants, name: str, units: Units) -> tuple[list[str], list[str]]:
    """Return the lines of a card and its remarks.

    FEBio's "neo-Hookean" and "natural neo-Hookean" are neuido's neo-Hookean and Hencky laws exactly, compressible ones included.
    """
    if c.yields or c.friction_angle is not None:
        what = "von Mises flow" if c.yields else "a Drucker-Prager cone"
        raise UserError(f"{c.source}: {what} does not map to FEBio's materials: export to abaqus or ansys")
    s, notes = units.stress, []
    k, second = c.effect("strain_stiffening"), c.effect("second_invariant")
    material = Element("material", id="1", name=name)
    core = material
    uncoupled = bool(c.prony or k or second or c.incompressible)
    if c.prony:
        material.set("type", "uncoupled viscoelastic")
        _text(material, "density", c.density * units.density)
        if len(c.prony) > MOST_BRANCHES:
            raise UserError(f"{c.source}: {len(c.prony)} relaxation times; FEBio takes {MOST_BRANCHES} at most")
        for i, (g, T) in enumerate(c.prony, 1):
            _text(material, f"g{i}", g)
            _text(material, f"t{i}", T)
        core = SubElement(material, "elastic")
        notes.append("g_i are relative to the relaxed modulus, as FEBio has them; the pressure does not relax")
    if uncoupled:
        bulk = BULK_OVER_SHEAR * c.mu if c.incompressible else c.bulk
        if k > 0 and not second:
            core.set("type", "Gent")
            constants = {"G": s * c.mu, "Jm": 1 / k, "k": s * bulk}
        else:
            C10, C01, *_ = polynomial(c)
            core.set("type", "Mooney-Rivlin")
            constants = {"c1": s * C10, "c2": s * C01, "k": s * bulk}
            if k:
                notes.append("DOES NOT MAP and is left out: strain_stiffening (FEBio's Gent law has no second invariant and no negative k)")
        if c.law != "neo_hookean" or not c.incompressible:
            notes.append(f"{ELASTIC_WORDS[c.law]} elasticity becomes an uncoupled law with equal mu and K: equal at small strains alone")
        if second:
            notes.append("the logarithm of I2bar becomes Mooney and Rivlin's term, its first order")
        if c.incompressible:
            notes.append(f"fitted as incompressible: k is {BULK_OVER_SHEAR:g} mu")
    else:
        kinds = {"neo_hookean": "neo-Hookean", "sigma": "natural neo-Hookean", "fixed_corotated": "neo-Hookean"}
        core.set("type", kinds[c.law])
        constants = {"E": s * c.young, "v": c.poisson}
        exact = c.law != "fixed_corotated"
        words = "neuido's law exactly" if exact else "the neo-Hookean law with equal E and nu: equal at small strains alone"
        notes.append(f"{ELASTIC_WORDS[c.law]} elasticity becomes {words}")
    if core is material:
        _text(core, "density", c.density * units.density)
    for key, value in constants.items():
        _text(core, key, value)
    indent(material, "  ")
    return tostring(material, encoding="unicode").splitlines(), notes


def mujoco_card(c: Constants, name: str, units: Units) -> tuple[list[str], list[str]]:
    """Return the lines of a card and its remarks: a block that MuJoCo loads as it is, with the material in `elasticity`."""
    if c.yields or c.friction_angle is not None:
        what = "von Mises flow" if c.yields else "a Drucker-Prager cone"
        raise UserError(f"{c.source}: {what} does not map to MuJoCo's flexes, which are elastic: export to abaqus or ansys")
    spacing = GRID[1] * units.length
    count = [int(n) for n in GRID[0].split()]
    size = [spacing * (n - 1) for n in count]
    mass = c.density * units.density * size[0] * size[1] * size[2]
    wave = math.sqrt((c.bulk + 4 / 3 * c.mu) / c.density) * units.length
    root = Element("mujoco", model=name)
    SubElement(root, "option", timestep=f"{STEP * spacing / wave:.3g}")
    body = SubElement(SubElement(root, "worldbody"), "body", name=name)
    flex = SubElement(
        body, "flexcomp", name=f"{name}_flex", type="grid", dim="3", count=GRID[0], spacing=" ".join([f"{spacing:.9g}"] * 3),
        radius=f"{0.1 * spacing:.9g}", mass=f"{mass:.9g}",
    )  # fmt: skip
    eta = c.effect("viscosity_shear")
    SubElement(flex, "elasticity", young=f"{units.stress * c.young:.9g}", poisson=f"{c.poisson:.9g}", damping=f"{eta / c.mu:.9g}")
    notes = [
        f"{ELASTIC_WORDS[c.law]} elasticity becomes Saint Venant and Kirchhoff's law with equal E and nu: equal at small strains alone",
        "the time step is for this block: a tenth of the time of an elastic wave between two points",
        f"geometry is a placeholder; mass is that of its volume at {c.density:g} kg/m^3",
    ]
    if eta:
        notes.append("shear viscosity becomes damping eta/mu [s], proportional to stiffness: volume changes are damped as much")
    if c.prony:
        notes.append("DOES NOT MAP and is left out: the relaxation; E and nu are the relaxed ones")
    if units.name != "si":
        notes.append("gravity in mm/s^2 has to be set in <option>")
    indent(root, "  ")
    return tostring(root, encoding="unicode").splitlines(), notes
