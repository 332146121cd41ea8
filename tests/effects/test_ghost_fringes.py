"""Ghost fringes: what a third field does to mean light and fringes, and found again."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from all_frames import frames_of

from pixcal.effects.ghost_fringes import GhostFringes, GhostWave
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.estimators.maps import map_waves
from pixcal.model.bench import Bench
from pixcal.simulation.effect import FringeMaps
from pixcal.simulation.recording import recordings


def plain_maps(k: tuple[float, float]) -> FringeMaps:
    y, x = np.mgrid[:40, :50]
    psi = k[0] * x + k[1] * y
    return FringeMaps(2e4 * np.stack([np.ones_like(psi), np.sin(psi), np.cos(psi)]), k)


def beam_maps(weights: dict[str, float], share: float) -> np.ndarray:
    """Maps that follow from the fields of fibres A (modulated) and B and a weak third beam.

    ``weights``: whose reflection the third beam is, and whether it meets the other fibre.
    """
    y, x = np.mgrid[:40, :50]
    psi, chi = 1.2 * x, 0.3 * x - 0.2 * y + 0.7
    phi = 2 * np.pi * np.arange(12) / 12
    turn = np.exp(1j * (psi + phi[:, None, None]))
    # A carries the modulator's phase; each ghost is its parent's field times share exp(i chi).
    a, b = turn, np.ones_like(turn)
    ghost_a, ghost_b = (share * w * np.exp(1j * chi) for w in (weights["a"], weights["b"]))
    intensity = np.abs(a + b + ghost_a * a + ghost_b * b) ** 2
    if weights.get("crossed"):
        intensity = np.abs(a + b) ** 2 + 2 * np.real(ghost_b)
    design = np.stack([np.ones(12), np.cos(phi), np.sin(phi)], axis=1)
    mean, cosine, sine = np.tensordot(np.linalg.pinv(design), intensity, 1)
    # cos(psi + phi): the phasor of cos phi is cos psi, of sin phi is -sin psi.
    return np.stack([mean, -sine, cosine])


@pytest.mark.parametrize(
    ("parent", "weights"),
    [
        ("modulated", {"a": 1.0, "b": 0.0}),
        ("fixed", {"a": 0.0, "b": 1.0}),
        ("both", {"a": 1.0, "b": 1.0}),
        ("crossed", {"a": 0.0, "b": 1.0, "crossed": True}),
    ],
)
def test_it_is_what_a_third_field_does(parent: str, weights: dict[str, float]) -> None:
    """To first order in the ghost's amplitude; the second is its own intensity."""
    _, x = np.mgrid[:40, :50]
    plain = FringeMaps(
        2 * np.stack([np.ones(x.shape), np.sin(1.2 * x), np.cos(1.2 * x)]), (1.2, 0.0)
    )
    ghost = GhostFringes(1e-3, (0.3, -0.2), 0.7, parent)
    np.testing.assert_allclose(ghost.predict(plain).theta, beam_maps(weights, 1e-3), atol=1e-5)
    np.testing.assert_allclose(ghost.undo(ghost.predict(plain)).theta, plain.theta, atol=1e-12)


def test_waves_of_a_set_are_of_that_set_alone() -> None:
    maps = plain_maps((1.2, 0.0))
    wave = GhostWave((0.3, -0.2), "vertical", (0.01, 0.0), (0.0, 0.004), (0.003, 0.0))
    ghost = GhostFringes(0.0, waves=(wave,))
    other = ghost.predict(replace(maps, name="horizontal"))
    np.testing.assert_allclose(other.theta, maps.theta, rtol=1e-15)
    own = ghost.predict(replace(maps, name="vertical"))
    y, x = np.mgrid[:40, :50]
    # The ghosts' own light: 0.007 of the modulated fibre's field, 0.003 of the other's.
    itself = (0.007**2 + 0.003**2) / 2
    np.testing.assert_allclose(own.theta[0] / 2e4, 1 + itself + 0.01 * np.cos(0.3 * x - 0.2 * y))
    assert not ghost.is_null
    assert ghost.scaled(0.0).is_null


def test_frames_hold_it(make_effect_bench: Callable[..., Bench]) -> None:
    """Mean of many frames: static fringes of its own vector; flats only where they are coherent."""
    bench = make_effect_bench(
        {"detector.shape": [32, 36], "frames.flats": [{"exptime_s": 0.02, "count": 40}]}
    )
    y, x = np.mgrid[:32, :36]
    carrier = np.exp(-1j * (0.35 * x + 0.2 * y))
    for in_flats in (False, True):
        ghost = GhostFringes(0.05, parent="crossed", in_flats=in_flats)
        for r in recordings(bench):
            if r.kind not in ("flat", "fringes"):
                continue
            plain, on = (frames_of(bench, r, e).mean(axis=0) for e in ((), (ghost,)))
            wave = 2 * np.mean((on / plain - 1) * carrier).real
            # Bias and dark dilute it by some per cent.
            expected = 0.05 if in_flats or r.kind == "fringes" else 0.0
            assert wave == pytest.approx(expected, abs=0.003)


@pytest.mark.long
@pytest.mark.parametrize(
    ("parent", "share", "in_flats"),
    [
        ("modulated", 5e-4, False),
        ("modulated", 5e-3, False),
        ("fixed", 5e-3, False),
        ("crossed", 5e-3, False),
        ("crossed", 5e-3, True),
    ],
)
def test_it_is_found_with_its_parent(
    acquired: Callable[..., Evidence], parent: str, share: float, in_flats: bool
) -> None:
    on = {"share": share, "phase_rad": 1.0, "parent": parent, "in_flats": in_flats}
    evidence = acquired(None, {"ghost_fringes": on})
    found = GhostFringes.estimate(evidence)
    assert found is not None
    assert isinstance(found.effect, GhostFringes)
    assert found.effect.in_flats == in_flats
    assert GhostFringes.detect(evidence) == pytest.approx(found.significance)
    assert found.significance > 5
    wave = np.exp(1j)
    wanted = {
        "static": share * wave.conjugate(),
        "forward": share * wave * (parent == "modulated"),
        "backward": share * wave.conjugate() * (parent == "fixed"),
    }
    for n, one in enumerate(found.effect.waves):
        # Of the wave of opposite vector the two sides change places.
        turned = one.beat_rad_px[0] < 0
        beat = np.array(one.beat_rad_px) * (-1 if turned else 1)
        own = {key: complex(*getattr(one, key)) for key in wanted}
        if turned:
            own = {
                "static": own["static"].conjugate(),
                "forward": own["backward"],
                "backward": own["forward"],
            }
        for axis, true in enumerate((0.35, 0.2)):
            error = found.errors[f"waves[{n}].beat_rad_px[{axis}]"]
            assert abs(beat[axis] - true) < 4 * error
        for key, value in own.items():
            # The phase is counted from the corner: the beat's error comes in 33 pixels away.
            error = found.errors[f"waves[{n}].{key}[0]"] + 40 * share * error
            assert abs(value - wanted[key]) < 5 * error, key
    if share > 1e-3 and not turned:
        assert parent in found.law
    # Static fringes alone may be of the lamp, or of anything.
    assert found.law_predicts == (parent != "crossed")
    if parent == "crossed":
        # Static fringes alone do nothing to the maps of offsets.
        assert not any(any(w.forward + w.backward) for w in found.effect.waves)


@pytest.mark.quick(1)
@pytest.mark.parametrize("other", ["ipc", "nonlinearity", "flat_error"])
def test_others_are_not_taken_for_it(acquired: Callable[..., Evidence], other: str) -> None:
    found = GhostFringes.estimate(acquired(None, {other: {}}))
    assert found is not None
    assert found.significance < 4


@pytest.mark.long
def test_crosstalk_of_every_other_row_is_not_taken_for_it(
    acquired: Callable[..., Evidence], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is a wave in phase and visibility too, of rows that repeat."""
    coupling = {"dy": 1, "dx": 0, "share": 0.0023, "every_rows": 2}
    for of_lines in (map_waves.PERIODS, ()):
        monkeypatch.setattr(map_waves, "PERIODS", of_lines)
        found = GhostFringes.estimate(acquired(None, {"ipc": {"couplings": [coupling]}}))
        assert found is not None
        assert found.significance < 4


def test_ghosts_of_both_fibres_need_not_be_in_phase(acquired: Callable[..., Evidence]) -> None:
    """Their static pattern is the sum of both, whatever is between them."""
    of_one, of_other = 0.004, 0.004 * np.exp(2j)
    static = of_one + of_other
    wave = {
        "beat_rad_px": [0.35, 0.2],
        "static": [float(static.real), -float(static.imag)],
        "forward": [of_one, 0.0],
        "backward": [float(of_other.real), -float(of_other.imag)],
    }
    evidence = acquired(None, {"ghost_fringes": {"share": 0.0, "waves": [wave]}})
    found = GhostFringes.estimate(evidence)
    assert found is not None
    assert found.significance > 20
    assert found.law == "ghosts of both fibres"
    assert not found.effect.in_flats
    for one, other in zip(found.effect.waves, found.by_law.waves, strict=True):
        np.testing.assert_allclose(one.static, other.static, atol=1e-3)
        np.testing.assert_allclose(one.forward, other.forward, atol=1e-3)


def test_a_ghost_may_have_the_vector_of_the_fringes_of_another_set(
    acquired: Callable[..., Evidence],
) -> None:
    """Of these it is no harmonic."""
    beat = (0.03, 0.53)
    wave = {"beat_rad_px": list(beat), "set": "vertical", "static": [0.01, 0.0]}
    # A period of 11.5 px: those of up to 8 may be the electronics'.
    changes = {"frames.fringes.1.baseline_mm": [0.0, 5.0]}
    evidence = acquired(changes, {"ghost_fringes": {"share": 0.0, "waves": [wave]}})
    of_other = next(f.k for f in evidence.fringes.values() if f.name == "horizontal")
    assert np.hypot(*np.subtract(of_other, beat)) < 2 * np.pi / max(evidence.good.shape)
    found = GhostFringes.estimate(evidence)
    assert found is not None
    assert found.significance > 20
    n, own = next((n, w) for n, w in enumerate(found.effect.waves) if w.set == "vertical")
    sign = np.sign(own.beat_rad_px[1])
    for axis in (0, 1):
        error = found.errors[f"waves[{n}].beat_rad_px[{axis}]"]
        assert abs(sign * own.beat_rad_px[axis] - beat[axis]) < 4 * error


@pytest.mark.parametrize("apart", [0.0, 0.024])
def test_ghosts_of_both_fibres_move_phases_where_they_are_not_in_phase(
    acquired: Callable[..., Evidence], apart: float
) -> None:
    """A window reflects both fibres alike in every set, but its paths differ; a flat has no paths.

    ``apart``: difference of the two beats, rad/px. The ghosts are in phase in the middle.
    """
    waves = []
    for sign, key in ((1, "forward"), (-1, "backward")):
        qx = 0.35 + sign * apart / 2
        own = 0.02 * np.exp(1j * (0.35 - qx) * 33)
        pair = own if key == "forward" else own.conjugate()
        waves.append(
            {
                "beat_rad_px": [qx, 0.2],
                "static": [float(own.real), -float(own.imag)],
                key: [float(pair.real), float(pair.imag)],
            }
        )
    found = GhostFringes.estimate(acquired(None, {"ghost_fringes": {"share": 0.0, "waves": waves}}))
    assert found is not None
    assert found.law == "ghosts of both fibres"
    assert found.significance > 20 if apart else found.significance == 0


@pytest.mark.long
def test_a_pattern_of_mean_light_and_fringes_alike_in_all_sets_is_the_flats(
    acquired: Callable[..., Evidence],
) -> None:
    """Ghosts of both fibres that are in phase everywhere are the same, and move no offset."""
    on = {"share": 2e-3, "phase_rad": 1.0, "parent": "both"}
    evidence = acquired(None, {"ghost_fringes": on})
    found = GhostFringes.estimate(evidence)
    assert found is not None
    assert found.law == "ghosts of both fibres"
    assert found.significance == 0
    without = GhostFringes.estimate(replace(evidence, stacks=()))
    assert without is not None
    assert without.significance > 5


@pytest.mark.parametrize("parent", ["modulated", "fixed", "both", "crossed"])
def test_a_measured_wave_is_the_ghosts_that_made_it(parent: str) -> None:
    """Static, forward and backward amplitudes by themselves give the maps of the ghost."""
    size, turn, beat = 0.01, 0.7, (0.31, -0.2)
    ghost = GhostFringes(size, beat, turn, parent)
    a, b = size * np.exp(1j * turn), size * np.exp(-1j * turn)
    moving = parent in ("modulated", "both"), parent in ("fixed", "both")
    static = (1 + (parent == "both")) * b
    wave = GhostWave(
        beat,
        static=(static.real, static.imag),
        forward=(a.real, a.imag) if moving[0] else (0.0, 0.0),
        backward=(b.real, b.imag) if moving[1] else (0.0, 0.0),
    )
    maps = FringeMaps(np.random.default_rng(3).random((3, 19, 23)) + 1, (0.7, 0.1), (5, 40))
    expected = ghost.predict(maps).theta
    found = GhostFringes(0.0, beat, waves=(wave,)).predict(maps).theta
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    y, x = np.indices((19, 23))
    wave_of_mean = 1 + (1 + (parent == "both")) * size * np.cos(
        beat[0] * (x + 40) + beat[1] * (y + 5) + turn
    )
    # But for the ghost's own light.
    np.testing.assert_allclose(found[0], maps.theta[0] * wave_of_mean, rtol=2 * size**2)
