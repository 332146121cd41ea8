"""Several changes at once."""

from second_bench.sensors.model import Drawn, Sensor, kind
from second_bench.sensors.pixels import coupling, defects, nonlinearity, pattern
from second_bench.sensors.readout import row_pairs


@kind(highest=1.35)
def harmless(sensor: Sensor) -> Drawn:
    """Hot, dead and noisy pixels, a fixed pattern, saturated flats and a steep dark signal."""
    return defects(sensor) | pattern(sensor)


@kind("nonlinearity", highest=1.35)
def bent_harmless(sensor: Sensor) -> Drawn:
    """The same with a response that bends."""
    return nonlinearity(sensor) | harmless(sensor)


@kind("row_noise + ipc brighter_fatter")
def rows_and_coupling(sensor: Sensor) -> Drawn:
    """Noise of rows that every second row shares, and a coupling that grows with the level."""
    return row_pairs(sensor) | coupling(sensor)
