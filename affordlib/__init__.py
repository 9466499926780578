"""Learned affordances and planning with partial actions: the package behind the workbook."""

__version__ = "0.1.0"
