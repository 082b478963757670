"""Result of a campaign as one HTML page, also while it runs."""

from trustbo.report.live import LivePage
from trustbo.report.page import write_report

__all__ = ["LivePage", "write_report"]
__dir__ = __all__.copy  # completion lists public names alone
