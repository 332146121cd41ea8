"""Generated parts of the documentation: see ``make doc-pages``."""
