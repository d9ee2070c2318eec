"""Decompositions of 3x3 matrices with derivatives that are valid at repeated singular values, and nearest points."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
