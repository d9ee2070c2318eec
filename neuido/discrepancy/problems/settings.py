"""The settings of the discretisation: those whose differences are measured, and those of a search."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Setting:
    """One discretisation."""

    cells: float
    """Factor of the suggested number of cells."""
    dt: float
    """Factor of the suggested step."""
    solver: str = "material_points"
    """`material_points` or `finite_elements`."""
    elements: float = 1.0
    """Finite elements a particle."""
    tetrahedra: int = 5
    """Finite elements that a cell of the mesh's lattice is cut into."""
    lift: float = 0.0
    """Suggested cells by which the colliders and the grid are higher; see `CONTACT_HEIGHT`."""

    @property
    def name(self) -> str:
        """For the report."""
        parts = ["finite elements"] * (self.solver == "finite_elements") + [f"{self.elements:g} a particle"] * (self.elements != 1.0)
        parts += [f"{self.tetrahedra} a cell"] * (self.tetrahedra != 5)
        parts += [f"{self.cells:g} times the cells"] * (self.cells != 1.0) + [f"{self.dt:g} of the step"] * (self.dt != 1.0)
        parts += [f"colliders {self.lift:g} cells higher"] * (self.lift != 0.0)
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
"""Times the suggested step that a search moves material points with: the longest that leaves a margin."""
STEADY = 1.8
"""Margin that a longer step leaves where the model is declared, at the least, as a ratio: a step takes a wave through half a cell then."""
QUICK = tuple(Setting(cells, dt, lift=lift) for dt in LONGER for cells, lift in ((1.0, 0.0), (0.85, 0.0), (1.2, 0.0), (1.0, 0.5)))
EVERY = SETTINGS + QUICK
"""The settings by their numbers: those whose differences are measured, and those of a search."""
SOLVERS = tuple(next(i for i, s in enumerate(SETTINGS) if s.solver == name) for name in ("material_points", "finite_elements"))
"""The settings that are methods of their own."""
AFFORDED = 16
"""Times the inner steps of the declared model that finite elements may take: viscosities at the edge of their range ask for 70 to 360, and
of fits on a GPU, which share their launches, all wait for the slowest one."""
COARSE = SETTINGS.index(Setting(1.0, 1.0, "finite_elements", elements=0.6))
"""What finite elements are searched with."""
CONTACT_HEIGHT = "contact_height"
"""Name in a point: how much higher [m] than they are declared the colliders are, with the grid.

A body meets a plane of a grid at a layer of nodes, up to a cell from where the plane is declared, and two grids differ by that whatever
their cells; a real floor is where it was measured to be, more or less. A prediction moves the body instead, and what is seen of it back.
"""
