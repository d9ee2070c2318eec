"""Generate test cases: measured data whose declared model lacks an effect, with a sealed key that names the effect."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
