"""Evidence of the middle of a window, of fewer frames and pixels."""

from dataclasses import replace

import numpy as np

from pixcal.estimators.diagnosis.evidence import Evidence, FringeEvidence

# most samples of a set where each costs some hundred operations
MAX_SAMPLES = 1 << 21
MIN_SIZE = 32  # least pixels kept along each side, and least frames, if available


def central_crop(evidence: Evidence, samples: int = MAX_SAMPLES) -> Evidence:
    """Central pixels of a window, and first frames of very long sets, for costly estimates."""
    ny, nx = evidence.good.shape
    longest = max((len(f.g) for f in evidence.fringes.values()), default=1)
    shrink = min(1.0, float(np.sqrt(samples / (longest * ny * nx))))
    # Both ends lose the same, so coordinates relative to the centre stay right.
    cut_y, cut_x = (max(0, int((n - max(MIN_SIZE, n * shrink)) / 2)) for n in (ny, nx))
    rows, columns = slice(cut_y, ny - cut_y), slice(cut_x, nx - cut_x)
    frames = max(MIN_SIZE, samples // ((ny - 2 * cut_y) * (nx - 2 * cut_x)))
    if not cut_y and not cut_x and frames >= longest:
        return evidence
    return replace(
        evidence,
        fringes={
            name: _part(fringes, slice(0, frames), rows, columns)
            for name, fringes in evidence.fringes.items()
        },
        stacks=tuple(replace(s, adu=s.adu[:, rows, columns]) for s in evidence.stacks),
        origin=(evidence.origin[0] + cut_y, evidence.origin[1] + cut_x),
        **{n: getattr(evidence, n)[rows, columns] for n in ("bias", "dark_rate", "flat", "good")},
    )


def _part(fringes: FringeEvidence, frames: slice, rows: slice, columns: slice) -> FringeEvidence:
    of_frames = ("frame", "time_s", "g", "dk", "free", "free_covariance")
    of_pixels = ("theta", "sigma", "delta", "good", "read_variance", "shot_factor")
    return replace(
        fringes,
        origin=(fringes.origin[0] + rows.start, fringes.origin[1] + columns.start),
        electrons=fringes.electrons[frames, rows, columns],
        adu=fringes.adu[frames, rows, columns],
        **{name: getattr(fringes, name)[frames] for name in of_frames},
        **{name: getattr(fringes, name)[..., rows, columns] for name in of_pixels},
    )
