"""Figures. All functions except `explore` accept `ax` and return the axes.

Modules are imported on first use, so that maps of a terrain do not import JAX.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
