"""Figures and pages: the only importer of matplotlib and jinja2."""
