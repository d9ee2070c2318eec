"""The settings of a simulation (method, grid, step, mesh) that a diagnosis compares, and the cheaper ones that its search uses."""

from dataclasses import dataclass, replace


@dataclass(frozen=True)
class Setting:
    """One choice of method, grid, step and mesh."""

    cells: float
    """Factor on the suggested number of cells."""
    dt: float
    """Factor on the suggested time step."""
    solver: str = "material_points"
    """`material_points` or `finite_elements`."""
    elements: float = 1.0
    """Number of finite elements per particle."""
    tetrahedra: int = 5
    """Number of tetrahedra that each cell of the mesh's lattice is divided into."""
    lift: float = 0.0
    """Height by which colliders and grid are raised [suggested cells]; see `CONTACT_HEIGHT`."""
    share: float = 1.0
    """Share of the time of each recording that is simulated."""

    @property
    def name(self) -> str:
        """Name in the report."""
        parts = ["finite elements"] * (self.solver == "finite_elements") + [f"{self.elements:g} a particle"] * (self.elements != 1.0)
        parts += [f"{self.tetrahedra} a cell"] * (self.tetrahedra != 5)
        parts += [f"{self.cells:g} times the cells"] * (self.cells != 1.0) + [f"{self.dt:g} of the step"] * (self.dt != 1.0)
        parts += [f"colliders {self.lift:g} cells higher"] * (self.lift != 0.0)
        parts += [f"first {self.share:.0%} of the time"] * (self.share != 1.0)
        return ", ".join(parts) or "suggested"


SETTINGS = (
    Setting(1.0, 1.0),
    Setting(1.0, 0.5),
    Setting(0.85, 1.0),
    Setting(1.2, 0.5),
    Setting(1.0, 1.0, lift=0.5),
    Setting(1.0, 1.0, "finite_elements"),
    Setting(1.0, 1.0, "finite_elements", elements=0.6),
    Setting(1.0, 1.0, "finite_elements", tetrahedra=6),
)
LONGER = (4.0, 2.0)
"""Factors on the suggested time step of material points that a search tries, longest first."""
STEADY = 1.8
"""Least ratio of the stability limit to a longer time step, at the declared values. A wave then crosses half a cell in a step."""
QUICK = tuple(Setting(cells, dt, lift=lift) for dt in LONGER for cells, lift in ((1.0, 0.0), (0.85, 0.0), (1.2, 0.0), (1.0, 0.5)))
WHOLE = SETTINGS + QUICK
"""The settings that simulate all of a recording. First those that are compared, then those of the search."""
SHARES = (0.25, 0.4, 0.6, 0.8)
"""Shares of the time of a recording after which a simulation may end (`Problem.early`)."""
EVERY = WHOLE + tuple(replace(s, share=share) for share in SHARES for s in WHOLE)
"""All settings; the number of a setting is its place here."""
SOLVERS = tuple(next(i for i, s in enumerate(SETTINGS) if s.solver == name) for name in ("material_points", "finite_elements"))
"""Number of the setting that stands for each simulation method."""
AFFORDED = 16
"""Largest factor on the inner steps that finite elements need for the declared model.

Viscosities at the edge of their range would need a factor of 70 to 360, and fits that share a launch on a GPU all wait for the slowest.
"""
COARSE = SETTINGS.index(Setting(1.0, 1.0, "finite_elements", elements=0.6))
"""Setting with which finite elements are searched: a coarser mesh."""
CONTACT_HEIGHT = "contact_height"
"""Name of a parameter: height of the colliders and the grid above their declared place [m].

On a grid, a body meets a plane at a layer of nodes, up to one cell from the declared plane, and grids differ by that. The place of a real
floor is known only to a measurement error. A simulation lowers the body instead, and raises the predicted positions again.
"""


def whole(setting: int) -> int:
    """Return the setting that simulates all of what an early one (`Setting.share`) begins."""
    return setting % len(WHOLE)


def early(setting: int, share: float) -> int:
    """Return the setting that simulates the least of a recording that has this share of its time."""
    return next((setting + (1 + k) * len(WHOLE) for k, own in enumerate(SHARES) if own >= share), setting)
