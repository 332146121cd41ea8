"""What is generated in the documentation: see ``make doc-pages``."""
