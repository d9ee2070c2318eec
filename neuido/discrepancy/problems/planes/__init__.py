"""Plane specimens as a problem: predictions by quasi-static finite elements, candidates, and noise."""
