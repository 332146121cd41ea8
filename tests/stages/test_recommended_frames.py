"""Frames that would decide are those that tell on the effects and that are missing."""

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import pytest

from pixcal.effects import effects
from pixcal.model.acquisition import Acquisition
from pixcal.model.config import parse
from pixcal.simulation.effect import Effect
from pixcal.simulation.forward import DOMAINS
from pixcal.stages.diagnose.candidates import _needs
from pixcal.stages.diagnose.frames import (
    CLOSER_LOOK,
    MORE,
    RANDOM,
    missing_frames,
    recommend_closer_look,
    recommend_frames,
)

LADDER = (0.01, 0.02, 0.03)
FOUR = ((6.0, 0.0), (-9.0, 0.1), (0.0, 6.0), (0.0, 9.0))


class Mine(Effect):
    """Of a user, who did not say what tells on it."""


def an_acquisition(baselines: Sequence[tuple[float, float]]) -> Acquisition:
    plain = {
        "schema": "pixcal/acquisition/1",
        "detector": {"pitch_um": 4.4, "gain_e_per_adu": 1.0, "read_noise_e": 5.0},
        "optics": {"wavelength_nm": 633.0, "distance_mm": 500.0, "frame_period_s": 0.1},
        "frames": {
            "bias": ["b"],
            "fringes": [
                {"name": f"s{n}", "baseline_mm": list(b), "files": ["f"]}
                for n, b in enumerate(baselines)
            ],
        },
    }
    return parse(Acquisition, plain, "test")


def missing(
    baselines: Sequence[tuple[float, float]],
    flats: Sequence[float],
    *,
    dark: bool = True,
    steps: Sequence[float] = (0.0, 0.3),
) -> dict[str, str]:
    tables = {"flat": {"exptime_s": [*flats, *flats]}} if flats else {}
    tables |= {"dark": {"exptime_s": [1.0]}} if dark else {}
    return missing_frames(an_acquisition(baselines), tables, steps if baselines else ())


@pytest.mark.parametrize(
    ("lacking", "names", "words"),
    [
        (missing(FOUR, LADDER), ("ipc", "mine"), [MORE]),
        (missing(FOUR, LADDER, dark=False), ("ipc",), ["dark frames"]),
        (missing(FOUR, LADDER, dark=False), ("row_noise", "contrast_noise"), ["dark frames"]),
        (missing(FOUR, LADDER, dark=False), ("contrast_noise",), [MORE]),
        (missing(((6, 0), (0, 6)), LADDER), ("ipc",), ["a second baseline along x and y"]),
        (missing(((6, 0), (9, 0), (0, 6)), LADDER), ("ipc",), ["a second baseline along y"]),
        (missing(((4, 4),), LADDER), ("intra_pixel_response",), ["a second baseline along 45°"]),
        (
            missing(((6, 0), (9, 0)), LADDER),
            ("ghost_fringes",),
            ["a fringe set along another axis"],
        ),
        (missing(FOUR, LADDER[:1]), ("nonlinearity",), ["flats at 3 or more exposure times"]),
        (missing(FOUR, LADDER[:1]), ("row_noise",), [MORE]),
        (missing(FOUR, ()), ("mine",), ["flat frames", "flats at 3 or more exposure times"]),
    ],
)
def test_frames_that_would_decide_are_those_that_are_missing(
    lacking: dict[str, str], names: tuple[str, ...], words: list[str]
) -> None:
    kinds = effects() | {"mine": Mine}
    assert recommend_frames(lacking, [kinds[name] for name in names]) == words


BARE = missing(((6, 0),), (), dark=False, steps=(0.0,))
"""Fringes of one set, and nothing else."""


@pytest.mark.parametrize(
    ("names", "kinds"),
    [
        (("lag", "nonlinearity"), ("ladder",)),
        # The second harmonic of a response does not depend on the fringes' spacing.
        (("nonlinearity", "brighter_fatter"), ("baseline",)),
        # Crosstalk shows at hot pixels, and in the noise in proportion to the level.
        (("ipc", "brighter_fatter"), ("dark", "flat", "ladder")),
        # Both lower the visibility of close fringes; only crosstalk makes neighbours share noise.
        (("ipc", "intra_pixel_response"), ("dark", "flat")),
        # A ghost beats with all fringes at the same vector; what is in pixels does not.
        (("straylight", "ghost_fringes"), ("baseline",)),
        (("hyperbolic_fringes", "ghost_fringes"), ("baseline",)),
        # Motion adds the same to all fringe vectors, a change of colour in proportion to them.
        (("fringe_drift", "wavelength_drift"), ("baseline", "axis")),
        (("intensity_noise", "bias_drift"), ("dark",)),
        # Frames that show both alike are better than none; where they are of no use, more frames.
        (("row_noise", "bias_drift"), ("dark",)),
        (("fringe_drift", "fringe_jitter"), ()),
        (("intensity_noise", "contrast_noise"), ()),
        # Of three, what is not the same for all.
        (("ipc", "brighter_fatter", "intra_pixel_response"), ("dark", "flat", "ladder")),
    ],
)
def test_frames_that_tell_on_one_effect_and_not_on_the_other_decide(
    names: tuple[str, ...], kinds: tuple[str, ...]
) -> None:
    words = [BARE[kind] for kind in BARE if kind in kinds] or [MORE]
    for order in (names, names[::-1]):
        assert recommend_frames(BARE, [effects()[name] for name in order]) == words


def test_what_tells_on_all_is_asked_for_once_nothing_parts_them() -> None:
    """Also where all frames that would part them are there."""
    both = [effects()[name] for name in ("nonlinearity", "brighter_fatter")]
    assert set(both[0].frames_needed) & set(both[1].frames_needed) == {"ladder"}
    lacking = missing(FOUR, LADDER[:1])
    assert recommend_frames(lacking, both) == [lacking["ladder"]]


@pytest.mark.parametrize(
    ("steps", "lacks"),
    [((0.0, 0.0), {}), ((0.3, 0.2), {"random": RANDOM}), ((0.0, 0.3), {}), ((), {})],
)
def test_phases_are_asked_for_that_no_set_has(
    steps: tuple[float, ...], lacks: dict[str, str]
) -> None:
    lacking = missing(FOUR if steps else (), LADDER, steps=steps)
    assert lacking == lacks
    both = [effects()[name] for name in ("rolling_shutter", "intensity_noise")]
    assert recommend_frames(lacking, both) == list(lacks.values() or [MORE])


def test_effects_name_kinds_of_frames_that_there_are() -> None:
    bare = [missing(((4, 4),), (), dark=False, steps=(step,)) for step in (0.0, 0.3)]
    known = {kind for lacking in bare for kind in lacking}
    for kind in (*effects().values(), Effect):
        assert set(kind.frames_needed) <= known


def test_an_unexplained_difference_is_looked_at_more_closely_in_its_domain() -> None:
    assert set(CLOSER_LOOK) == set(DOMAINS)
    assert recommend_closer_look({}, "time") == [CLOSER_LOOK["time"]]
    lacks = {"dark": "dark frames", "ladder": "a ladder"}
    assert recommend_closer_look(lacks, "time") == [CLOSER_LOOK["time"], "dark frames"]
    assert recommend_closer_look(lacks, "intensity") == [CLOSER_LOOK["intensity"], "a ladder"]


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("bias_drift", (MORE,)),
        ("gain_error", ("flat frames",)),
        ("lag", ("flat frames", "flats at 3 or more exposure times")),
    ],
)
def test_an_effect_that_has_its_kind_of_frames_needs_more_of_them(
    name: str, words: tuple[str, ...]
) -> None:
    only_darks: Any = SimpleNamespace(sets={}, missing_frames=missing((), ()))
    assert _needs(effects()[name], only_darks) == words
