"""Normals of pixels: the published generator, the exact distribution, independence of cuts."""

from itertools import combinations

import numpy as np
import pytest
from scipy import stats

from pixcal.kernels.normals import philox, pixel_normals

SHAPE = (200, 301)
FRAMES = 20
KEY = (3, 8)


def drawn(key: tuple[int, int] = KEY, frame: int = 0) -> np.ndarray:
    return pixel_normals(key, frame, (0, SHAPE[0]), SHAPE[1])


@pytest.fixture(scope="module")
def frames() -> np.ndarray:
    """(frame, 2, y, x)."""
    return np.array([drawn(frame=n) for n in range(FRAMES)])


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ((0,) * 6, (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
        ((0xFFFFFFFF,) * 6, (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
        (
            (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344, 0xA4093822, 0x299F31D0),
            (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
        ),
    ],
)
def test_words_are_the_known_answers_of_random123(
    given: tuple[int, ...], expected: tuple[int, ...]
) -> None:
    assert philox(*map(np.uint32, given)) == expected


def test_a_pair_is_that_of_box_and_muller() -> None:
    found = drawn(frame=5)
    for y, x in [(0, 0), (1, 0), (1, 7), (198, 300), (199, 12)]:
        counter = map(np.uint32, (x, y // 2, 5, 0, *KEY))
        radius, angle = np.array(philox(*counter), float)[2 * (y % 2) :][:2] / 2**32
        turn = np.exp(2j * np.pi * angle) * np.sqrt(-2 * np.log(radius + 0.5 / 2**32))
        assert found[:, y, x] == pytest.approx([turn.real, turn.imag], abs=1e-6 * abs(turn))


def test_moments_are_those_of_a_normal(frames: np.ndarray) -> None:
    for plane in (frames[:, 0], frames[:, 1]):
        n, values = plane.size, plane.astype(float)
        assert abs(values.mean()) < 4 / np.sqrt(n)
        for order, moment, square in [(2, 1, 3), (3, 0, 15), (4, 3, 105), (6, 15, 10395)]:
            error = np.sqrt((square - moment**2) / n)
            assert (values**order).mean() == pytest.approx(moment, abs=4 * error), order


def test_the_distribution_is_normal_in_every_frame(frames: np.ndarray) -> None:
    p = [stats.kstest(plane.ravel(), "norm").pvalue for frame in frames for plane in frame]
    assert stats.kstest(p, "uniform").pvalue > 1e-4


def test_tails_are_those_of_a_normal(frames: np.ndarray) -> None:
    for limit in (2.0, 3.0, 4.0):
        expected = 2 * stats.norm.sf(limit) * frames.size
        found = np.count_nonzero(np.abs(frames) > limit)
        assert abs(found - expected) < 4 * np.sqrt(expected), limit


def test_places_frames_planes_and_keys_are_independent(frames: np.ndarray) -> None:
    one, two = frames[:, 0], frames[:, 1]
    other = np.array([drawn((KEY[0] + 1, KEY[1]), n)[0] for n in range(FRAMES)])
    another = np.array([drawn((KEY[0], KEY[1] + 1), n)[0] for n in range(FRAMES)])
    pairs = {
        "columns": (one[..., 1:], one[..., :-1]),
        "rows of a pair": (one[:, 1::2], one[:, ::2]),
        "rows of two pairs": (one[:, 2::2], one[:, 1:-1:2]),
        "frames": (one[1:], one[:-1]),
        "planes": (one, two),
        "a plane and the other of the frame before": (one[1:], two[:-1]),
        "keys": (one, other),
        "other words of the key": (one, another),
    }
    for name, (a, b) in pairs.items():
        for function in (np.asarray, np.square):  # sizes may depend where values do not
            x, y = (function(v).astype(float) for v in (a, b))
            correlation = np.corrcoef(x.ravel(), y.ravel())[0, 1]
            assert abs(correlation) < 4 / np.sqrt(a.size), (name, function.__name__)


def test_neighbouring_keys_and_frames_share_no_numbers() -> None:
    every = [drawn(key, frame) for key in ((0, 0), (0, 1), (1, 0)) for frame in (0, 1, 2)]
    for one, other in combinations(every, 2):
        # Of 24 bits a few are equal by chance.
        assert np.count_nonzero(one == other) < 5


@pytest.mark.parametrize("rows", [(0, 1), (3, 67), (4, 67), (63, 65), (100, 200), (199, 200)])
def test_numbers_do_not_depend_on_the_rows_asked_for(rows: tuple[int, int]) -> None:
    part = pixel_normals(KEY, 4, rows, SHAPE[1])
    assert np.array_equal(part, drawn(frame=4)[:, slice(*rows)])


def test_numbers_do_not_depend_on_the_width() -> None:
    assert np.array_equal(pixel_normals(KEY, 4, (0, 9), 23), drawn(frame=4)[:, :9, :23])
