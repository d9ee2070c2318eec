"""Warp kernels of the material point method: the parts of a substep, and whole substeps of a particle."""
