"""Finite elements: explicit ones of moving bodies, and quasi-static ones of flat specimens."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
