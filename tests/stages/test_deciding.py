"""Frames that would decide are those that tell on the effects and that are missing."""

from collections.abc import Sequence

import pytest

from pixcal.effects import effects
from pixcal.model.acquisition import Acquisition
from pixcal.model.config import parse
from pixcal.simulation.effect import Effect
from pixcal.stages.diagnose.deciding import MORE, deciding, missing_frames

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
    baselines: Sequence[tuple[float, float]], flats: Sequence[float], *, dark: bool = True
) -> dict[str, str]:
    tables = {"flat": {"exptime_s": [*flats, *flats]}} if flats else {}
    tables |= {"dark": {"exptime_s": [1.0]}} if dark else {}
    return missing_frames(an_acquisition(baselines), tables)


@pytest.mark.parametrize(
    ("lacking", "names", "words"),
    [
        (missing(FOUR, LADDER), ("ipc", "mine"), [MORE]),
        (missing(FOUR, LADDER, dark=False), ("ipc",), ["dark frames"]),
        (missing(FOUR, LADDER, dark=False), ("lag", "contrast_noise"), ["dark frames"]),
        (missing(FOUR, LADDER, dark=False), ("contrast_noise",), [MORE]),
        (missing(((6, 0), (0, 6)), LADDER), ("ipc",), ["a second baseline along x and y"]),
        (missing(((6, 0), (9, 0), (0, 6)), LADDER), ("ipc",), ["a second baseline along y"]),
        (missing(((4, 4),), LADDER), ("intra_pixel_response",), ["a second baseline along 45°"]),
        (missing(((6, 0), (9, 0)), LADDER), ("ghost_fringes",),
         ["a fringe set along another axis"]),
        (missing(FOUR, LADDER[:1]), ("nonlinearity",),
         ["a ladder of flats (at least 3 exposure times)"]),
        (missing(FOUR, LADDER[:1]), ("lag",), [MORE]),
        (missing(FOUR, ()), ("mine",),
         ["flat frames", "a ladder of flats (at least 3 exposure times)"]),
    ],
)  # fmt: skip
def test_frames_that_would_decide_are_those_that_are_missing(
    lacking: dict[str, str], names: tuple[str, ...], words: list[str]
) -> None:
    kinds = effects() | {"mine": Mine}
    assert deciding(lacking, [kinds[name] for name in names]) == words


def test_effects_name_kinds_of_frames_that_there_are() -> None:
    known = {*missing((), ()), *missing(((4, 4),), (), dark=False)}
    for kind in (*effects().values(), Effect):
        assert set(kind.told_by) <= known
