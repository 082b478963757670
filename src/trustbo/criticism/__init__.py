"""Criticism: a check of a fitted trust model for possible problems."""

from trustbo.criticism.check import check

__all__ = ["check"]
__dir__ = __all__.copy  # tab completion lists only public names
