"""Charge transfer: trails that grow away from the output; told from crosstalk."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from astropy.io import fits
from numpy.typing import NDArray

import pixcal
from pixcal.effects.charge_transfer import ChargeTransfer
from pixcal.effects.ipc import Ipc
from pixcal.estimators.diagnosis.evidence import Evidence, Stack
from pixcal.kernels.crosstalk import Coupling
from pixcal.model.bench import Bench
from pixcal.model.errors import InputError

F64 = NDArray[np.float64]
SHAPE = (230, 250)


def evidence_of(signal: F64) -> Evidence:
    """Darks of one second with that signal (y, x), e-."""
    rng = np.random.default_rng(5)
    shape = signal.shape
    noisy = signal + rng.standard_normal(shape)
    stack = Stack("dark", 1.0, np.arange(2), np.arange(2.0), np.stack([noisy] * 2).astype("f4"))
    return Evidence(
        fringes={},
        stacks=(stack,),
        gain=1.0,
        read_noise=3.0,
        amplifier_noise=3.0,
        bias=np.zeros(shape),
        dark_rate=noisy,
        flat=np.ones(shape),
        good=np.ones(shape, np.bool_),
        saturation_adu=65535.0,
        pitch_um=15.0,
        wavelength_nm=633.0,
        distance_mm=400.0,
    )


def hot_pixels(seed: int = 6, shape: tuple[int, int] = SHAPE, count: int = 150) -> F64:
    rng = np.random.default_rng(seed)
    found = np.full(shape, 20.0)
    found.ravel()[rng.choice(found.size, count, replace=False)] += 10 ** rng.uniform(3, 4.5, count)
    return found


def clocked(signal: F64, capacity: float, release: float) -> F64:
    """Line by line to the output at line 0: traps of each line fill, and release a share.

    An independent model (Massey et al. 2010): a charge q fills ``capacity (q / 1e4)^0.6`` of the
    traps that it passes, those of each line on its way being alike.
    """
    passed = np.arange(1, len(signal) + 1)[:, None]
    read, trapped = np.zeros_like(signal), np.zeros(signal.shape[1])
    for y, line in enumerate(signal):
        out = trapped * (1 - np.exp(-1 / release))
        room = np.maximum(capacity * (np.maximum(line, 0) / 1e4) ** 0.6 - trapped + out, 0)
        read[y] = line - passed[y] * (room - out)
        trapped += room - out
    return read


@pytest.mark.parametrize("turn", [0, 1, 2, 3])
def test_trails_of_traps_are_measured_from_any_corner(turn: int) -> None:
    signal = np.rot90(clocked(np.rot90(hot_pixels(), turn), 0.4, 2.5), -turn)
    found = ChargeTransfer.estimate(evidence_of(signal))
    assert found is not None
    assert found.significance > 10
    made = found.effect
    assert isinstance(made, ChargeTransfer)
    own, other = ("rows", "columns") if turn % 2 == 0 else ("columns", "rows")
    assert getattr(made, other) == 0
    loss = getattr(made, own) * (1e4 / made.level_e) ** (made.power - 1)
    assert loss == pytest.approx(0.4e-4, rel=0.15)
    assert made.power == pytest.approx(0.6, abs=0.06)
    assert getattr(made, f"{own[:-1]}_release_px") == pytest.approx(2.5, rel=0.25)
    place = getattr(made, f"output_{own[:-1]}")
    edge = 0 if turn in (0, 3) else SHAPE[turn % 2] - 1
    assert abs(place - edge) < 15


def test_loss_and_power_are_within_their_errors() -> None:
    """The place of the output is free too, and few hot pixels show it."""
    pulls = []
    for seed in range(20):
        signal = clocked(hot_pixels(seed, (110, 120), 50), 0.5, 2.5)
        found = ChargeTransfer.estimate(evidence_of(signal))
        assert found is not None
        made = found.effect
        assert isinstance(made, ChargeTransfer)
        if not made.is_null:
            true = 0.5e-4 * (made.level_e / 1e4) ** (0.6 - 1)
            errors = np.array([found.errors[name] for name in ("rows", "power")])
            pulls.append(np.array([made.rows - true, made.power - 0.6]) / errors)
    assert len(pulls) > 10
    assert (np.sqrt(np.mean(np.square(pulls), axis=0)) < 1.6).all()


def test_it_is_no_crosstalk() -> None:
    with pytest.raises(InputError, match="incomplete charge transfer"):
        Ipc.estimate(evidence_of(clocked(hot_pixels(), 0.4, 2.5)))


def test_crosstalk_is_no_charge_transfer() -> None:
    """Nor to one side alone."""
    kernel = Ipc((Coupling(1, 0, 0.01), Coupling(2, 0, 0.003)))
    signal = kernel.signal(hot_pixels().astype(np.float32), SimpleNamespace(rows=SHAPE))  # type: ignore[arg-type]
    for size in (signal, hot_pixels()):
        found = ChargeTransfer.estimate(evidence_of(size.astype(float)))
        assert found is not None
        assert found.significance < 4
        assert found.effect.is_null


def test_signals_that_two_outputs_in_the_middle_drag_along_are_no_charge_transfer() -> None:
    signal = hot_pixels()
    read, half = signal.copy(), SHAPE[1] // 2
    read[:, : half - 1] += 0.015 * (signal[:, 1:half] - 20)
    read[:, half + 1 :] += 0.015 * (signal[:, half:-1] - 20)
    found = ChargeTransfer.estimate(evidence_of(read))
    assert found is not None
    assert found.effect.is_null


@pytest.mark.parametrize("output", [0, 50, 99])
def test_charge_is_kept_and_trails_grow(
    make_effect_bench: Callable[..., Bench], output: int
) -> None:
    bench = make_effect_bench({"detector.shape": [100, 60]})
    effect = ChargeTransfer(1e-4, row_release_px=1.5, output_row=output)
    signal = np.zeros((100, 60), np.float32)
    signal[[20, 80], 30] = 1e4
    shot: Any = SimpleNamespace(bench=bench, rows=(0, 100))
    found = effect.signal(signal, shot)
    assert found.sum() == pytest.approx(signal.sum(), rel=1e-3)
    lost = 1 - found[[20, 80], 30] / 1e4
    assert lost == pytest.approx(1e-4 * (np.abs(np.array([20, 80]) - output) + 1), rel=1e-3)
    for row, share in zip((20, 80), lost, strict=True):
        behind = 1 if row > output else -1
        assert found[row + behind, 30] == pytest.approx(1e4 * share * (1 - np.exp(-1 / 1.5)), 1e-3)
        assert abs(found[row - behind, 30]) < 1e-6


@pytest.mark.parametrize("capacity", [0.4, 0.0])
def test_reduce_tells_trails(capacity: float, tmp_path: Path) -> None:
    rng, mean = np.random.default_rng(7), clocked(hot_pixels(), capacity, 2.5)
    (tmp_path / "acq").mkdir()
    for kind, seconds in (("bias", 0.0), ("dark", 50.0)):
        noise = 3 * rng.standard_normal((8, *SHAPE))
        samples = np.rint(1000 + noise + (mean if seconds else 0)).astype(np.uint16)
        path = tmp_path / "acq" / f"{kind}.fits"
        fits.writeto(path, samples, fits.Header({"EXPTIME": seconds}))
    listed = {
        "schema": "pixcal/acquisition/1",
        "detector": {"pitch_um": 15.0, "read_noise_e": 3.0, "gain_e_per_adu": 1.0},
        "frames": {"bias": ["bias.fits"], "dark": ["dark.fits"]},
    }
    (tmp_path / "acq" / "acquisition.yaml").write_text(yaml.safe_dump(listed))
    reduction = pixcal.reduce(pixcal.ingest(tmp_path / "acq", tmp_path / "run")).reduction
    said = [w for w in reduction["warnings"] if "incomplete transfer" in w]
    assert bool(said) == (capacity > 0)
    assert all("along columns" in w and "along rows" not in w for w in said)
