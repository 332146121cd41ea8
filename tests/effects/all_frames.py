"""All frames of a recording."""

from collections.abc import Sequence

import numpy as np

from pixcal.kernels.synthesis import BLOCK_ROWS
from pixcal.model.arrays import U16
from pixcal.model.bench import Bench
from pixcal.simulation.exposure import Camera
from pixcal.simulation.forward import ForwardModel
from pixcal.simulation.recording import Recording


def frames_of(bench: Bench, recording: Recording, effects: Sequence[ForwardModel] = ()) -> U16:
    """All frames (time, y, x) of a recording, in memory."""
    out = np.empty((recording.count, *bench.detector.shape), np.uint16)
    for first in range(0, out.shape[1], BLOCK_ROWS):
        rows = (first, min(first + BLOCK_ROWS, out.shape[1]))
        camera = Camera(bench, rows, effects)
        for frame, samples in camera.expose(recording, range(recording.count)):
            out[frame, slice(*rows)] = samples
    return out
