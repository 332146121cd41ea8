"""Warning that charge trails hot pixels, as incomplete charge transfer leaves it."""

from pixcal.estimators.crosstalk.hot_pixels import hot_pixels_of
from pixcal.estimators.crosstalk.trails import LINKS, SURE, trails_of
from pixcal.report.text import with_error
from pixcal.stages.reduce.ingested import Ingested
from pixcal.storage.cube import ArrayReader
from pixcal.storage.place import Place

_SIDE = 512  # longest side of the middle of the detector that is looked at
_FULL = 0.9  # share of the converter's range that a hot pixel may fill


def trail_warnings(calibration: Place, source: Ingested, gain: float) -> list[str]:
    """One sentence if trails grow with the distance from an output; none otherwise."""
    seconds = max((group.exptime for group in source.exposures.dark), default=0.0)
    if not (source.exposures.has_rate and seconds > 0):
        return []
    (y0, y1), (x0, x1) = ((max(n - _SIDE, 0) // 2, (n + min(n, _SIDE)) // 2) for n in source.shape)
    rate, bias = (
        ArrayReader(calibration / name).read((y0, y1), (x0, x1)).astype(float)
        for name in ("dark_rate", "bias")
    )
    usable = bias + rate * seconds / gain < _FULL * source.saturation("dark")
    found = hot_pixels_of(rate * seconds, usable, LINKS)
    trails = None if found is None else trails_of(found, rate.shape, (y0, x0))
    middle = (y0 + y1) / 2, (x0 + x1) / 2
    said = [
        f"along {lines} that are read out towards the {'first' if one.output <= first else 'last'} "
        f"{line}, {with_error(*one.loss)} of {one.level_e:.0f} e- per transfer"
        for one, lines, line, first in zip(
            trails or (), ("columns", "rows"), ("row", "column"), middle, strict=False
        )
        if one.significance > SURE
    ]
    return [
        "charge trails hot pixels, the more the farther they are from the output, as incomplete "
        f"transfer leaves it (CTI): {'; '.join(said)}. It correlates the noise of neighbours too, "
        "which is not crosstalk"
    ] * bool(said)
