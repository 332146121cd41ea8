"""Colours of the figures: perceptually uniform, and safe for the colour-blind."""

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import ListedColormap, to_rgb

from pixcal.model.arrays import F64

LEVELS = 81  # steps of a colour scale: all scales together fit the 256 colours of a small PNG

# where there is no value
MASKED = "#9b9b9b"

INK = "#1d2733"
BLUE = "#2667b0"
RED = "#c1431f"
GREEN = "#1b8a5a"
GREY = "#7d8896"
LINES = (BLUE, RED, GREEN, INK)  # one for each map or set in the same axes
# bars of histograms
BAR = "#b9cbe4"
# range expected by chance
BAND = "#dfe3e9"
UNFLAGGED = "#eef1f5"
SEVERAL = "#000080"

# the fringe frequencies of each set, on the spectrum and on paper
MARKS = ("#ff3d1f", "#ff3dc8", "#00a7e1", "#39c24a")

# one colour for each bit of the flags
FLAGS = {
    1: "#d7301f",
    2: "#54278f",
    4: "#fdae33",
    8: "#1f9ed1",
    16: "#e377c2",
    32: "#111111",
    64: "#2ca25f",
    128: "#8c510a",
}


def _sampled(name: str) -> F64:
    return np.asarray(colormaps[name](np.linspace(0, 1, LEVELS)))[:, :3]


_DIVERGING = _sampled("RdBu_r")
_SEQUENTIAL = _sampled("viridis")

DIVERGING = ListedColormap(_DIVERGING, name="pixcal_diverging").with_extremes(bad=MASKED)
SEQUENTIAL = ListedColormap(_SEQUENTIAL, name="pixcal_sequential").with_extremes(bad=MASKED)


def _tints(colour: str, number: int) -> F64:
    """From the colour to white, without white."""
    strength = np.linspace(1, 0, number, endpoint=False)[:, None]
    return np.asarray(strength * np.array(to_rgb(colour)) + (1 - strength))


def _palette() -> bytes:
    """Every colour that the figures use, edges of lines and letters included, as RGB bytes."""
    solid = [to_rgb(c) for c in (*FLAGS.values(), *MARKS, SEVERAL, UNFLAGGED, MASKED, BAR, BAND)]
    parts = [
        _DIVERGING,
        _SEQUENTIAL,
        _tints("#000000", 18),
        _tints(INK, 8),
        _tints(BLUE, 12),
        _tints(RED, 12),
        _tints(GREEN, 8),
        _tints(GREY, 6),
        solid,
        [(1, 1, 1)],
    ]
    colours = np.rint(255 * np.concatenate([np.asarray(p) for p in parts])).astype(np.uint8)
    assert len(colours) <= 256
    return bytes(colours)


PALETTE = _palette()
