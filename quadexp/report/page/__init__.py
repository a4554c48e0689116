"""The report of a comparison: one HTML file that opens without a network, and its figures as PDF."""

from quadexp.report.page.build import make_report

__all__ = ["make_report"]
