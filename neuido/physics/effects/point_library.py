"""Entries of the library for the effects that laboratories see in material tests.

Two of them, sums of Maxwell branches, act in bodies too. Rollouts of bodies refuse the others. The ranges are those of soft and hard
materials alike.
"""

from neuido.physics.effects.entry import Entry, Parameter

FIELD = "point"
"""The field of `Effects` that holds the parameters of these effects by name."""
BODIES_TOO = ("relaxation_spectrum", "fractional")
"""Effects of this module that rollouts of bodies have too."""


def _entry(name: str, title: str, equation: str, *parameters: tuple[str, str, float, float], **more) -> Entry:
    """Return an entry from parameters (name, unit, low, high)."""
    made = tuple(Parameter(key, FIELD, unit, low, high, low < 0) for key, unit, low, high in parameters)
    return Entry(name, title, equation, made, only="" if name in BODIES_TOO else "material test", **more)


POINT_ENTRIES = (
    _entry(
        "relaxation_spectrum",
        "a spectrum of relaxation times",
        "G(t) += mu sum g_i exp(-t/T_i), five T_i evenly spaced in ln T from first to last",
        *((f"g{i}", "1", 0.0, 1e4) for i in range(1, 6)),
        ("first", "s", 1e-9, 1e9),
        ("last", "s", 1e-9, 1e9),
        stage="internal modes",
        confusions=("maxwell", "fractional", "hysteresis", "creep"),
        source="Prony series: Ferry, Viscoelastic Properties of Polymers, 1980, 3",
        limits=("maxwell",),
        needs="times over at least two decades",
    ),
    _entry(
        "fractional",
        "a power law of relaxation",
        "G(t) += mu ratio (t/time)^-exponent, over eight decades about time",
        ("ratio", "1", 0.0, 1e4),
        ("exponent", "1", 0.02, 0.98),
        ("time", "s", 1e-9, 1e9),
        stage="internal modes",
        confusions=("maxwell", "relaxation_spectrum", "hysteresis", "viscosity_shear"),
        source="Scott Blair 1947; Bagley and Torvik 1983",
        needs="times over at least two decades",
    ),
    _entry(
        "mullins",
        "the Mullins effect",
        "elastic stress times 1 - share erf((x_max - x)/(width x_max)), x = I1bar - 3",
        ("share", "1", 0.0, 0.99),
        ("width", "1", 0.01, 10.0),
        stage="internal modes",
        confusions=("softening", "permanent_set", "hysteresis", "maxwell"),
        source="Ogden and Roxburgh 1999, with the energy of a neo-Hookean law",
        needs="unloading",
    ),
    _entry(
        "permanent_set",
        "a permanent set",
        "F_e = F exp(-share ln U_max), U_max the stretch of the largest strain so far",
        ("share", "1", 0.0, 0.9),
        stage="rest",
        confusions=("mullins", "softening", "yield", "creep"),
        source="Dorfmann and Ogden 2004, residual strain in proportion to the largest strain",
        needs="unloading",
    ),
    _entry(
        "compaction",
        "compaction",
        "tau -= 2 mu k sum x_i^2/(lock - x_i) n_i n_i, x_i = max(-e_i, 0)",
        ("k", "1", 0.0, 100.0),
        ("lock", "1", 0.05, 5.0),
        stage="internal modes",
        confusions=("strain_stiffening", "tension_compression"),
        source="Gibson and Ashby, Cellular Solids, 1997, 5: densification at a locking strain",
        needs="compression",
    ),
    _entry(
        "creep",
        "creep",
        "plastic rate = rate (|s|/stress)^exponent along s = dev tau",
        ("rate", "1/s", 0.0, 1e6),
        ("exponent", "1", 0.5, 30.0),
        ("stress", "Pa", 1e-6, 1e12),
        stage="rest",
        confusions=("maxwell", "relaxation_spectrum", "fractional", "yield", "viscosity_shear"),
        source="Norton 1929; exponent 1 is Maxwell's fluid",
    ),
    _entry(
        "nonlinear_backstress",
        "a backstress that saturates",
        "backstress_i' = h_i plastic strain rate - g_i backstress_i alpha', up to three",
        *((key, unit, 0.0, high) for i in "123" for key, unit, high in ((f"h{i}", "Pa", 1e13), (f"g{i}", "1", 1e5))),
        stage="rest",
        confusions=("kinematic_hardening", "hardening", "cyclic_hardening"),
        source="Armstrong and Frederick 1966; Chaboche 1986",
        limits=("kinematic_hardening",),
        needs="reversals of a body that yields",
    ),
    _entry(
        "cyclic_hardening",
        "hardening or softening that saturates",
        "yield stress + q (1 - exp(-b alpha))",
        ("q", "Pa", -1e10, 1e10),
        ("b", "1", 1e-3, 1e5),
        stage="rest",
        confusions=("hardening", "softening", "nonlinear_backstress"),
        source="Voce 1948; Chaboche 1986",
        limits=("hardening",),
        needs="a body that yields",
    ),
    _entry(
        "rate_power",
        "a flow stress that rises with a power of the rate",
        "yield stress + k (plastic rate)^n",
        ("k", "Pa s^n", 0.0, 1e12),
        ("n", "1", 0.02, 1.5),
        stage="rest",
        confusions=("rate_yield", "hardening", "viscosity_shear"),
        source="Herschel and Bulkley 1926; in a body that is elastic before it yields Saramito 2009",
        limits=("rate_yield",),
        needs="a body that yields, at several rates",
    ),
    _entry(
        "power_law",
        "a viscosity that changes with a power of the rate",
        "viscosity times (rate/reference)^n",
        ("n", "1", -0.99, 1.0),
        ("reference", "1/s", 1e-9, 1e9),
        stage="internal modes",
        confusions=("carreau", "herschel_bulkley", "bingham", "thixotropy"),
        source="Ostwald 1925, de Waele 1923; n is their exponent less one",
        needs="a flow curve",
    ),
    _entry(
        "carreau",
        "a viscosity that falls beyond a rate",
        "viscosity times (1 + (time rate)^2)^(n/2)",
        ("n", "1", -0.99, 1.0),
        ("time", "s", 1e-9, 1e9),
        stage="internal modes",
        confusions=("power_law", "herschel_bulkley", "thixotropy"),
        source="Carreau 1972, without a limit at high rates; n is his exponent less one",
        limits=("power_law",),
        needs="a flow curve",
    ),
    _entry(
        "bingham",
        "a yield stress of the flow",
        "shear stress + yield",
        ("yield", "Pa", 0.0, 1e9),
        stage="rest",
        confusions=("herschel_bulkley", "power_law", "thixotropy"),
        source="Bingham 1922",
        needs="a flow curve",
    ),
    _entry(
        "herschel_bulkley",
        "a yield stress and a power of the rate",
        "shear stress = yield + viscosity rate (rate/reference)^n",
        ("yield", "Pa", 0.0, 1e9),
        ("n", "1", -0.99, 1.0),
        ("reference", "1/s", 1e-9, 1e9),
        stage="rest",
        confusions=("bingham", "power_law", "carreau", "thixotropy"),
        source="Herschel and Bulkley 1926; n is their exponent less one",
        limits=("bingham", "power_law"),
        needs="a flow curve",
    ),
    _entry(
        "thixotropy",
        "thixotropy",
        "viscosity times 1 + c z, z' = build (1 - z - breakdown rate z), from rest at z = 1",
        ("c", "1", 0.0, 1e6),
        ("breakdown", "s", 1e-9, 1e9),
        ("build", "1/s", 1e-9, 1e9),
        stage="internal modes",
        confusions=("power_law", "carreau", "bingham", "herschel_bulkley"),
        source="Moore 1959, one structure parameter",
        needs="a flow curve; rates up and down in time tell it from the others",
    ),
)
"""One entry for each effect."""
FLUID = ("power_law", "carreau", "bingham", "herschel_bulkley", "thixotropy")
"""Effects of a declared fluid in steady or changing shear; a solid has none of them, and a fluid no others."""
