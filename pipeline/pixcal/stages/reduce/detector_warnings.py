"""Warnings on a detector that behaves badly, or differs from its declaration."""

from collections.abc import Sequence

import numpy as np

from pixcal.estimators.crosstalk.hot_pixels import hot_pixels_of
from pixcal.estimators.crosstalk.trails import LINKS, trails_of
from pixcal.estimators.crosstalk.trails import SURE as TRAILS
from pixcal.estimators.detector.calibration import Linearity
from pixcal.kernels.gain_fit import GainFit
from pixcal.kernels.photon_transfer import SHARED
from pixcal.model.arrays import F64
from pixcal.report.text import with_error
from pixcal.stages.reduce.detector_summary import Summary
from pixcal.stages.reduce.ingested import Ingested
from pixcal.stages.reduce.read_noise import Nearby
from pixcal.stages.tiles import centred
from pixcal.storage.cube_reader import ArrayReader
from pixcal.storage.place import Place

_ROUGH = 10.0  # reduced chi-square above which a photon-transfer curve is not smooth
_LINEARITY = 0.02
# of an exposure-time offset that is reported: its least errors, share of the shortest flats, and
# ratio of that share to the deviations from the line
_SURE, _LATE, _CURVED = 5.0, 0.005, 20.0
# of a lamp that is reported as unsteady: fewest flats of a series, change over it, and scatter
_FEWEST, _DRIFT, _SCATTER = 4, 0.01, 0.02
# least declared over measured gain that an electron-multiplying register explains
_MULTIPLIED = 3.0
# of trails of hot pixels: longest side of the central part of the detector that is examined, and
# share of the converter's range that a hot pixel may fill
_TRAILS_SIDE, _HOT_FULL = 512, 0.9
_OF_STEP = 0.1  # relative tolerance to recognise a gain declared per step of the converter


def detector_warnings(
    summary: Summary, gain: float, saturation: float | None, nearby: Nearby | None
) -> list[str]:
    """Warnings on the detector as a whole.

    ``gain``: the used gain (e-/ADU). ``saturation``: level at which flats saturate (ADU), if not
    declared. ``nearby``: noise that neighbours share without light.
    """
    warnings = []
    filtered = nearby is not None and nearby.filtered
    if nearby is not None and filtered:
        along = " and ".join(f"{size:.2g} along {line}s" for line, size in nearby.near.items())
        warnings.append(
            "the noise of neighbouring pixels is correlated in frames without light ("
            f"{along}): the samples were filtered, smoothed or resampled before they were "
            "written; gain and noise are those of the filtered samples, and photon transfer is "
            "invalid; record raw frames"
        )
    # Without a level that saturates, only hot pixels do.
    if saturation is not None and not summary.usable.all():
        warnings.append(
            f"flats saturate at {saturation:.0f} ADU, where their samples pile up: "
            f"gain and linearity exclude {(~summary.usable).sum()} of {len(summary.usable)} "
            "levels; if they saturate elsewhere, declare detector.saturation_adu"
        )
    if summary.gain is not None:
        warnings += _gain_warnings(summary.gain, summary, gain, filtered)
    if summary.full.any():
        assert summary.well is not None
        warnings.append(
            f"the wells are full at {summary.well[0]:.0f} ADU above bias: gain and linearity "
            f"exclude {summary.full.sum()} of {len(summary.levels)} levels of flats, at or near it"
        )
    warnings += _linearity_warnings(summary)
    noise = summary.declared.read_noise_e
    measured = summary.noise_measured_e(summary.before_rounding, gain)
    if measured is not None and summary.before_rounding is not None:
        value, error = measured
        if abs(value - noise) > max(3 * error, 0.1 * noise):
            warnings.append(
                f"the read noise is {value:.4g} ± {error:.2g} e- "
                f"({summary.before_rounding[0]:.4g} ADU), not the {noise:g} of "
                "detector.read_noise_e: the measured one is used"
            )
    return warnings


def _gain_warnings(fit: GainFit, summary: Summary, used: float, filtered: bool) -> list[str]:
    warnings = []
    if fit.excess[0] > 1:
        warnings.append(
            "electrons are multiplied before the output, as the third moment of the noise of flats "
            f"shows: the measured gain allows for an excess noise factor F² = {fit.excess[0]:g}, "
            "right for a multiplication of 10 or more"
        )
    if fit.chi2_reduced > _ROUGH:
        warnings.append(
            "the points of the photon-transfer curve deviate from a smooth curve by more than "
            f"their noise (reduced chi-square {fit.chi2_reduced:.3g}); the error of the gain, "
            f"{100 * fit.error / fit.gain:.2g} %, includes this; possible causes: amplifiers of "
            "different gain, missing codes, or a flickering lamp"
        )
    if fit.step:
        warnings.append(
            f"the photon-transfer curve is not smooth above {fit.levels[1]:.0f} ADU, as in a "
            "camera that reads bright pixels at another gain (dual gain, HDR): the reported gain "
            "applies below this level; gain and noise of brighter pixels are not measured, and the "
            "diagnosis leaves brighter flats out"
        )
    if fit.without_dark:
        warnings.append(
            "frames without light differ in noise from the photon-transfer curve at level zero: "
            "gain and read noise are those of the flats alone; possible causes: the camera clips "
            "its black level, or reads dark pixels with another amplifier (dual gain, HDR)"
        )
    clear = [lag for lag, sigmas in fit.neighbours.items() if sigmas > SHARED]
    if clear and not filtered:
        lags = ", ".join(f"({y}, {x})" for y, x in clear)
        warnings.append(
            "crosstalk: the noise of neighbours in the flats is correlated at (rows, columns) "
            f"{lags}; the gain allows for these covariances"
        )
    if fit.uneven:
        warnings.append(
            "parts of the flats vary in brightness from frame to frame, as rows of a rolling "
            "shutter do under a flickering lamp (mains, dimmed LED). This can bias gain and "
            "diagnosis; take flats with a steady (DC) lamp, or expose for many flicker periods"
        )
    if fit.curved and not filtered:
        warnings.append(
            "the photon-transfer curve is not straight: variance over level changes by "
            f"{100 * fit.curved:+.2g} % up to {fit.levels[1]:.0f} ADU; the gain is "
            "that at level zero; possible causes: a nonlinear response, or the brighter-fatter "
            "effect"
        )
    return warnings + _declared_gain_warnings(fit, summary, used)


def lamp_warnings(series: Sequence[tuple[float, F64]]) -> list[str]:
    """That the light of flats (t,) of an exposure time (s) drifts or scatters within the series."""
    worst = {"drifts": (0.0, 0.0), "scatters": (0.0, 0.0)}
    for seconds, levels in series:
        if len(levels) < _FEWEST or levels.mean() <= 0:
            continue
        # Lag may make the first flat fainter.
        light, time = levels[1:] / levels[1:].mean(), np.arange(1, len(levels))
        line = np.polyfit(time, light, 1)
        drift, scatter = abs(line[0]) * (len(time) - 1), float(np.std(np.diff(light)) / np.sqrt(2))
        if drift > _DRIFT and drift > _SURE * scatter:
            worst["drifts"] = max(worst["drifts"], (drift, seconds))
        elif scatter > _SCATTER:
            worst["scatters"] = max(worst["scatters"], (scatter, seconds))
    how = {"drifts": "over their series", "scatters": "rms from frame to frame"}
    return [
        f"the light of the flats {what} by up to {100 * size:.2g} % {how[what]} (exposures of "
        f"{seconds:g} s): gain and noise allow for it; for linearity, let the lamp warm up and "
        "keep it steady"
        for what, (size, seconds) in worst.items()
        if size
    ]


def _linearity_warnings(summary: Summary) -> list[str]:
    """Why the levels of the flats deviate from a straight line over exposure time."""
    flats = summary.linearity
    if flats is None:
        return []
    off, said = f"{100 * flats.line.max_deviation:.2g} %", []
    unflagged = "; it does not flag pixels as NONLINEAR"
    if flats.drift > _LATE:
        said.append(
            f"the light of the flats changes by up to {100 * flats.drift:.2g} %, as the frames of "
            "each exposure time show: the linearity error allows for it"
        )
    if flats.rounded:
        said.append(
            f"the exposure times of the flats seem rounded to {flats.rounded:g} s: deviations of "
            f"the levels from a straight line, of up to {off}, are within half a step "
            f"({flats.rounded / 2:g} s) of the exposure times, and their noise shows no nonlinear "
            "response; the linearity error allows for it. Write the true times into "
            "the headers, or expose "
            "for whole multiples of the step" + unflagged
        )
    elif flats.scatter:
        said.append(
            f"the levels of the flats scatter by {100 * flats.scatter:.2g} % about a smooth curve "
            "over exposure time, while their noise shows no nonlinear response; possible causes: "
            "rounded exposure times, a lamp reset for each level, or a step in the response; the "
            "linearity error allows for it" + unflagged
        )
    elif flats.lamp:
        said.append(
            f"the levels of the flats deviate by up to {off} from a straight line over exposure "
            "time: the response may be nonlinear, or the lamp may drift; to separate the two, "
            "repeat the first level at the end, with several flats of each level" + unflagged
        )
    elif flats.line.max_deviation > _LINEARITY:
        said.append(
            f"the levels of the flats deviate by up to {off} from a straight line over exposure "
            "time: the response of all pixels is nonlinear, the lamp is unsteady, or exposure "
            "times are wrong" + unflagged
        )
    return said + _exposure_warnings(summary, flats.line)


def _exposure_warnings(summary: Summary, straight: Linearity) -> list[str]:
    """That exposures are longer or shorter than stated, if the levels are otherwise straight."""
    if summary.read_noise is None:  # else the level without light is unknown
        return []
    late, error = straight.late
    share = abs(straight.intercept) / summary.levels[summary.usable].min()
    if abs(late) < _SURE * error or share < max(_LATE, _CURVED * straight.max_deviation):
        return []
    return [
        f"the flats have the light of exposures {with_error(abs(late), error)} s "
        f"{'longer' if late > 0 else 'shorter'} than stated ({100 * share:.2g} % of the shortest): "
        "a slow shutter or a delayed lamp, or the level without light is wrong; the linearity "
        "error allows for it"
    ]


def _declared_gain_warnings(fit: GainFit, summary: Summary, used: float) -> list[str]:
    """That no gain is declared, or another one than measured."""
    declared, step = summary.declared.gain_e_per_adu, summary.step
    value, error = fit.of_electrons
    if declared is None:
        return [f"no gain declared: using {used:.4g} ± {error:.2g} e-/ADU, measured from the flats"]
    if abs(value - declared) <= max(3 * error, 0.02 * declared):
        return []
    causes = [
        f"samples are multiples of {step:g} ADU, so the gain of one step of the converter must be "
        f"divided by {step:g}; "
    ] * (step > 1 and abs(value * step - declared) < _OF_STEP * declared)
    causes += [
        f"the declared gain seems to be that of the output; divide it by the multiplication, about "
        f"{float(f'{declared / value:.2g}'):g}; "
    ] * (fit.excess[0] > 1 and declared > _MULTIPLIED * value)
    causes += [
        "this is half of it, as the excess noise of an electron-multiplying register (F² = 2) "
        "gives at the right declared gain: if the camera has one, keep the declared gain; else "
    ] * (fit.excess[0] == 1 and abs(2 * value - declared) < max(6 * error, 0.02 * declared))
    return [
        f"photon transfer gives a gain of {value:.4g} ± {error:.2g} e-/ADU, not the "
        f"{declared:g} of detector.gain_e_per_adu: {''.join(causes)}"
        + (
            "correct it or use '--gain measured', unless the diagnosis names an effect that "
            "changes it; the declared value is used now"
            if used == declared
            else "the measured value is used"
        )
    ]


def trail_warnings(calibration: Place, source: Ingested, gain: float) -> list[str]:
    """That hot pixels have trails of charge, which grow with the distance from an output."""
    longest = max(source.exposures.dark, key=lambda group: group.exptime, default=None)
    if longest is None or not (source.exposures.has_rate and longest.exptime > 0):
        return []
    seconds = longest.exptime
    (y0, y1), (x0, x1) = centred(source.shape, _TRAILS_SIDE)
    rate, bias = (
        ArrayReader(calibration / name).read((y0, y1), (x0, x1)).astype(float)
        for name in ("dark_rate", "bias")
    )
    usable = bias + rate * seconds / gain < _HOT_FULL * source.saturation(longest.array)
    hot = hot_pixels_of(rate * seconds, usable, LINKS)
    trails = None if hot is None else trails_of(hot, rate.shape, (y0, x0))
    middle = (y0 + y1) / 2, (x0 + x1) / 2
    said = [
        f"along {lines} that are read out towards the {'first' if one.output <= first else 'last'} "
        f"{line}, {with_error(*one.loss)} of {one.level_e:.0f} e- per transfer"
        for one, lines, line, first in zip(
            trails or (), ("columns", "rows"), ("row", "column"), middle, strict=False
        )
        if one.significance > TRAILS
    ]
    return [
        "charge trails hot pixels, the more the farther they are from the output, as incomplete "
        f"transfer leaves it (CTI): {'; '.join(said)}. It correlates the noise of neighbours too, "
        "which is not crosstalk"
    ] * bool(said)
