"""Entries of the library for the effects that laboratories see in material tests, in plane specimens, and in tracks of points.

Two of those of tests, sums of Maxwell branches, act in bodies too. Rollouts of bodies refuse the others. The ranges are those of soft
and hard materials alike.
"""

from neuido.physics.effects.entry import Entry, Parameter

FIELD = "point"
"""The field of `Effects` that holds the parameters of these effects by name."""
BODIES_TOO = ("relaxation_spectrum", "fractional")
"""Effects of this module that rollouts of bodies have too."""


def _entry(name: str, title: str, equation: str, *parameters: tuple[str, str, float, float], only: str = "material test", **more) -> Entry:
    """Return an entry from parameters (name, unit, low, high)."""
    made = tuple(Parameter(key, FIELD, unit, low, high, low < 0) for key, unit, low, high in parameters)
    return Entry(name, title, equation, made, only="" if name in BODIES_TOO else only, **more)


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

PLANE_ENTRIES = (
    _entry(
        "volumetric",
        "another dependence on the volume",
        "W = (1 - share) W(mu/2 (I1 - 3) - mu ln J + lambda/2 (ln J)^2) + share W(mu/2 (I1bar - 3) + K/2 (J - 1)^2), or the reverse",
        ("share", "1", -1.0, 3.0),
        only="plane specimen",
        stage="internal modes",
        confusions=("strain_stiffening", "second_invariant", "geometric_nonlinearity"),
        source="Holzapfel, Nonlinear Solid Mechanics, 2000, 6.4 and 6.5; of other laws lambda/2 (ln J)^2 against lambda/2 (J - 1)^2",
        needs="a volume that changes by some per cent",
    ),
    _entry(
        "geometric_nonlinearity",
        "large deformation (geometric nonlinearity)",
        "W = (1 - share) W(small strain) + share W(mu/2 (I1bar - 3) + K/2 (J - 1)^2)",
        ("share", "1", 0.0, 1.0),
        only="plane specimen",
        stage="internal modes",
        confusions=("volumetric", "strain_stiffening", "second_invariant"),
        source="Bonet and Wood, Nonlinear Continuum Mechanics for Finite Element Analysis, 2008",
        needs="a declared linear elasticity, and strains of some per cent",
    ),
)
"""Effects of a plane specimen beside those that bodies have too."""

TRACK_ENTRIES = (
    Entry(
        "dry_friction",
        "dry friction",
        "a -= c v/|v|",
        (Parameter("c", "dry_friction", "m/s^2", 0.0, 10.0),),
        "flight",
        ("drag_linear", "drag_quadratic"),
        "Coulomb 1785; of a rolling ball c = g times its coefficient of rolling resistance",
        needs="a body that is guided: a pendulum, a spring, an axis or a plane",
        only="track",
    ),
    Entry(
        "local_force",
        "a force near a place",
        "a -= a0 r exp((1 - r^2)/2), r = (x - c)/w",
        (
            Parameter("a0", "local_force", "m/s^2", -50.0, 50.0, True),
            *(Parameter(axis, "local_centre", "m", -10.0, 10.0, True) for axis in "xyz"),
            Parameter("w", "local_width", "m", 1e-3, 2.0),
        ),
        "flight",
        ("position_force", "time_force"),
        "a bell-shaped potential, as of a magnet beside the path",
        only="track",
    ),
    Entry(
        "lift",
        "lift of a disc",
        "a += |v|^2 (k s e - d s^2 v/|v|), s = sine of the angle of attack",
        (Parameter("k", "lift", "1/m", -2.0, 2.0, True), Parameter("d", "lift_drag", "1/m", 0.0, 4.0)),
        "flight",
        ("magnus", "drag_quadratic", "uniform_acceleration"),
        "Potts and Crowther 2002; Hummel 2003: lift linear and drag quadratic in the angle of attack",
        needs="two measured axes, one of them along gravity",
        only="track",
    ),
    Entry(
        "buoyancy",
        "buoyancy and the mass of the moved fluid",
        "a = g (1 - q)/(1 + q/2) without other forces",
        (Parameter("q", "added_mass", "1", 0.0, 20.0),),
        "flight",
        ("gravity", "added_mass", "drag_linear"),
        "Lamb, Hydrodynamics, 92: a sphere in a fluid, q its density over that of the sphere",
        only="track",
    ),
    Entry(
        "bounce_friction",
        "friction and spin in a bounce",
        "tangential impulse mu times the normal one, until the body rolls",
        (Parameter("mu", "bounce_friction", "1", 0.0, 2.0),),
        "contact",
        ("bounce_speed",),
        "Garwin 1969; Cross 2002",
        needs="a declared bounce, and a horizontal axis",
        only="track",
    ),
    Entry(
        "bounce_speed",
        "a restitution that depends on the speed",
        "restitution times (speed in m/s)^-p",
        (Parameter("p", "restitution_speed", "1", -0.5, 0.5, True),),
        "contact",
        ("bounce_friction", "drag_quadratic"),
        "Johnson, Contact Mechanics, 11.5: p = 1/4 of plastic impacts",
        needs="a declared bounce, at several speeds",
        only="track",
    ),
)
"""Effects that the track of a body as a point shows, beside those that bodies have too; their fields are those of `points.Forces`."""
