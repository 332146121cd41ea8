"""Every command and its options, defined once: type, range, default, unit and meaning.

The command line, the functions of `pixcal.api` and the stages take them from here. The docstring of
a class is the help text of its command. An option has the name of its field; the command line omits
the unit (``--diameter`` is ``diameter_m``). In addition to the metadata of
`pixcal.model.config.quantity`, a field may have

- ``in_key``: false if the result does not depend on it;
- ``python_only``: true if the command line does not offer it;
- ``metavar``, ``flag``, ``shown``: its value, its name, and a default of None in the help.
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

from pixcal.model.config import StrPath, as_in, quantity
from pixcal.model.errors import InputError

# limits (y0, y1, x0, x1) of a rectangle of pixels, ends excluded
Region = tuple[int, int, int, int]

MAX_ELECTRONS = 1e15  # limit of the Poisson generator
FWHMS = (0.5, 50.0)  # widths of stars, px


def python_only_option(default: Any, **meaning: Any) -> Any:
    """An option of the Python function that the command line does not offer."""
    return quantity(default, python_only=True, **meaning)


_factor = partial(python_only_option, low=1, high=1e6)


def _own(doc: str, *, in_key: bool = True) -> Any:
    return quantity((), doc=f"{doc}; repeatable.", metavar="FILE", in_key=in_key)


@dataclass(frozen=True)
class Running:
    """How a command runs; no result depends on it."""

    cluster: str = quantity("threads", metavar="threads|processes|sync|tcp://…")
    """Run tasks here, or on the Dask cluster at this address."""
    workers: int = quantity(0, low=0, high=4096, shown="all cores")
    """Parallel tasks; 0 is one per core."""
    memory: int = quantity(2 << 30, unit="bytes", metavar="SIZE", shown="2GiB")
    """Memory limit; work that needs more is refused."""
    quiet: bool = python_only_option(True)
    """No progress on stderr."""


@dataclass(frozen=True)
class Ingest:
    """Check and catalogue every frame of an acquisition.

    An acquisition is a directory ACQ with acquisition.yaml and its frames. Later steps read these
    files where they are; only compressed ones are copied into cubes.
    """

    overwrite: bool = quantity(False, in_key=False)
    """Replace the ingested frames of another acquisition."""
    copy: bool = quantity(False, in_key=False)
    """Copy all samples into RUN, so that later steps do not need ACQ."""
    cubes: StrPath | None = quantity(None, metavar="PLACE", in_key=False)
    """Where to put the large cubes: a folder, a URL (s3://bucket/prefix), or RUN. [default: the
    place used before, else RUN]"""


@dataclass(frozen=True)
class Reduce:
    """Measure the detector and write the fringes in electrons.

    Bias, dark, flat, gain, read noise and bad pixels come from the detector frames; the fringe
    frames become cubes in electrons.
    """

    gain: Literal["declared", "measured"] = quantity("declared")
    """Gain to use: declared in acquisition.yaml or measured from the flats."""
    clip_sigma: float = python_only_option(4.0, low=4, high=100)
    """Clipping of calibration frames, robust sigmas."""
    hot_sigma: float = python_only_option(10.0, low=5, high=1e6)
    """Dark signal of ``HOT`` pixels, robust sigmas above the median."""
    dead_below: float = python_only_option(0.5, low=0, high=1)
    """Response relative to the neighbours below which a pixel is ``DEAD``."""
    dead_above: float = _factor(2.0)
    """Response relative to the neighbours above which a pixel is ``DEAD``."""
    noisy_factor: float = _factor(1.5)
    """Noise relative to the typical noise above which a pixel is ``NOISY``."""
    nonlinear_share: float = python_only_option(0.03, above=0, high=1e6)
    """Deviation from a straight line above which a pixel is ``NONLINEAR``."""
    rounding_share: float = python_only_option(1e-3, above=0, high=1)
    """Largest share of the variance that rounding may add."""
    cubes: StrPath | None = as_in(Ingest, "cubes")


@dataclass(frozen=True)
class Sweep:
    """Options of the pass over the cube, a part of ``fit``."""

    batch_frames: int | None = python_only_option(None, low=4, unit="frames")
    """Frames of an Allan batch; 500, or fewer in a short run."""
    chi2_limit: float = python_only_option(1.5, above=1.0)
    """Reduced chi-square above which a pixel is ``BAD_FIT``."""


@dataclass(frozen=True)
class Fit(Sweep):
    """Fit the fringes and write the maps of pixel offsets."""

    model: str = quantity("auto", choices=("auto", "hyperbolic", "paraxial"))
    """Shape of the fringes: hyperbolic, straight (paraxial), or chosen from the data."""
    with_diagnosis: bool = quantity(False, in_key=False)
    """Also write maps corrected for the effects that 'pixcal diagnose' found."""
    own: tuple[Path, ...] = _own(
        "Python file of your own effect that the diagnosis found", in_key=False
    )

    def __post_init__(self) -> None:
        if self.own and not self.with_diagnosis:
            raise InputError("--own: only used with --with-diagnosis; give both")


@dataclass(frozen=True)
class Allan:
    """Measure the Allan deviation: error against number of frames."""

    region: Region | None = python_only_option(None, unit="px", low=0)
    """Limits (y0, y1, x0, x1) of the main curve, ends excluded."""
    regions: tuple[Region, ...] = quantity(
        (), unit="px", low=0, flag="--region", metavar="y0:y1,x0:x1"
    )
    """Rectangle with its own Allan curve, ends excluded; repeatable."""


@dataclass(frozen=True)
class Crests:
    """Check the fit: locate the fibres from crests and valleys."""

    frames: int = quantity(8, low=1, metavar="N")
    """Number of frames to use, spread over the run."""
    paths: int | None = quantity(None, low=2, shown="all")
    """Number of outermost crests and valleys to use at each end."""
    segment: int | None = quantity(
        None, low=4, unit="px", shown="an eighth of the window, 8 to 128"
    )
    """Length of fringe that gives one point."""


@dataclass(frozen=True)
class Diagnose:
    """Find which effects make the frames differ from a simulation."""

    only: tuple[str, ...] = python_only_option((), doc="The only candidates.")
    without: tuple[str, ...] = python_only_option((), doc="Effects to leave out.")
    own: tuple[Path, ...] = _own("Python file with your own effect")
    nominal: Path | None = quantity(
        None, metavar="BENCH.yaml", doc="Bench file whose effects belong to the nominal simulation."
    )


@dataclass(frozen=True)
class Astrometry:
    """Estimate how much the maps improve star centroids.

    Simulated stars are fitted twice: on a perfect grid and with the measured maps. The default
    telescope is that of the habitable worlds mission, 7 m and 130 m.
    """

    truth: Path | None = quantity(
        None, metavar="DIR", shown="the maps plus random errors of size SIGMA"
    )
    """True offsets of a simulated detector (ACQ-truth)."""
    diameter_m: float = quantity(7.0, unit="m", above=0)
    """Diameter of the telescope, m."""
    focal_length_m: float = quantity(130.0, unit="m", above=0)
    """Focal length of the telescope, m."""
    wavelength_nm: float = quantity(600.0, unit="nm", above=0)
    """Wavelength of the star light, nm."""
    obscuration: float = quantity(0.0, low=0, high=0.9, metavar="E")
    """Central obscuration as a fraction of the diameter."""
    electrons: float = quantity(1e8, unit="e-", above=0, metavar="N", shown="1e8")
    """Photo-electrons of a star at each position, over all exposures."""
    background_e: float = quantity(0.0, unit="e-", low=0, metavar="N")
    """Background per pixel and position, electrons."""
    window: int | None = quantity(None, unit="px", low=3, high=255, shown="8 λ/D")
    """Side of the fit window, an odd number."""
    stars: int = quantity(1000, low=2, high=100_000)
    """Number of stars, at random places on the detector."""
    positions: int = quantity(16, low=1, high=1024)
    """Number of positions of each star to average."""
    dither_px: float = quantity(32.0, unit="px", low=0, high=512)
    """Largest dither from the first position, along x and y."""
    seed: int = quantity(0, low=0)
    """Random seed."""

    def __post_init__(self) -> None:
        if self.window is not None and self.window % 2 == 0:
            raise InputError(f"--window {self.window}: even; give an odd number")
        if self.electrons + self.background_e > MAX_ELECTRONS:
            raise InputError(
                f"--electrons, --background: more than {MAX_ELECTRONS:g} e- cannot be counted; "
                "give less"
            )


@dataclass(frozen=True)
class Centroids:
    """Correct a table of centroids with the maps of RUN.

    TABLE holds centroids measured on a perfect grid. Columns are added for the corrected positions
    and their errors from the maps.
    """

    out: Path = quantity(metavar="FILE")
    """Table to write: CSV, ECSV, FITS or VOTable."""
    fwhm_px: float = quantity(unit="px", low=FWHMS[0], high=FWHMS[1])
    """Full width of the stars at half maximum, px."""
    x: str = quantity("x", metavar="NAME")
    """Column of x, px."""
    y: str = quantity("y", metavar="NAME")
    """Column of y, px."""
    origin: Literal["0", "1"] = quantity("0")
    """Coordinate of the centre of the first pixel (1 for SExtractor and FITS)."""
    electrons: float | None = quantity(None, above=0, metavar="N", shown="equal weights")
    """Electrons per star, if the centroids were fitted with photon-noise weights."""
    overwrite: bool = quantity(False)
    """Replace FILE."""


@dataclass(frozen=True)
class Wcs:
    """Write the maps of RUN as a WCS distortion.

    astropy and others apply these lookup tables (D2IMARR) to pixel coordinates before the rest of a
    WCS.
    """

    out: Path = quantity(metavar="FILE", doc="FITS file to write.")
    fwhm_px: float | None = as_in(
        Centroids,
        "fwhm_px",
        default=None,
        shown="no star: the pixel offsets",
        doc="Distortion for stars of this width, centred on pixels.",
    )
    overwrite: bool = as_in(Centroids, "overwrite")


@dataclass(frozen=True)
class Electrons:
    """Convert other frames to electrons with the detector of RUN.

    Bias, dark signal and flat are removed from each frame of FILES, and with them the effects of
    the diagnosis that change single samples, such as a nonlinear response. FILES are FITS, TIFF or
    PNG of the same window. Each frame is written as FITS with its errors and mask, which CCDData of
    astropy reads.
    """

    out: Path = quantity(metavar="DIR", doc="Directory of the written frames.")
    exptime_s: float | None = quantity(
        None, unit="s", low=0, metavar="S", shown="EXPTIME of each file", doc="Exposure time, s."
    )
    own: tuple[Path, ...] = as_in(Fit, "own")
    overwrite: bool = quantity(False, doc="Replace files of DIR.")


@dataclass(frozen=True)
class Compare:
    """Compare maps of the same pixels, scale by scale.

    Give two or more fitted runs of the same window, or one run to compare with itself.
    """

    split: Literal["halves", "odd-even"] = quantity("halves")
    """How to split a single run: first and second half, or alternating batches."""
    sigma_accuracy: float = quantity(0.02, low=0, high=0.5, metavar="SHARE")
    """Relative error of SIGMA to tolerate."""


@dataclass(frozen=True)
class Budget:
    """Plan the frames and hours needed for a given precision.

    BENCH.yaml describes a bench as for `pixcal simulate`. The numbers are the Cramér-Rao bound: no
    unbiased estimate needs fewer frames. The fit comes within a few percent of it.
    """

    precision_px: float | None = quantity(
        None, unit="px", low=1e-9, high=1, shown="5e-5 without --frames"
    )
    """Wanted 1-sigma error of the offsets on each axis."""
    frames: int | None = quantity(None, low=1, high=10**12)
    """Frames of each fringe set; prints the precision that they reach."""


@dataclass(frozen=True)
class Simulate:
    """Simulate a bench and write an acquisition.

    BENCH.yaml describes detector, optics and frames. The acquisition holds the FITS files that the
    camera of the bench would have written; its truth goes to a separate directory.
    """

    truth: Path | None = quantity(None, metavar="DIR", shown="ACQ-truth")
    """Directory of the truth."""
    own: tuple[Path, ...] = _own("Python file with your own effect that BENCH.yaml names")


@dataclass(frozen=True)
class Run:
    """Run all steps: from frames to corrected maps and a report."""

    overwrite: bool = as_in(Ingest, "overwrite")
    copy: bool = as_in(Ingest, "copy")
    gain: Literal["declared", "measured"] = as_in(Reduce, "gain")
    model: str = as_in(Fit, "model")
    cubes: StrPath | None = as_in(Ingest, "cubes")
    diagnosed: bool = quantity(True, flag="--diagnose/--no-diagnose")
    """Find the effects that make the frames differ from a simulation (the longest step)."""


@dataclass(frozen=True)
class Report:
    """Write the report of a run, one self-contained HTML page."""
