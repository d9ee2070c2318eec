"""The figures of a model that a folder may set free, with their units, typical steps and physical ranges."""

from typing import NamedTuple

from neuido.discrepancy.problem import Parameter


class Figure(NamedTuple):
    """How a fit moves a declared figure."""

    unit: str
    step: float
    """A typical step: relative where `log`, else in the unit."""
    lower: float
    upper: float
    log: bool


FIGURES = {
    "young": Figure("Pa", 0.1, 1e2, 1e13, True),
    "poisson": Figure("1", 0.03, -0.9, 0.4999, False),
    "density": Figure("kg/m^3", 0.05, 1.0, 3e4, True),
    "yield_stress": Figure("Pa", 0.1, 1e-2, 1e12, True),
    "stiffness": Figure("1", 0.1, 1e-3, 1e3, True),
    "friction_angle": Figure("degrees", 2.0, 1.0, 80.0, False),
}


def declared(name: str, value: float, *, within: tuple[float, float] | None = None) -> Parameter:
    """The parameter of a figure at its declared value; `within`: a narrower range, where a simulator needs one."""
    figure = FIGURES[name]
    lower, upper = within or (figure.lower, figure.upper)
    return Parameter(name, figure.unit, float(value), figure.step, lower, upper, log=figure.log)
