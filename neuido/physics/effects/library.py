"""The library of effects that a model may lack; `diagnosis.json` uses the names of its entries.

The ranges are physical priors for bodies of a centimetre to a metre that move for seconds, with moduli of 1e4 to 1e6 Pa. A diagnosis
rejects an explanation whose value lies outside. The confusions were measured in a pilot study, or seen in recordings.
"""

from collections.abc import Sequence
from typing import NamedTuple


class Parameter(NamedTuple):
    """One parameter of an effect, "<effect>.<name>"."""

    name: str
    field: str
    """The field of `Effects` that it sets, or sets a component of."""
    unit: str
    low: float
    """Lower end of the physical range, inclusive."""
    high: float
    """Upper end of the physical range, inclusive."""
    signed: bool = False
    """Whether both signs are possible."""


class Entry(NamedTuple):
    """One effect: its equation, its parameters with ranges, where it shows, and which effects it is confused with."""

    name: str
    title: str
    """The effect in words, as they stand after "the model lacks"."""
    equation: str
    parameters: tuple[Parameter, ...]
    stage: str
    """The part of a motion in which it shows: flight, rotation, internal modes, contact, rest or power."""
    confusions: tuple[str, ...]
    """Effects that explain similar data."""
    source: str
    """Reference of the equation."""
    limits: tuple[str, ...] = ()
    """Effects with fewer parameters that this one becomes at an end of its range."""
    needs: str = ""
    """What must be measured for it to show, beside what `stage` says."""


def _vector(field: str, unit: str, size: float, names: Sequence[str] = "xyz") -> tuple[Parameter, ...]:
    return tuple(Parameter(name, field, unit, -size, size, True) for name in names)


KNOTS = 5
"""Number of knots of `time_force` that the library lists; `Effects.of` accepts any number."""

LIBRARY = (
    Entry(
        "gravity",
        "a different gravity",
        "a += dg g/|g|",
        (Parameter("g", "gravity", "m/s^2", -3.0, 3.0, True),),
        "flight",
        ("uniform_acceleration", "added_mass"),
        "Newton's second law",
    ),
    Entry(
        "uniform_acceleration",
        "a constant acceleration",
        "a += w",
        _vector("uniform_acceleration", "m/s^2", 3.0),
        "flight",
        ("gravity", "position_force", "time_force"),
        "Newton's second law in a tilted frame",
    ),
    Entry(
        "drag_linear",
        "linear air drag",
        "a -= k v",
        (Parameter("k", "drag_linear", "1/s", 0.0, 5.0),),
        "flight",
        ("drag_quadratic", "viscosity_shear", "added_mass"),
        "Stokes 1851",
    ),
    Entry(
        "drag_quadratic",
        "quadratic air drag",
        "a -= k |v| v",
        (Parameter("k", "drag_quadratic", "1/m", 0.0, 2.0),),
        "flight",
        ("drag_linear", "viscosity_shear"),
        "Newton; Landau and Lifshitz, Fluid Mechanics, 45",
    ),
    Entry(
        "magnus",
        "a Magnus force",
        "a += w x v",
        _vector("magnus", "1/s", 5.0),
        "flight",
        ("uniform_acceleration",),
        "Rubinow and Keller 1961, eq. 1: lift of a spinning sphere",
    ),
    Entry(
        "position_force",
        "a force towards a place",
        "a -= k (x - c)",
        (
            Parameter("k", "position_force", "1/s^2", -30.0, 30.0, True),
            *_vector("position_centre", "m", 2.0),
        ),
        "flight",
        ("uniform_acceleration", "gravity"),
        "Hooke; the first term of a magnet's field gradient",
        limits=("uniform_acceleration",),
    ),
    Entry(
        "time_force",
        "a force that changes in time",
        "a += b(t), linear between knots",
        (
            *(Parameter(f"{a}{j}", "time_force", "m/s^2", -5.0, 5.0, True) for j in range(KNOTS) for a in "xyz"),
            Parameter("interval", "time_force_interval", "s", 1e-3, 2.0),
        ),
        "flight",
        ("uniform_acceleration",),
        "Newton's second law in a shaken frame",
        limits=("uniform_acceleration",),
    ),
    Entry(
        "viscosity_shear",
        "shear viscosity",
        "sigma += 2 eta D",
        (Parameter("eta", "viscosity_shear", "Pa s", 0.0, 1e3),),
        "internal modes",
        ("maxwell", "hysteresis", "viscosity_bulk", "restitution", "drag_linear"),
        "Kelvin 1865, Voigt 1892",
    ),
    Entry(
        "viscosity_bulk",
        "bulk viscosity",
        "sigma += zeta tr(D) I",
        (Parameter("zeta", "viscosity_bulk", "Pa s", 0.0, 1e3),),
        "internal modes",
        ("viscosity_shear", "restitution", "hysteresis"),
        "Landau and Lifshitz, Theory of Elasticity, 34",
    ),
    Entry(
        "maxwell",
        "stress relaxation",
        "tau += 2 g mu e, e' = dev D + W e - e W - e/T",
        (
            Parameter("ratio", "maxwell_ratio", "1", 0.0, 3.0),
            Parameter("time", "maxwell_time", "s", 1e-3, 10.0),
        ),
        "internal modes",
        ("viscosity_shear", "hysteresis"),
        "Maxwell 1867; Simo and Hughes, Computational Inelasticity, 10",
        limits=("viscosity_shear",),
    ),
    Entry(
        "hysteresis",
        "hysteresis",
        "six Maxwell branches, weights (2 eta/pi) G'(1/T) dln T: loss factor eta over 0.5-200 Hz",
        (Parameter("eta", "hysteresis", "1", 0.0, 0.5),),
        "internal modes",
        ("viscosity_shear", "maxwell"),
        "Findley, Lai and Onaran 1976; Biot 1958",
    ),
    Entry(
        "strain_stiffening",
        "strain stiffening",
        "tau += mu k x/(1 - k x) dev bbar, x = I1bar - 3",
        (Parameter("k", "strain_stiffening", "1", -0.2, 10.0, True),),
        "internal modes",
        ("second_invariant", "tension_compression"),
        "Gent 1996, with 1/k for J_m; its first order is the second term of Yeoh 1990",
    ),
    Entry(
        "second_invariant",
        "a dependence on the second invariant",
        "W += 3/2 mu c ln(I2bar/3)",
        (Parameter("c", "second_invariant", "1", -0.3, 2.0, True),),
        "internal modes",
        ("strain_stiffening", "tension_compression"),
        "Gent and Thomas 1958; beside Gent's first term Pucci and Saccomandi 2002",
    ),
    Entry(
        "tension_compression",
        "a difference between tension and compression",
        "tau += 2 mu r sum min(e_i, 0) n_i n_i",
        (Parameter("r", "tension_compression", "1", -0.7, 3.0, True),),
        "internal modes",
        ("strain_stiffening", "second_invariant"),
        "Ambartsumyan 1965, in Hencky strain",
    ),
    Entry(
        "fibre",
        "a fibre direction",
        "W += c/4 (I4 - 1)^2, I4 = |F a0|^2",
        (
            Parameter("c", "fibre", "Pa", 0.0, 1e6),
            Parameter("azimuth", "fibre_direction", "rad", -3.15, 3.15, True),
            Parameter("elevation", "fibre_direction", "rad", -1.58, 1.58, True),
        ),
        "internal modes",
        ("stiffness_gradient",),
        "Holzapfel, Gasser and Ogden 2000 (the standard reinforcing model)",
    ),
    Entry(
        "yield",
        "yielding",
        "|2 mu dev ln V| <= 1/inverse",
        (Parameter("inverse", "yield_inverse", "1/Pa", 0.0, 1e-2),),
        "rest",
        ("viscosity_shear", "rate_yield", "softening"),
        "von Mises 1913; paper, appendix, Von Mises Plasticity",
    ),
    Entry(
        "hardening",
        "hardening",
        "yield stress + H alpha",
        (Parameter("h", "hardening", "Pa", 0.0, 1e6),),
        "rest",
        ("kinematic_hardening", "rate_yield"),
        "Simo and Hughes, Computational Inelasticity, 2",
    ),
    Entry(
        "softening",
        "softening",
        "yield stress times exp(-s alpha); where nothing yields elastic stress times exp(-s e_max)",
        (Parameter("s", "softening", "1", 0.0, 30.0),),
        "internal modes",
        ("stiffness_change", "yield"),
        "Simo 1987 (damage by the largest strain)",
    ),
    Entry(
        "kinematic_hardening",
        "kinematic hardening",
        "backstress' = H_k plastic strain rate + W b - b W",
        (Parameter("h", "kinematic_hardening", "Pa", 0.0, 1e6),),
        "rest",
        ("hardening",),
        "Prager 1956",
    ),
    Entry(
        "rate_yield",
        "rate-dependent yielding",
        "plastic rate = <|s| - yield stress>/eta",
        (Parameter("eta", "rate_yield", "Pa s", 0.0, 1e4),),
        "rest",
        ("hardening", "viscosity_shear", "yield"),
        "Perzyna 1963",
    ),
    Entry(
        "stiffness_gradient",
        "a stiffness that varies over the body",
        "elastic stress times exp(s . (X - mean)/L), or times exp(log_ratio) in a ball",
        (
            *_vector("stiffness", "1", 3.0),
            Parameter("log_ratio", "stiffness", "1", -4.0, 4.0, True),
            Parameter("radius", "stiffness", "m", 0.0, 1.0),
            *_vector("stiffness", "m", 1.0, ("cx", "cy", "cz")),
            Parameter("width", "stiffness", "m", 0.0, 0.5),
        ),
        "internal modes",
        ("fibre",),
        "functionally graded elasticity",
    ),
    Entry(
        "stiffness_change",
        "a stiffness that changes in time",
        "elastic stress times exp(r t)",
        (Parameter("rate", "stiffness_change", "1/s", -3.0, 3.0, True),),
        "internal modes",
        ("softening", "strain_stiffening"),
        "first-order ageing",
    ),
    Entry(
        "friction",
        "a different friction",
        "|v_t| falls by (mu + dmu) |v_n| in contact",
        (Parameter("mu", "friction", "1", -1.0, 1.0, True),),
        "contact",
        ("stick", "drag_linear"),
        "Coulomb 1785",
    ),
    Entry(
        "stick",
        "sticking contact",
        "v of a node in contact times exp(-k dt)",
        (Parameter("rate", "stick", "1/s", 0.0, 1e4),),
        "contact",
        ("restitution", "friction"),
        "a viscous film on the collider",
    ),
    Entry(
        "restitution",
        "a damped bounce",
        "outward normal v of a node in contact times exp(-k dt)",
        (Parameter("rate", "restitution", "1/s", 0.0, 1e4),),
        "contact",
        ("stick", "viscosity_shear", "viscosity_bulk"),
        "a dashpot under the collider",
    ),
    Entry(
        "cohesion",
        "cohesion",
        "|dev tau| <= -alpha (tr tau - 3 c cot phi)",
        (Parameter("c", "cohesion", "Pa", 0.0, 5e3),),
        "rest",
        ("friction", "stick"),
        "Drucker and Prager 1952, the tip of Mohr and Coulomb's cone; without cohesion Klar et al. 2016",
    ),
    Entry(
        "added_mass",
        "added mass",
        "mass (1 + c), weight unchanged",
        (Parameter("c", "added_mass", "1", -0.5, 2.0, True),),
        "flight",
        ("gravity", "drag_linear"),
        "Lamb, Hydrodynamics, 92",
    ),
    Entry(
        "swelling",
        "swelling or drying",
        "F_e = F/g(t), g = 1 + rate t",
        (Parameter("rate", "swelling", "1/s", -1.0, 2.0, True),),
        "rest",
        ("added_mass", "stiffness_change"),
        "Rodriguez, Hoger and McCulloch 1994, isotropic growth at constant mass",
        needs="two points of the body at least, and times; a video that shows its size",
    ),
    Entry(
        "spin_decay",
        "a decay of the spin",
        "dL/dt = -k L about the centre of mass",
        (Parameter("k", "spin_decay", "1/s", 0.0, 20.0),),
        "rotation",
        ("drag_linear", "drag_quadratic", "friction"),
        "Landau and Lifshitz, Fluid Mechanics, 20: torque on a rotating sphere",
        needs="the orientation of a body that rotates; the track of one point has none",
    ),
)
"""One entry for each effect, grouped by kind."""

LIMITS = {entry.name: entry.limits for entry in LIBRARY}
"""`Entry.limits` of each effect, by name."""
