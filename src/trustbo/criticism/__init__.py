"""Criticism: what may be wrong with a fitted trust model."""

from trustbo.criticism.check import check

__all__ = ["check"]
__dir__ = __all__.copy  # completion lists public names alone
