"""Dark current beside hot pixels in the simulations of a diagnosis."""

import numpy as np

from pixcal.stages.diagnose.hot_pixels import uncoupled


def test_pixels_beside_hot_ones_are_as_any_others() -> None:
    rng = np.random.default_rng(1)
    dark = rng.lognormal(0, 0.4, (200, 200))
    hot = np.arange(5, 200, 8)
    dark[np.ix_(hot, hot)] = 500.0
    for step in (-1, 1):
        dark[np.ix_(hot + step, hot)] = dark[np.ix_(hot, hot + step)] = 10.0
    found = uncoupled(dark, rng)
    near = np.hypot(*np.indices((5, 5)) - 2)
    beside = np.zeros((200, 200), np.bool_)
    for y in hot:
        for x in hot:
            beside[y - 2 : y + 3, x - 2 : x + 3] = near > 0
    usual = ~beside & (dark < 500)
    np.testing.assert_array_equal(found[~beside], dark[~beside])
    n = np.count_nonzero(beside)
    # The error of a mean, and of a standard deviation, of so many values.
    for moment in (np.log(found), np.log(found) ** 2):
        off = moment[beside].mean() - moment[usual].mean()
        assert abs(off) < 4 * moment[usual].std() * n**-0.5


def test_each_simulation_draws_its_own() -> None:
    dark = np.random.default_rng(2).lognormal(0, 0.4, (50, 50))
    dark[20, 20] = 500.0
    one, same, other = (uncoupled(dark, np.random.default_rng(seed)) for seed in (3, 3, 4))
    np.testing.assert_array_equal(one, same)
    assert np.count_nonzero(one != other) == 24


def test_a_map_without_spread_stays() -> None:
    """Dark frames that a camera clips at zero; one map has more bright pixels than others."""
    dark = np.zeros((30, 40))
    dark[::3, ::3] = 1.0
    np.testing.assert_array_equal(uncoupled(dark, np.random.default_rng(5)), dark)
