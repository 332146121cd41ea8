"""Statements of the paper, with their place: the only numbers of the page not measured by a run.

Rousset et al., "Pixel-Level Calibration for Space-Based High Precision Astrometry Using Young's
Fringes".
"""

from dataclasses import dataclass

TARGET_PX = 5e-5
"""Precision that the mission needs (section 1), and that figure 9 is drawn for."""
MEASURED_PX, MEASURED_FRAMES = 5e-4, 10_000
"""Precision and frames that the Allan deviations of the bench let expect (section 4.3)."""
STABLE_S = 1800.0
"""Until then the bench keeps to the square-root law (section 4.3)."""


@dataclass(frozen=True)
class Statement:
    """A sentence or number of the paper."""

    text: str  # in short
    place: str  # section, figure or table


STATEMENTS = {
    "straight": Statement("valid for detectors of small size", "section 3.2"),
    "periods": Statement("7 to 57 px for baselines of 6 to 1 mm at 40 cm", "section 4.1"),
    "curved": Statement("hyperbolic fringes at the first and last 25 columns", "figure 5"),
    "target": Statement("5 × 10⁻⁵ px with approximately 20 000 frames", "section 7"),
    "finer": Statement(
        "more frames and a smaller interfringe give a better precision", "section 4.2"
    ),
    "constant": Statement("A and B set to a constant mean: figure 9", "section 4.2"),
    "free": Statement(
        "A and B released: convergence uncertain, precision not attained", "section 4.2"
    ),
    "laser": Statement("A and B vary by 2 % with this laser: subsequent research", "section 4.2"),
    "systematics": Statement(
        "estimated parameters are not subject to any systematic errors", "section 4.2, figure 10"
    ),
    "response": Statement("bias and response maps appear in α and ι", "section 4.2, figure 10"),
    "map": Statement("δx is spatially random, as simulated", "section 4.2, figure 10"),
    "slope": Statement(
        "square-root law within the error bars before 30 min (13 000 frames)", "section 4.3"
    ),
    "rise": Statement("one of two data sets rises at 30 min", "section 4.3, figure 11"),
    "allan": Statement("5 × 10⁻⁴ px with 10 000 frames", "section 4.3"),
    "gap": Statement("an order of magnitude above the simulations", "section 7"),
    "teeth_y": Statement("saw teeth of 4 % of a pixel (amplitudes about 2 %)", "section 5.1"),
    "teeth_x": Statement("0.2 % of a pixel (amplitudes about 0.5 %)", "section 5.1"),
    "kernel": Statement(
        "repeats every four rows, 2 to 3 % vertically, 0.6 % horizontally, sparse", "section 5.1"
    ),
    "alike": Statement(
        "simulated teeth of similar amplitude, higher on δx", "section 5.1, figure 13"
    ),
    "clean": Statement("without crosstalk flat, precision 10⁻⁷ px", "section 5.1, figure 13"),
    "crest": Statement(
        "a diagonal crest, mainly on δx, from the straight model", "section 5.2, figures 14, 15"
    ),
    "offset_y": Statement("(18 mm, 18 mm) for δy, found by trial and error", "figure 15"),
    "offset_x": Statement("(18 mm, −18 mm) for δx, found by trial and error", "figure 15"),
    "same_teeth": Statement("teeth as high as at small scale", "section 5.2, figure 14"),
    "residuals": Statement(
        "fringes left in the maps of 500 frames, by a fringe vector that moves", "section 5.2"
    ),
    "paths": Statement("paths of crests and valleys over 46 Mpix", "figure 16"),
    "minimum": Statement("one global minimum", "section 6, figure 17"),
    "accurate": Statement("B and D determined accurately, without noise", "section 6"),
    "correlated": Statement("B and D highly correlated, B/D well defined", "figure 17"),
}
"""By a word that the figures' modules use."""
