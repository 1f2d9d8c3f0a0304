"""A physics testbed for adaptive control of a car-like robot.

The public names are listed in `__init__.pyi` and loaded when they are first used, so that `import mrctl` is quick.
"""

import contextlib
import importlib
import os

import lazy_loader

if os.environ.get("MUJOCO_GL") in ("egl", "osmesa"):
    # Where there is no GPU, Mesa draws. Triton, which torch with CUDA imports at the first optimizer, crashes the
    # process if it is loaded after Mesa, because both contain LLVM.
    with contextlib.suppress(ImportError):
        importlib.import_module("triton")

__version__ = "0.51.0"
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
