"""A campaign's result as one page to read."""

from trustbo.report.page import write_report

__all__ = ["write_report"]
