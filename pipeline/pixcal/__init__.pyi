# What `pixcal` gives, for type checkers and editors: written by `make doc-pages`.
import collections.abc
import os
import pathlib
import typing
from typing import Literal

import pixcal.api.opened
import pixcal.engine.run
from pixcal.api.arrays import calibrate as calibrate
from pixcal.api.centroids import correct_centroids as correct_centroids
from pixcal.api.centroids import distortion_wcs as distortion_wcs
from pixcal.api.electrons import to_electrons as to_electrons
from pixcal.api.offset_map import OffsetMap as OffsetMap
from pixcal.api.offset_map import Picture as Picture
from pixcal.api.opened import FringeSet as FringeSet
from pixcal.api.opened import Run as Run
from pixcal.api.opened import open_run as open_run
from pixcal.api.sample import sample_acquisition as sample_acquisition
from pixcal.engine.run import Runtime as Runtime
from pixcal.model.errors import InputError as InputError
from pixcal.model.errors import PixcalError as PixcalError
from pixcal.model.flags import PixelFlag as PixelFlag

__version__: str
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
    "to_electrons",
    "write_report",
]

def allan(
    run: str | os.PathLike[str],
    *,
    region: tuple[int, int, int, int] | None = None,
    regions: collections.abc.Sequence[tuple[int, int, int, int]] = (),
    runtime: pixcal.engine.run.Runtime | None = None,
) -> pixcal.api.opened.Run:
    """Measure the Allan deviation: error against number of frames.

    Parameters
    ----------
    run : Run, str or path
        A run directory.
    region : tuple[int, int, int, int], optional
        Limits (y0, y1, x0, x1) of the main curve, ends excluded.
    regions : Sequence[tuple[int, int, int, int]]
        Rectangle with its own Allan curve, ends excluded; repeatable.
    runtime : Runtime, optional
        Where and with how much memory tasks run.

    Raises
    ------
    InputError
        If the run was not fitted, or a region is not inside its window.
    """

def astrometry(
    run: str | os.PathLike[str],
    *,
    truth: str | os.PathLike[str] | None = None,
    diameter_m: float = 7.0,
    focal_length_m: float = 130.0,
    wavelength_nm: float = 600.0,
    obscuration: float = 0.0,
    electrons: float = 100000000.0,
    background_e: float = 0.0,
    window: int | None = None,
    stars: int = 1000,
    positions: int = 16,
    dither_px: float = 32.0,
    seed: int = 0,
    runtime: pixcal.engine.run.Runtime | None = None,
) -> dict[str, typing.Any]:
    """Estimate how much the maps improve star centroids.

    Simulated stars are fitted twice: on a perfect grid and with the measured maps. The default
    telescope is that of the habitable worlds mission, 7 m and 130 m.

    Parameters
    ----------
    run : Run, str or path
        A run directory.
    truth : str or path, optional
        True offsets of a simulated detector (ACQ-truth).
    diameter_m : float
        Diameter of the telescope, m.
    focal_length_m : float
        Focal length of the telescope, m.
    wavelength_nm : float
        Wavelength of the star light, nm.
    obscuration : float
        Central obscuration as a fraction of the diameter.
    electrons : float
        Photo-electrons of a star at each position, over all exposures.
    background_e : float
        Background per pixel and position, electrons.
    window : int, optional
        Side of the fit window, an odd number.
    stars : int
        Number of stars, at random places on the detector.
    positions : int
        Number of positions of each star to average.
    dither_px : float
        Largest dither from the first position, along x and y.
    seed : int
        Random seed.
    runtime : Runtime, optional
        Where and with how much memory tasks run.

    Returns
    -------
    dict
        Contents of ``astrometry.json``.

    Raises
    ------
    InputError
        If the run was not fitted, or the truth is not that of this detector.
    """

def budget(
    bench: str | os.PathLike[str],
    *,
    precision_px: float | None = None,
    frames: int | None = None,
    out: str | os.PathLike[str] | None = None,
) -> dict[str, typing.Any]:
    """Plan the frames and hours needed for a given precision.

    BENCH.yaml describes a bench as for `pixcal simulate`. The numbers are the Cramér-Rao bound: no
    unbiased estimate needs fewer frames. The fit comes within a few percent of it.

    Parameters
    ----------
    bench : str or path
        Bench file (schema ``pixcal/bench/1``).
    precision_px : float, optional
        Wanted 1-sigma error of the offsets on each axis.
    frames : int, optional
        Frames of each fringe set; prints the precision that they reach.
    out : str or path
        Directory of the results; created if missing.

    Returns
    -------
    dict
        Contents of ``budget.json``, which is also written to ``out`` with ``budget.png``.

    Raises
    ------
    InputError
        If the bench cannot be read, or its frames determine nothing.
    """

def compare(
    runs: collections.abc.Sequence[str | os.PathLike[str]],
    out: str | os.PathLike[str],
    *,
    split: Literal['halves', 'odd-even'] = 'halves',
    sigma_accuracy: float = 0.02,
    runtime: pixcal.engine.run.Runtime | None = None,
) -> dict[str, typing.Any]:
    """Compare maps of the same pixels, scale by scale.

    Give two or more fitted runs of the same window, or one run to compare with itself.

    Parameters
    ----------
    runs : sequence of Run, str or path
        Fitted runs; one alone is compared with itself.
    out : str or path
        Directory of the results; created if missing.
    split : {"halves", "odd-even"}
        How to split a single run: first and second half, or alternating batches.
    sigma_accuracy : float
        Relative error of SIGMA to tolerate.
    runtime : Runtime, optional
        Where and with how much memory tasks run.

    Returns
    -------
    dict
        Contents of ``compare.json``; pictures are beside it in ``out``.

    Raises
    ------
    InputError
        If a run was not fitted, or the windows differ.
    """

def crests(
    run: str | os.PathLike[str],
    *,
    frames: int = 8,
    paths: int | None = None,
    segment: int | None = None,
    runtime: pixcal.engine.run.Runtime | None = None,
) -> dict[str, typing.Any]:
    """Check the fit: locate the fibres from crests and valleys.

    Parameters
    ----------
    run : Run, str or path
        A run directory.
    frames : int
        Number of frames to use, spread over the run.
    paths : int, optional
        Number of outermost crests and valleys to use at each end.
    segment : int, optional
        Length of fringe that gives one point.
    runtime : Runtime, optional
        Where and with how much memory tasks run.

    Returns
    -------
    dict
        Contents of ``crests.json``.

    Raises
    ------
    InputError
        If the run was not reduced, or a set has too few fringes.
    """

def diagnose(
    run: str | os.PathLike[str],
    *,
    only: collections.abc.Sequence[str] = (),
    without: collections.abc.Sequence[str] = (),
    own: collections.abc.Sequence[str | os.PathLike[str]] = (),
    nominal: str | os.PathLike[str] | None = None,
    runtime: pixcal.engine.run.Runtime | None = None,
) -> dict[str, typing.Any]:
    """Find which effects make the frames differ from a simulation.

    Parameters
    ----------
    run : Run, str or path
        A run directory.
    only : Sequence[str]
        The only candidates.
    without : Sequence[str]
        Effects to leave out.
    own : Sequence[str | os.PathLike[str]]
        Python file with your own effect; repeatable.
    nominal : str or path, optional
        Bench file whose effects belong to the nominal simulation.
    runtime : Runtime, optional
        Where and with how much memory tasks run.

    Returns
    -------
    dict
        Contents of ``diagnosis.json``.

    Raises
    ------
    InputError
        If the run was not reduced, or an effect is not known.
    """

def fit(
    run: str | os.PathLike[str],
    *,
    batch_frames: int | None = None,
    chi2_limit: float = 1.5,
    model: str = 'auto',
    with_diagnosis: bool = False,
    own: collections.abc.Sequence[str | os.PathLike[str]] = (),
    runtime: pixcal.engine.run.Runtime | None = None,
) -> pixcal.api.opened.Run:
    """Fit the fringes and write the maps of pixel offsets.

    Parameters
    ----------
    run : Run, str or path
        A run directory.
    batch_frames : int, optional
        Frames of an Allan batch; 500, or fewer in a short run.
    chi2_limit : float
        Reduced chi-square above which a pixel is ``BAD_FIT``.
    model : str
        Shape of the fringes: hyperbolic, straight (paraxial), or chosen from the data.
    with_diagnosis : bool
        Also write maps corrected for the effects that 'pixcal diagnose' found.
    own : Sequence[str | os.PathLike[str]]
        Python file of your own effect that the diagnosis found; repeatable.
    runtime : Runtime, optional
        Where and with how much memory tasks run.

    Raises
    ------
    InputError
        If the run was not reduced, was not diagnosed (for ``with_diagnosis``), or holds no fringes that can be fitted.
    """

def ingest(
    acquisition: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    overwrite: bool = False,
    copy: bool = False,
    cubes: str | os.PathLike[str] | None = None,
    runtime: pixcal.engine.run.Runtime | None = None,
) -> pixcal.api.opened.Run:
    """Check and catalogue every frame of an acquisition.

    An acquisition is a directory ACQ with acquisition.yaml and its frames. Later steps read these
    files where they are; only compressed ones are copied into cubes.

    Parameters
    ----------
    acquisition : str or path
        Directory with ``acquisition.yaml``.
    out : str or path
        Directory of the results; created if missing.
    overwrite : bool
        Replace the ingested frames of another acquisition.
    copy : bool
        Copy all samples into RUN, so that later steps do not need ACQ.
    cubes : str or path, optional
        Where to put the large cubes: a folder, a URL (s3://bucket/prefix), or RUN. [default: the place used before, else RUN]
    runtime : Runtime, optional
        Where and with how much memory tasks run.

    Raises
    ------
    InputError
        If a file, key or option is wrong.
    """

def reduce(
    run: str | os.PathLike[str],
    *,
    gain: Literal['declared', 'measured'] = 'declared',
    clip_sigma: float = 4.0,
    hot_sigma: float = 10.0,
    dead_below: float = 0.5,
    dead_above: float = 2.0,
    noisy_factor: float = 1.5,
    nonlinear_share: float = 0.03,
    rounding_share: float = 0.001,
    cubes: str | os.PathLike[str] | None = None,
    runtime: pixcal.engine.run.Runtime | None = None,
) -> pixcal.api.opened.Run:
    """Measure the detector and write the fringes in electrons.

    Bias, dark, flat, gain, read noise and bad pixels come from the detector frames; the fringe
    frames become cubes in electrons.

    Parameters
    ----------
    run : Run, str or path
        A run directory.
    gain : {"declared", "measured"}
        Gain to use: declared in acquisition.yaml or measured from the flats.
    clip_sigma : float
        Clipping of calibration frames, robust sigmas.
    hot_sigma : float
        Dark signal of ``HOT`` pixels, robust sigmas above the median.
    dead_below : float
        Response relative to the neighbours below which a pixel is ``DEAD``.
    dead_above : float
        Response relative to the neighbours above which a pixel is ``DEAD``.
    noisy_factor : float
        Noise relative to the typical noise above which a pixel is ``NOISY``.
    nonlinear_share : float
        Deviation from a straight line above which a pixel is ``NONLINEAR``.
    rounding_share : float
        Largest share of the variance that rounding may add.
    cubes : str or path, optional
        Where to put the large cubes: a folder, a URL (s3://bucket/prefix), or RUN. [default: the place used before, else RUN]
    runtime : Runtime, optional
        Where and with how much memory tasks run.

    Raises
    ------
    InputError
        If the run was not ingested, or its gain is to be measured and cannot be.
    """

def run(
    acquisition: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    overwrite: bool = False,
    copy: bool = False,
    gain: Literal['declared', 'measured'] = 'declared',
    model: str = 'auto',
    cubes: str | os.PathLike[str] | None = None,
    diagnosed: bool = True,
    runtime: pixcal.engine.run.Runtime | None = None,
) -> pixcal.api.opened.Run:
    """Run all steps: from frames to corrected maps and a report.

    Parameters
    ----------
    acquisition : str or path
        Directory with ``acquisition.yaml``.
    out : str or path
        Directory of the results; created if missing.
    overwrite : bool
        Replace the ingested frames of another acquisition.
    copy : bool
        Copy all samples into RUN, so that later steps do not need ACQ.
    gain : {"declared", "measured"}
        Gain to use: declared in acquisition.yaml or measured from the flats.
    model : str
        Shape of the fringes: hyperbolic, straight (paraxial), or chosen from the data.
    cubes : str or path, optional
        Where to put the large cubes: a folder, a URL (s3://bucket/prefix), or RUN. [default: the place used before, else RUN]
    diagnosed : bool
        Find the effects that make the frames differ from a simulation (the longest step).
    runtime : Runtime, optional
        Where and with how much memory tasks run.

    Returns
    -------
    Run
        Without fringes in the acquisition, it holds only the measurements of the detector.

    Raises
    ------
    InputError
        If a file, key or option is wrong. A diagnosis or correction that is not possible is a warning.
    """

def simulate(
    bench: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    truth: str | os.PathLike[str] | None = None,
    own: collections.abc.Sequence[str | os.PathLike[str]] = (),
    runtime: pixcal.engine.run.Runtime | None = None,
) -> pathlib.Path:
    """Simulate a bench and write an acquisition.

    BENCH.yaml describes detector, optics and frames. The acquisition holds the FITS files that the
    camera of the bench would have written; its truth goes to a separate directory.

    Parameters
    ----------
    bench : str or path
        Bench file (schema ``pixcal/bench/1``).
    out : str or path
        Directory of the results; created if missing.
    truth : str or path, optional
        Directory of the truth.
    own : Sequence[str | os.PathLike[str]]
        Python file with your own effect that BENCH.yaml names; repeatable.
    runtime : Runtime, optional
        Where and with how much memory tasks run.

    Returns
    -------
    Path
        The acquisition.

    Raises
    ------
    InputError
        If the bench is wrong, or a directory holds files that simulate did not write.
    """

def write_report(
    run: str | os.PathLike[str],
    *,
    runtime: pixcal.engine.run.Runtime | None = None,
) -> pixcal.api.opened.Run:
    """Write the report of a run, one self-contained HTML page.

    Parameters
    ----------
    run : Run, str or path
        A run directory.
    runtime : Runtime, optional
        Where and with how much memory tasks run.

    Returns
    -------
    Run
        Its ``report`` is the page.

    Raises
    ------
    InputError
        If the run was not reduced.
    """
