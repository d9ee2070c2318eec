"""Mechanics: laws, the material point method, colliders and effects. Knows torch and Warp, never Lightning."""
