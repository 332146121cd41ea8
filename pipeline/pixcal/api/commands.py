"""The commands as functions: the same stages, options and artefacts.

Each imports its stage when it is called, as the shell commands do: to open a run is quick.
"""

import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, TypeVar

from pixcal.api.opened import Run, open_run
from pixcal.api.paths import StrPath
from pixcal.engine.run import Runtime
from pixcal.model.config import parse
from pixcal.model.errors import InputError
from pixcal.storage.artefact import read_json

C = TypeVar("C")
Json = dict[str, Any]
Region = tuple[int, int, int, int]


def _config(kind: type[C], command: str, **options: Any) -> C:
    """Options of a stage, checked as those of a file are."""
    return parse(kind, options, f"pixcal.{command}")


def _text(path: StrPath | None) -> str | None:
    return None if path is None else str(path)


def run(
    acquisition: StrPath,
    out: StrPath,
    *,
    overwrite: bool = False,
    copy: bool = False,
    gain: Literal["declared", "measured"] = "declared",
    model: str = "auto",
    cubes: StrPath | None = None,
    diagnosed: bool = True,
    runtime: Runtime | None = None,
) -> Run:
    """Do all steps, from an acquisition to corrected maps and the report, as ``pixcal run``.

    Parameters
    ----------
    acquisition : str or path
        Directory with ``acquisition.yaml``.
    out : str or path
        The run directory; made if it is not there.
    overwrite : bool
        Replace what was ingested from another acquisition.
    copy : bool
        Copy the samples of all frames: later steps do without the files.
    gain : {"declared", "measured"}
        The gain that electrons are counted with: the owner's, or that of the flats.
    model : str
        Shape of the fringes: ``paraxial``, ``hyperbolic``, or ``auto``, by evidence.
    cubes : str or path, optional
        Folder or URL for the cubes.
    diagnosed : bool
        Tell where the frames differ from a simulation of the bench, and why: takes the longest.
    runtime : Runtime, optional
        Where and with how much memory tasks run.

    Returns
    -------
    Run
        Without fringes in the acquisition, only the detector's side of it is there.

    Raises
    ------
    InputError
        In one line, with the file, key or option that is wrong.
    """
    ingest(acquisition, out, overwrite=overwrite, copy=copy, cubes=cubes, runtime=runtime)
    reduced = reduce(out, gain=gain, cubes=cubes, runtime=runtime)
    if reduced.acquisition.frames.fringes:
        fit(out, model=model, runtime=runtime)
        allan(out, runtime=runtime)
    if diagnosed:
        try:
            diagnose(out, runtime=runtime)
        except InputError as error:
            # The maps are good without it.
            warnings.warn(f"not diagnosed: {error}", stacklevel=2)
        else:
            _correct(out, reduced, model, runtime or Runtime())
    return write_report(out, runtime=runtime)


def _correct(out: StrPath, reduced: Run, model: str, runtime: Runtime) -> None:
    """Make the corrected maps; where that is not possible the fitted ones stand."""
    from pixcal.stages import correct
    from pixcal.stages import fit as stage

    if not reduced.acquisition.frames.fringes:
        return
    refused = correct.attempt(Path(out), correct.Config(fit=stage.Config(model=model)), runtime)
    if refused is not None:
        warnings.warn(f"maps not corrected: {refused}", stacklevel=3)


def ingest(
    acquisition: StrPath,
    out: StrPath,
    *,
    overwrite: bool = False,
    copy: bool = False,
    cubes: StrPath | None = None,
    runtime: Runtime | None = None,
) -> Run:
    """Check every frame of an acquisition, and catalogue it.

    Parameters
    ----------
    acquisition : str or path
        Directory with ``acquisition.yaml``.
    out : str or path
        The run directory; made if it is not there.
    overwrite : bool
        Replace what was ingested from another acquisition.
    copy : bool
        Copy the samples of all frames, not of compressed ones only: later steps do without the
        files.
    cubes : str or path, optional
        Folder or URL for the cubes.
    runtime : Runtime, optional

    Raises
    ------
    InputError
        If a file, key or option is wrong.
    """
    from pixcal.stages import ingest as stage

    config = _config(stage.Config, "ingest", overwrite=overwrite, copy=copy, cubes=_text(cubes))
    stage.run(Path(acquisition), Path(out), config, runtime or Runtime())
    return open_run(out)


def reduce(
    run: StrPath,
    *,
    gain: Literal["declared", "measured"] = "declared",
    clip_sigma: float = 4.0,
    hot_sigma: float = 10.0,
    dead_below: float = 0.5,
    dead_above: float = 2.0,
    noisy_factor: float = 1.5,
    nonlinear_share: float = 0.03,
    rounding_share: float = 1e-3,
    cubes: StrPath | None = None,
    runtime: Runtime | None = None,
) -> Run:
    """Measure the detector and write the fringes in electrons.

    Parameters
    ----------
    run : Run, str or path
    gain : {"declared", "measured"}
        The gain that electrons are counted with: the owner's, or that of the flats.
    clip_sigma : float
        Samples of calibration frames further than that from the rest are left out.
    hot_sigma : float
        Dark signal above the median by so many robust deviations makes a pixel ``HOT``.
    dead_below, dead_above : float
        Response over that of the neighbours outside these limits makes it ``DEAD``.
    noisy_factor : float
        Noise over the usual noise above that makes it ``NOISY``.
    nonlinear_share : float
        Departure from the straight line above that makes it ``NONLINEAR``.
    rounding_share : float
        Share of the variance that the stored precision may cost.
    cubes : str or path, optional
        Folder or URL for the cubes.
    runtime : Runtime, optional

    Raises
    ------
    InputError
        If the run was not ingested, or its gain is to be measured and cannot be.
    """
    from pixcal.stages import reduce as stage

    config = _config(
        stage.Config, "reduce", gain=gain, clip_sigma=clip_sigma, hot_sigma=hot_sigma,
        dead_below=dead_below, dead_above=dead_above, noisy_factor=noisy_factor,
        nonlinear_share=nonlinear_share, rounding_share=rounding_share, cubes=_text(cubes),
    )  # fmt: skip
    stage.run(Path(run), config, runtime or Runtime())
    return open_run(run)


def fit(
    run: StrPath,
    *,
    model: str = "auto",
    batch_frames: int | None = None,
    chi2_limit: float = 1.5,
    with_diagnosis: bool = False,
    own: Sequence[StrPath] = (),
    runtime: Runtime | None = None,
) -> Run:
    """Fit the fringes and write the maps of the offsets.

    Parameters
    ----------
    run : Run, str or path
    model : str
        Shape of the fringes: ``paraxial``, ``hyperbolic``, or ``auto``, by evidence.
    batch_frames : int, optional
        Frames of a batch of the Allan deviation; 500, or fewer in a short run.
    chi2_limit : float
        Pixels with a reduced chi-square above are flagged ``BAD_FIT``.
    with_diagnosis : bool
        Also write maps without the effects that `diagnose` found (`Run.corrected`), and what
        they gained.
    own : sequence of str or path
        Files of effects of one's own that the diagnosis found.
    runtime : Runtime, optional

    Raises
    ------
    InputError
        If the run was not reduced, or holds no fringes that can be fitted; with a diagnosis, if
        there is none.
    """
    from pixcal.stages import correct
    from pixcal.stages import fit as stage

    config = _config(
        stage.Config, "fit", model=model, batch_frames=batch_frames, chi2_limit=chi2_limit
    )
    if with_diagnosis:
        corrected = correct.Config(tuple(map(Path, own)), config)
        correct.run(Path(run), corrected, runtime or Runtime())
    elif own:
        raise InputError("pixcal.fit: own: of use with with_diagnosis only; give that as well")
    else:
        stage.run(Path(run), config, runtime or Runtime())
    return open_run(run)


def allan(
    run: StrPath,
    *,
    region: Region | None = None,
    regions: Sequence[Region] = (),
    runtime: Runtime | None = None,
) -> Run:
    """Measure how the error falls with the number of frames (paper, section 4.3).

    Parameters
    ----------
    run : Run, str or path
    region : (y0, y1, x0, x1), optional
        Pixels of the main curve, ends excluded; all of them by default.
    regions : sequence of (y0, y1, x0, x1)
        Rectangles with a curve of their own.
    runtime : Runtime, optional

    Raises
    ------
    InputError
        If the run was not fitted, or a region is not inside its window.
    """
    from pixcal.stages import allan as stage

    config = _config(stage.Config, "allan", region=region, regions=tuple(regions))
    stage.run(Path(run), config, runtime or Runtime())
    return open_run(run)


def write_report(run: StrPath, *, runtime: Runtime | None = None) -> Run:
    """Write the self-contained HTML page on a run, as ``pixcal report``.

    Parameters
    ----------
    run : Run, str or path
    runtime : Runtime, optional

    Returns
    -------
    Run
        Its ``report`` is the page.

    Raises
    ------
    InputError
        If the run was not reduced.
    """
    from pixcal.stages import report as stage

    stage.run(Path(run), stage.Config(), runtime or Runtime())
    return open_run(run)


def crests(
    run: StrPath,
    *,
    frames: int = 8,
    paths: int | None = None,
    segment: int | None = None,
    runtime: Runtime | None = None,
) -> Json:
    """Find the fibres from crests and valleys, a check of the fit (paper, equation 7).

    Parameters
    ----------
    run : Run, str or path
    frames : int
        Frames to use, spread over the run.
    paths : int, optional
        Crests and valleys to use of each end; all of them by default.
    segment : int, optional
        Length along a fringe that gives one point, px; an eighth of the window by default.
    runtime : Runtime, optional

    Returns
    -------
    dict
        Contents of ``crests.json``.

    Raises
    ------
    InputError
        If the run was not reduced, or a set has too few fringes.
    """
    from pixcal.stages import crests as stage

    config = _config(stage.Config, "crests", frames=frames, paths=paths, segment=segment)
    stage.run(Path(run), config, runtime or Runtime())
    found: Json = read_json(Path(run) / "crests" / "crests.json")
    return found


def diagnose(
    run: StrPath,
    *,
    only: Sequence[str] = (),
    without: Sequence[str] = (),
    own: Sequence[StrPath] = (),
    nominal: StrPath | None = None,
    runtime: Runtime | None = None,
) -> Json:
    """Tell where data and simulation differ, which effect causes it, and what remains.

    Parameters
    ----------
    run : Run, str or path
    only, without : sequence of str
        Candidates: these effects alone, or all but these.
    own : sequence of str or path
        Python files with effects of your own.
    nominal : str or path, optional
        Bench file whose effects the nominal bench has from the start.
    runtime : Runtime, optional

    Returns
    -------
    dict
        Contents of ``diagnosis.json``.

    Raises
    ------
    InputError
        If the run was not reduced, or an effect is not known.
    """
    from pixcal.stages import diagnose as stage

    config = _config(stage.Config, "diagnose", only=tuple(only), without=tuple(without))
    bench = None if nominal is None else Path(nominal)
    config = replace(config, own=tuple(map(Path, own)), nominal=bench)
    stage.run(Path(run), config, runtime or Runtime())
    found: Json = read_json(Path(run) / "products" / "diagnosis.json")
    return found


def astrometry(
    run: StrPath,
    *,
    truth: StrPath | None = None,
    diameter_m: float = 7.0,
    focal_length_m: float = 130.0,
    wavelength_nm: float = 600.0,
    obscuration: float = 0.0,
    electrons: float = 1e8,
    background_e: float = 0.0,
    window: int | None = None,
    stars: int = 1000,
    positions: int = 16,
    dither_px: float = 32.0,
    seed: int = 0,
    runtime: Runtime | None = None,
) -> Json:
    """Tell what the maps bring for the centroids of stars (paper, section 2).

    Parameters
    ----------
    run : Run, str or path
    truth : str or path, optional
        What `simulate` left beside the acquisition.
    diameter_m, focal_length_m, wavelength_nm, obscuration : float
        The telescope; the obscuration is of the diameter.
    electrons, background_e : float
        Of a star at each position; of each pixel.
    window : int, optional
        Side of the fit's window, px, odd; 8 wavelengths over the diameter by default.
    stars, positions : int
        Stars all over the detector, and positions of each.
    dither_px : float
        Distance of the positions from the first.
    seed : int
        Of the random numbers.
    runtime : Runtime, optional

    Returns
    -------
    dict
        Contents of ``astrometry.json``.

    Raises
    ------
    InputError
        If the run was not fitted, or the truth is not that of this detector.
    """
    from pixcal.stages import astrometry as stage

    config = _config(
        stage.Config, "astrometry", diameter_m=diameter_m,
        focal_length_m=focal_length_m, wavelength_nm=wavelength_nm, obscuration=obscuration,
        electrons=electrons, background_e=background_e, window=window, stars=stars,
        positions=positions, dither_px=dither_px, seed=seed,
    )  # fmt: skip
    if truth is not None:
        config = replace(config, truth=Path(truth))
    stage.run(Path(run), config, runtime or Runtime())
    found: Json = read_json(Path(run) / "products" / "astrometry.json")
    return found


def compare(
    runs: Sequence[StrPath],
    out: StrPath,
    *,
    split: Literal["halves", "odd-even"] = "halves",
    sigma_accuracy: float = 0.02,
    runtime: Runtime | None = None,
) -> Json:
    """Tell what maps of the same pixels have in common and what not, scale by scale.

    Parameters
    ----------
    runs : sequence of Run, str or path
        Fitted runs; one alone is compared with itself.
    out : str or path
        Directory for ``compare.json`` and the pictures.
    split : {"halves", "odd-even"}
        How one run is parted.
    sigma_accuracy : float
        Relative error of the maps' errors that counts as no difference yet.
    runtime : Runtime, optional

    Returns
    -------
    dict
        Contents of ``compare.json``.

    Raises
    ------
    InputError
        If a run was not fitted, or the windows differ.
    """
    from pixcal.stages import compare as stage

    config = _config(stage.Config, "compare", split=split, sigma_accuracy=sigma_accuracy)
    stage.run([Path(one) for one in runs], Path(out), config, runtime or Runtime())
    found: Json = read_json(Path(out) / "compare.json")
    return found


def budget(
    bench: StrPath,
    *,
    precision_px: float | None = None,
    frames: int | None = None,
    out: StrPath | None = None,
) -> Json:
    """Tell frames and hours that a precision takes, before any are taken: the Cramér-Rao bound.

    Parameters
    ----------
    bench : str or path
        Bench file, as `simulate` takes it.
    precision_px : float, optional
        Wanted 1-sigma error of a pixel's offset on each axis; 5e-5 px when nothing is asked.
    frames : int, optional
        Of each fringe set: what they reach.
    out : str or path, optional
        Directory for ``budget.json`` and ``budget.png``.

    Returns
    -------
    dict
        Contents of ``budget.json``.

    Raises
    ------
    InputError
        If the bench cannot be read, or its frames determine nothing.
    """
    from pixcal.stages import budget as stage

    config = _config(stage.Config, "budget", precision_px=precision_px, frames=frames)
    return stage.run(Path(bench), config, None if out is None else Path(out))


def simulate(
    bench: StrPath,
    out: StrPath,
    *,
    truth: StrPath | None = None,
    own: Sequence[StrPath] = (),
    runtime: Runtime | None = None,
) -> Path:
    """Simulate a bench and write an acquisition, and its truth apart from it.

    Parameters
    ----------
    bench : str or path
        Bench file (schema ``pixcal/bench/1``).
    out : str or path
        Directory of the acquisition.
    truth : str or path, optional
        Directory of the truth; ``<out>-truth`` by default.
    own : sequence of str or path
        Python files with effects of your own, which the bench file can name.
    runtime : Runtime, optional

    Returns
    -------
    Path
        The acquisition.

    Raises
    ------
    InputError
        If the bench is wrong, or a directory holds what simulate did not put there.
    """
    from pixcal.stages import simulate as stage

    config = stage.Config(truth=None if truth is None else Path(truth), own=tuple(map(Path, own)))
    stage.run(Path(bench), Path(out), config, runtime or Runtime())
    return Path(out)
