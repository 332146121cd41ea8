"""Central crop: the same samples, model and residuals, fewer of them."""

from dataclasses import replace

import numpy as np
import pytest

from pixcal.estimators.diagnosis.central_crop import MIN_SIZE, central_crop
from pixcal.estimators.diagnosis.evidence import Evidence, FringeEvidence, Stack
from pixcal.estimators.fringe_fit.fringes import grid

RNG = np.random.default_rng(6)
T, NY, NX = 50, 77, 91


@pytest.fixture(scope="module")
def evidence() -> Evidence:
    y, x = grid((NY, NX))
    psi = 1.1 * x + 0.3 * y
    phi = 2 * np.pi * RNG.random(T)
    theta = np.stack([np.full(psi.shape, 2e4), 1.8e4 * np.sin(psi), 1.8e4 * np.cos(psi)])
    g = np.stack([np.ones(T), np.cos(phi), np.sin(phi)], axis=1)
    plane = RNG.random((NY, NX))
    fringes = FringeEvidence(
        "set",
        (6.0, 0.0),
        (1.1, 0.3),
        (10, 20),
        (100, 120),
        np.arange(T),
        0.14 * np.arange(T),
        0.02,
        RNG.random((T, NY, NX)).astype(np.float32),
        RNG.integers(0, 9, (T, NY, NX)),
        g,
        1e-3 * RNG.standard_normal((T, 2)),
        np.zeros((T, 5)),
        np.zeros((T, 5, 5)),
        theta,
        plane,
        plane,
        plane > 0.1,
        plane,
        plane,
    )
    stack = Stack(
        "dark", 0.5, np.arange(4), np.arange(4.0), RNG.random((4, NY, NX)).astype(np.float32)
    )
    return Evidence(
        {"set": fringes},
        (stack,),
        1.0,
        16.0,
        16.0,
        plane,
        plane,
        plane,
        plane > 0.1,
        65535.0,
        4.4,
        632.8,
        400.0,
        origin=(10, 20),
    )


@pytest.mark.parametrize("samples", [T * 40 * 50, T * NY * NX // 2, 5000])
def test_every_array_is_of_the_same_pixels(evidence: Evidence, samples: int) -> None:
    part, whole = central_crop(evidence, samples), evidence.fringes["set"]
    (ny, nx), (y0, x0) = part.good.shape, part.origin
    y, x = slice(y0 - 10, y0 - 10 + ny), slice(x0 - 20, x0 - 20 + nx)
    cut = part.fringes["set"]
    t = slice(0, len(cut.g))
    assert cut.electrons.size <= max(samples, MIN_SIZE**3) * 1.2
    assert min(ny, nx, len(cut.g)) >= MIN_SIZE
    assert cut.origin == part.origin
    assert np.array_equal(cut.electrons, whole.electrons[t, y, x])
    assert np.array_equal(part.stacks[0].adu, evidence.stacks[0].adu[:, y, x])
    assert np.array_equal(part.flat, evidence.flat[y, x])
    # The change of the fringe vector turns about the same middle.
    np.testing.assert_allclose(cut.model, whole.model[t, y, x], atol=0.02)
    np.testing.assert_allclose(cut.residual, whole.residual[t, y, x], atol=0.02)


def test_little_evidence_stays_whole(evidence: Evidence) -> None:
    assert central_crop(evidence) is evidence
    flats = replace(evidence, fringes={})
    assert central_crop(flats) is flats
