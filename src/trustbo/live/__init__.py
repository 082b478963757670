"""Campaigns in the field: contact tick by tick, a page, and a plan for the next bound."""

from trustbo.live.serving import serve
from trustbo.live.session import Live

__all__ = ["Live", "serve"]
__dir__ = __all__.copy  # completion lists public names alone
