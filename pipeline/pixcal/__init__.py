"""Maps of pixel response offsets from Young's fringes.

What a notebook or a program needs is here: the commands as functions, runs opened as arrays, and
`calibrate`, from arrays to maps.
"""

from importlib import import_module
from importlib.metadata import version
from typing import Any

__version__ = version("pixcal")

# the public names by the module that holds them, which is loaded with their first use.
# ``__init__.pyi`` is written from it, for type checkers and editors, by ``make doc-pages``.
_HOMES = {
    "api.arrays": ("calibrate",),
    "api.centroids": ("correct_centroids", "distortion_wcs"),
    "api.commands": (
        *("run", "ingest", "reduce", "fit", "allan", "crests", "diagnose", "astrometry"),
        *("write_report", "compare", "simulate", "budget"),
    ),
    "api.electrons": ("to_electrons",),
    "api.offset_map": ("OffsetMap", "Picture"),
    "api.opened": ("FringeSet", "Run", "open_run"),
    "api.sample": ("sample_acquisition",),
    "engine.run": ("Runtime",),
    "model.errors": ("InputError", "PixcalError"),
    "model.flags": ("PixelFlag",),
}

__all__ = sorted(["__version__", *(name for names in _HOMES.values() for name in names)])


def __getattr__(name: str) -> Any:
    for home, names in _HOMES.items():
        if name in names:
            return getattr(import_module(f"pixcal.{home}"), name)
    raise AttributeError(f"module 'pixcal' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
