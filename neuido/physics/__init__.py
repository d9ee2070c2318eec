"""Mechanics: laws, effects, the material point method, finite elements, springs and point masses. Knows torch and Warp, never Lightning."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
