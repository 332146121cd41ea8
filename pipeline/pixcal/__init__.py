"""Maps of pixel response offsets from Young's fringes."""

from importlib.metadata import version

__version__ = version("pixcal")
