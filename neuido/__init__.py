"""neuido: differentiable mechanics, material laws from video, and the effects that a model lacks.

The public names stand in `__init__.pyi`; each is imported at its first use, so that `import neuido` loads neither torch nor lightning.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
