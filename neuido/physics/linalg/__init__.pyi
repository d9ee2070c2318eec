from .decompositions import Frame, frame, isotropic_map, isotropic_stress, polar, svd
from .nearest import nearest_by_pairs

__all__ = [
    "Frame",
    "frame",
    "isotropic_map",
    "isotropic_stress",
    "nearest_by_pairs",
    "polar",
    "svd",
]
