"""Criticism: tests of a fitted trust model against what may be wrong with it."""

from trustbo.criticism.criticise import criticise

__all__ = ["criticise"]
__dir__ = __all__.copy  # completion lists public names alone
