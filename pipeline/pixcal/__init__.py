"""Maps of pixel response offsets from Young's fringes.

What a notebook or a program needs is here, from `pixcal.api`: the commands as functions, runs
opened as arrays, and `calibrate`, from arrays to maps.
"""

from importlib import import_module
from importlib.metadata import version
from typing import Any

__version__ = version("pixcal")

__all__ = [
    "FringeSet",
    "InputError",
    "OffsetMap",
    "Picture",
    "PixcalError",
    "PixelFlag",
    "Run",
    "Runtime",
    "__version__",
    "allan",
    "astrometry",
    "budget",
    "calibrate",
    "compare",
    "correct_centroids",
    "crests",
    "diagnose",
    "distortion_wcs",
    "fit",
    "ingest",
    "open_run",
    "reduce",
    "run",
    "sample_acquisition",
    "simulate",
    "write_report",
]


def __getattr__(name: str) -> Any:
    # Loaded with its first use: `import pixcal` and the command line stay quick.
    if name in __all__:
        return getattr(import_module("pixcal.api"), name)
    raise AttributeError(f"module 'pixcal' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
