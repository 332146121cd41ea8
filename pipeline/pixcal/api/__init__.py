"""For notebooks and programs: the commands as functions, runs as arrays, from arrays to maps.

The public names are those of `pixcal` itself.
"""

from typing import Any

import pixcal


def __getattr__(name: str) -> Any:
    if name in pixcal.__all__:
        return getattr(pixcal, name)
    raise AttributeError(f"module 'pixcal.api' has no attribute {name!r}")
