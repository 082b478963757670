"""Result of a campaign as one HTML page."""

from trustbo.report.page import write_report

__all__ = ["write_report"]
__dir__ = __all__.copy  # completion lists public names alone
