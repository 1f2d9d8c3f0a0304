"""A physics testbed for adaptive control of a car-like robot.

The public names are listed in `__init__.pyi` and loaded when they are first used, so that `import mrctl` is quick.
"""

import lazy_loader

__version__ = "0.42.0"
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
