"""Results of runs: labelled datasets, metrics, comparisons, figures and exports.

Imports theory, control (for names and features) and `mrctl.scenario`, but neither physics nor the loop.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, submodules=["plots"])  # imports matplotlib on use
