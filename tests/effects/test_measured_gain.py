"""What effects do to the gain that photon transfer gives, and the gain of the nominal bench."""

from collections.abc import Callable

import numpy as np
import pytest

from pixcal.effects.brighter_fatter import BrighterFatter
from pixcal.effects.cosmic_hits import CosmicHits
from pixcal.effects.gain_error import GainError
from pixcal.effects.ipc import Coupling, Ipc
from pixcal.effects.lag import Lag
from pixcal.effects.nonlinearity import Nonlinearity
from pixcal.effects.quantisation import Quantisation
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.model.bench import Bench
from pixcal.simulation.effect import Effect
from pixcal.simulation.recording import recordings
from pixcal.stages.diagnose.flats import CHANGE_ERROR, MeasuredGain, photon_transfer_change

SHARE = 0.02
SIDES = tuple(Coupling(dy, dx, SHARE) for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0)))
KERNEL = (1 - 4 * SHARE) ** 2 + 4 * SHARE**2


def change(bench: Bench, *effects: Effect) -> float:
    return photon_transfer_change(bench, Lag(0.0), effects, recordings(bench))


@pytest.mark.parametrize(
    ("effect", "variance"),
    [
        (Ipc(SIDES), KERNEL),
        (Lag(0.02, 0.0, 0.0), 1.0),
        # Of two successive frames the later has a share of the former's noise too.
        (Lag(0.02, 0.0, 0.0, quiet=1.0), (1 - 0.02) ** 2),
        (GainError(0.05), 1.0),
    ],
    ids=["crosstalk", "lag by single electrons", "lag without noise", "of the gain itself"],
)
def test_the_noise_of_flats_changes_as_the_kernel_says(
    make_effect_bench: Callable[..., Bench], effect: Effect, variance: float
) -> None:
    bench = make_effect_bench({"detector.shape": [121, 127]})
    assert change(bench, effect) == pytest.approx(variance, abs=4e-3)


def test_some_rows_of_a_large_detector_tell_how_its_noise_changes(
    make_effect_bench: Callable[..., Bench],
) -> None:
    bench = make_effect_bench({"detector.shape": [601, 701], "frames.bias": 2})
    assert change(bench, Ipc(SIDES)) == pytest.approx(KERNEL, abs=3 * CHANGE_ERROR)


def test_brighter_fatter_takes_noise_in_proportion_to_the_level(
    make_effect_bench: Callable[..., Bench],
) -> None:
    bench = make_effect_bench({"detector.shape": [61, 67]})
    weak, strong = (1 - change(bench, BrighterFatter(s)) for s in (2e-7, 4e-7))
    assert weak > 0.005
    assert strong == pytest.approx(2 * weak, rel=0.15)


def test_a_bent_response_leaves_the_gain_at_level_zero(
    make_effect_bench: Callable[..., Bench],
) -> None:
    """With so much read noise that it outweighs the photon noise of half of the flats."""
    times = np.linspace(0.002, 0.02, 10)
    bench = make_effect_bench(
        {
            "detector.shape": [121, 127],
            "detector.read_noise_e": 70.0,
            "frames.flats": [{"exptime_s": float(t), "count": 2} for t in times],
        }
    )
    top = bench.frames.flat_rate_e_s
    assert top is not None
    bent = Nonlinearity(quadratic=-0.1, cubic=0.0, level_e=top * times[-1])
    assert change(bench, bent) == pytest.approx(1.0, abs=0.05)


def test_narrow_codes_scale_noise_and_mean_alike(make_effect_bench: Callable[..., Bench]) -> None:
    """A 16th of the codes is 0.8 codes narrow: the response is steeper, and the noise larger."""
    bench = make_effect_bench({"detector.shape": [61, 67], "detector.gain_e_per_adu": 40.0})
    widths = np.zeros(4000)
    widths[15::16] = -0.8
    assert change(bench, Quantisation(0.0, 0.0, 0.0, widths=tuple(widths))) == pytest.approx(
        1 / 0.95, rel=0.01
    )


@pytest.mark.long
def test_hits_change_the_gain_as_much_as_reduce_measures_it(
    make_effect_bench: Callable[..., Bench], acquired: Callable[..., Evidence]
) -> None:
    """Their brightest samples are left out there, and noise that neighbours share counts."""
    hits = {"rate_cm2_s": 3e4, "electrons_per_um": 90.0, "thickness_um": 24.0, "spread": 0.6}
    found = acquired({"detector.shape": [121, 127]}, {"cosmic_hits": hits})
    gain, error, _ = found.photon_transfer
    bench = make_effect_bench({"detector.shape": [121, 127]})
    expected = photon_transfer_change(
        bench, Lag(0.0), [CosmicHits(**hits)], recordings(bench), found.neighbours
    )
    assert expected > 1.02
    assert found.gain / gain == pytest.approx(expected, abs=4 * error / gain)


def test_a_gain_lies_between_what_was_declared_and_measured() -> None:
    gain = MeasuredGain(np.ones((3, 5)), ((1.03, 0.01), (1.03, 0.01)))
    rng = np.random.default_rng(5)
    drawn = np.array([gain.drawn(rng)[0, 0] for _ in range(2000)])
    # The declared value is off by 0.03, and known as well as that.
    weights = np.array([0.03, 0.01, 0.01]) ** -2
    assert drawn.mean() == pytest.approx(np.average([1, 1.03, 1.03], weights=weights), abs=1e-3)
    assert drawn.std() == pytest.approx(weights.sum() ** -0.5, rel=0.1)
    corrected = np.array([gain.drawn(rng, 1 / 1.03)[0, 0] for _ in range(2000)])
    assert corrected.mean() == pytest.approx(1.0, abs=1e-3)


def test_a_declared_gain_that_flats_contradict_does_not_count() -> None:
    gain = MeasuredGain(np.ones((3, 5)), ((1.2, 0.01), (1.2, 0.01)))
    rng = np.random.default_rng(6)
    drawn = np.array([gain.drawn(rng)[0, 0] for _ in range(2000)])
    assert drawn.mean() == pytest.approx(1.2, abs=1e-3)
    assert drawn.std() == pytest.approx(0.01 / np.sqrt(2), rel=0.1)
