"""Result of a campaign as one HTML page."""

from trustbo.report.page import write_report

__all__ = ["write_report"]
