"""Cameras without fringes: bias, dark and flat frames of a sensor with a known truth.

Plain numpy, frame by frame; gain, depth of the converter, level of the bias, ladder of flats and
counts of frames are drawn for every seed::

    python -m second_bench.sensors nonlinearity --seed 3 --out acq --truth truth.json
    python -m second_bench.sensors --list

``acquisition.yaml`` declares neither saturation nor full well.
"""

from second_bench.sensors import light, pixels, readout, several
from second_bench.sensors.making import make, write
from second_bench.sensors.model import KINDS

__all__ = ["KINDS", "light", "make", "pixels", "readout", "several", "write"]
