"""The comparison of Sun et al. 2022: tables and a figure of a sweep, beside what is printed."""

from quadexp.plugins.papers.sun.report import draw, overview

__all__ = ["draw", "overview"]
