"""Bayesian optimisation of trustworthy paths for multi-robot bounding overwatch.

Implements Zheng, Smereka, Mikulski and Wang, "Bayesian Optimization Based Trustworthiness Model for
Multi-robot Bounding Overwatch" (2021). Names are loaded at first use; `__init__.pyi` lists them.
"""

import lazy_loader

import trustbo.forks  # noqa: F401  (notes forks from now on)

_getattr, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> object:
    if name == "__version__":
        from importlib.metadata import version

        return version("trustbo")

    from trustbo.display import announced
    from trustbo.errors import require_docstrings

    if not name.endswith("Error"):  # so that users can catch it
        require_docstrings()
    with announced(f"Loading libraries for trustbo.{name} (a few seconds)."):
        found = _getattr(name)
    globals()[name] = found  # the next use of the name does not come here
    return found
