"""Physical effects beside a material law: forces, dissipation, inhomogeneity; each is a parameter that is zero when absent."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
