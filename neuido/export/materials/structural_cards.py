"""Material cards for Abaqus and Ansys.

Sources of the syntax: Abaqus Keywords Guide (*ELASTIC, *HYPERELASTIC, *VISCOELASTIC, *PLASTIC, *CYCLIC HARDENING, *RATE DEPENDENT,
*DRUCKER PRAGER, *DRUCKER PRAGER HARDENING); Ansys Mechanical APDL Material Reference, 3.4 Rate-Independent Plasticity, 3.6 Hyperelasticity
(4.6 since 2024), 3.7 Viscoelasticity, and the TB command (HYPER, PRONY, PLASTIC, CHABOCHE, RATE, EDP).
"""

from neuido.export.materials.model_constants import ELASTIC_WORDS, Constants, Units

POINTS = 21
"""Points of a tabulated hardening curve, over equivalent plastic strains of 0 to 1."""
LEAST_COHESION = 1e-6
"""Cohesion of dry sand in a card, relative to Young's modulus: Abaqus needs a positive one."""


def figures(*values: float) -> str:
    """Return numbers separated by commas."""
    return ", ".join(f"{value:.9g}" for value in values)


def rubber(c: Constants) -> bool:
    """Return whether a card takes the material as hyperelastic rather than as linear elastic at small strains."""
    return not c.yields and c.friction_angle is None and (
        c.law == "neo_hookean" or c.incompressible or bool(c.effect("strain_stiffening")) or bool(c.effect("second_invariant"))
    )  # fmt: skip


def relaxes(c: Constants) -> bool:
    """Return whether a card has a Prony series: neither program takes one beside plasticity."""
    return bool(c.prony) and not c.yields and c.friction_angle is None


def polynomial(c: Constants) -> tuple[float, float, float, float]:
    """Return C10, C01, C20 and C30 [Pa] of the expansion in I1bar - 3 and I2bar - 3.

    Gent's energy -mu/(2 k) ln(1 - k x) is mu/2 (x + k x^2/2 + k^2 x^3/3 + ...); Gent and Thomas' 3/2 mu c ln(I2bar/3) is, at first order,
    mu c/2 (I2bar - 3).
    """
    k, second = c.effect("strain_stiffening"), c.effect("second_invariant")
    return c.mu / 2, c.mu * second / 2, c.mu * k / 4, c.mu * k * k / 6


def remarks(c: Constants, program: str) -> list[str]:
    """Return what the conversion changes, a line each."""
    out = []
    if not rubber(c) and c.law != "sigma":
        out.append(f"{ELASTIC_WORDS[c.law]} elasticity becomes linear elasticity with equal E and nu: equal at small strains alone")
    elif not rubber(c):
        out.append("Hencky elasticity becomes linear elasticity of the logarithmic strain")
    elif c.law == "neo_hookean" and not c.incompressible:
        out.append("neuido's law has mu (b - I) + lambda ln J; here shear takes the isochoric part alone and the pressure is K (J - 1):")
        out.append("both agree at small strains, and nearly so for nu above 0.45")
    elif rubber(c) and c.law != "neo_hookean":
        out.append(f"{ELASTIC_WORDS[c.law]} elasticity becomes hyperelastic with equal mu and K: equal at small strains alone")
    if c.effect("strain_stiffening") and program == "abaqus":
        out.append("Gent's stiffening becomes Yeoh's terms up to the third: right for k (I1bar - 3) well below 1")
        if c.effect("strain_stiffening") < 0:
            out.append("negative stiffening: C20 is negative, and the material is stable at moderate strains alone")
    if c.effect("second_invariant"):
        out.append("the logarithm of I2bar becomes Mooney and Rivlin's term, its first order")
    if c.incompressible:
        out.append("fitted as incompressible: the bulk term is zero, use hybrid (u-P) elements")
    if c.yields and c.law != "sigma":
        out.append("neuido yields on Kirchhoff stress and Hencky strain; small strains alone agree exactly")
    return out


def abaqus_card(c: Constants, name: str, units: Units) -> tuple[list[str], list[str]]:
    """Return the lines of a card and its remarks."""
    s, notes = units.stress, remarks(c, "abaqus")
    term = ", MODULI=LONG TERM" if relaxes(c) else ""
    out = [f"*MATERIAL, NAME={name}", "*DENSITY", figures(c.density * units.density)]
    if rubber(c):
        C10, C01, C20, C30 = (s * value for value in polynomial(c))
        D = 0.0 if c.incompressible else 2 / (s * c.bulk)
        if C01 and C20:
            out += [f"*HYPERELASTIC, POLYNOMIAL, N=3{term}", figures(C10, C01, C20, 0, 0, C30, 0, 0), figures(0, D, 0, 0)]
        elif C01:
            out += [f"*HYPERELASTIC, MOONEY-RIVLIN{term}", figures(C10, C01, D)]
        elif C20:
            out += [f"*HYPERELASTIC, YEOH{term}", figures(C10, C20, C30, D, 0, 0)]
        else:
            out += [f"*HYPERELASTIC, NEO HOOKE{term}", figures(C10, D)]
    else:
        out += [f"*ELASTIC, TYPE=ISOTROPIC{term}", figures(s * c.young, c.poisson)]
    if relaxes(c):
        total = 1 + sum(g for g, _ in c.prony)
        out += ["*VISCOELASTIC, TIME=PRONY", *(figures(g / total, 0, T) for g, T in c.prony)]
    elif c.prony:
        notes.append("DOES NOT MAP and is left out: the relaxation, since Abaqus takes no Prony series beside plasticity")
    if c.yields:
        out += _abaqus_plasticity(c, s, notes)
    if c.friction_angle is not None:
        out += _abaqus_cone(c, s, notes)
    if eta := c.effect("viscosity_shear"):
        notes.append(f"shear viscosity has no place in the card; *DAMPING, BETA={eta / c.mu:.6g} (eta/mu [s]) damps shear as much")
    return out, notes


def _abaqus_plasticity(c: Constants, s: float, notes: list[str]) -> list[str]:
    start, back = s * c.flow_stress(0), c.backstresses
    if back:
        moduli = figures(start, *(value for C, gamma in back for value in (s * C, gamma)))
        out = [f"*PLASTIC, HARDENING=COMBINED, DATA TYPE=PARAMETERS, NUMBER BACKSTRESSES={len(back)}", moduli]
        curve = "*CYCLIC HARDENING"
    else:
        out, curve = [], "*PLASTIC, HARDENING=ISOTROPIC"
    if not back or not c.linear_hardening or c.effect("hardening"):
        strains = (0.0, 1.0) if c.linear_hardening else tuple(i / (POINTS - 1) for i in range(POINTS))
        strains = strains if c.effect("hardening") or not c.linear_hardening else strains[:1]
        out += [curve, *(figures(s * c.flow_stress(e), e) for e in strains)]
    if eta := c.effect("rate_yield"):
        out += ["*RATE DEPENDENT, TYPE=POWER LAW", figures(2 / 3 * c.flow_stress(0) / eta, 1)]
        if c.effect("hardening") or not c.linear_hardening:
            notes.append("the rate term is relative to the yield stress here, and grows with hardening; in neuido it does not")
    return out


def _abaqus_cone(c: Constants, s: float, notes: list[str]) -> list[str]:
    import math

    slope, cohesion = c.cone
    if cohesion <= 0:
        cohesion = LEAST_COHESION * c.young
        notes.append(f"a cone without cohesion needs a small one here: {s * cohesion:.3g}")
    return [
        "*DRUCKER PRAGER, SHEAR CRITERION=LINEAR",
        figures(math.degrees(math.atan(slope)), 1, 0),
        "*DRUCKER PRAGER HARDENING, TYPE=SHEAR",
        figures(s * cohesion, 0),
    ]


def ansys_card(c: Constants, name: str, units: Units) -> tuple[list[str], list[str]]:
    """Return the lines of a card and its remarks."""
    s, notes = units.stress, remarks(c, "ansys")
    out = ["MAT_ID = 1", f"MP,DENS,MAT_ID,{figures(c.density * units.density)}"]
    if c.prony and not relaxes(c):
        notes.append("DOES NOT MAP and is left out: the relaxation, since Ansys takes no Prony series beside plasticity")
    prony = c.prony if relaxes(c) else []
    factor = 1 + sum(g for g, _ in prony)
    if rubber(c):
        C10, C01, C20, C30 = (s * factor * value for value in polynomial(c))
        d = 0.0 if c.incompressible else 2 / (s * c.bulk)
        k = c.effect("strain_stiffening")
        if C01 and C20:
            out += ["TB,HYPER,MAT_ID,,3,POLY", f"TBDATA,1,{figures(C10, C01, C20, 0, 0, C30)}", f"TBDATA,7,{figures(0, 0, 0, d, 0, 0)}"]
            notes.append("Gent's stiffening becomes terms of the polynomial up to the third: right for k (I1bar - 3) well below 1")
        elif C01:
            out += ["TB,HYPER,MAT_ID,,2,MOONEY", f"TBDATA,1,{figures(C10, C01, d)}"]
        elif k > 0:
            out += ["TB,HYPER,MAT_ID,,,GENT", f"TBDATA,1,{figures(2 * C10, 1 / k, d)}"]
        elif k < 0:
            out += ["TB,HYPER,MAT_ID,,3,YEOH", f"TBDATA,1,{figures(C10, C20, C30, d, 0, 0)}"]
            notes.append("negative stiffening has no place in Gent's law here; Yeoh's C20 is negative: stable at moderate strains alone")
        else:
            out += ["TB,HYPER,MAT_ID,,,NEO", f"TBDATA,1,{figures(2 * C10, d)}"]
    else:
        young, poisson = c.instantaneous if prony else (c.young, c.poisson)
        out += [f"MP,EX,MAT_ID,{figures(s * young)}", f"MP,PRXY,MAT_ID,{figures(poisson)}"]
    if prony:
        pairs = [value for g, T in prony for value in (g / factor, T)]
        out.append(f"TB,PRONY,MAT_ID,,{len(prony)},SHEAR")
        out += [f"TBDATA,{i + 1},{figures(*pairs[i : i + 6])}" for i in range(0, len(pairs), 6)]
        notes.append("the elastic constants are the instantaneous ones, to which TB,PRONY refers")
    if c.yields:
        out += _ansys_plasticity(c, s, notes)
    if c.friction_angle is not None:
        slope, cohesion = c.cone
        out += ["TB,EDP,MAT_ID,,2,LYFUN", f"TBDATA,1,{figures(slope, s * max(cohesion, LEAST_COHESION * c.young))}"]
        out += ["TB,EDP,MAT_ID,,1,LFPOT", "TBDATA,1,0"]
    if eta := c.effect("viscosity_shear"):
        notes.append(f"shear viscosity has no place in the card; MP,BETD,MAT_ID,{eta / c.mu:.6g} (eta/mu [s]) damps shear as much")
    return out, notes


def _ansys_plasticity(c: Constants, s: float, notes: list[str]) -> list[str]:
    start, back = s * c.flow_stress(0), c.backstresses
    out = []
    if back:
        constants = [start, *(value for C, gamma in back for value in (s * C, gamma))]
        out += [f"TB,CHABOCHE,MAT_ID,,{len(back)}"]
        out += [f"TBDATA,{i + 1},{figures(*constants[i : i + 6])}" for i in range(0, len(constants), 6)]
    if not back or c.effect("hardening") or not c.linear_hardening:
        strains = (0.0, 1.0) if c.linear_hardening else tuple(i / (POINTS - 1) for i in range(POINTS))
        out += [f"TB,PLASTIC,MAT_ID,,{len(strains)},MISO", *(f"TBPT,DEFI,{figures(e, s * c.flow_stress(e))}" for e in strains)]
    if eta := c.effect("rate_yield"):
        out += ["TB,RATE,MAT_ID,,,PERZYNA", f"TBDATA,1,{figures(1, 2 / 3 * c.flow_stress(0) / eta)}"]
        notes.append("the rate term is relative to the yield stress here, and grows with hardening; in neuido it does not")
    return out
