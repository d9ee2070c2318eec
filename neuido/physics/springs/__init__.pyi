from .mass_spring import MassSpring, Springs, connect

__all__ = [
    "MassSpring",
    "Springs",
    "connect",
]
