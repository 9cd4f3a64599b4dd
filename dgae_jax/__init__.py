"""Generalized advantage estimation for distributional policy gradients, end to end in JAX.

The public names are listed in `__init__.pyi` and imported when they are first used, so that a
command line is checked before JAX is loaded.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

__version__ = "0.1.0"
