"""The derived arrays of evidence, against the formulae in double precision."""

import numpy as np
import pytest

from pixcal.estimators.diagnosis.evidence import FringeEvidence

SHAPE = (23, 17)


@pytest.mark.parametrize("size", [0.0, 1e-4])
def test_model_and_variance_are_the_formulae(size: float) -> None:
    rng = np.random.default_rng(1)
    n, (ny, nx) = 12, SHAPE
    phi = rng.uniform(0, 6, n)
    g = np.stack([rng.uniform(0.9, 1.1, n), np.cos(phi), np.sin(phi)], axis=1)
    theta = 2e4 * np.stack([rng.uniform(1, 2, SHAPE), *rng.uniform(-0.7, 0.7, (2, *SHAPE))])
    theta[:, 3, 4] = np.nan
    dk = size * rng.standard_normal((n, 2))
    read, shot = rng.uniform(4, 9, SHAPE), rng.uniform(0.9, 1.1, SHAPE)
    y, x = np.arange(ny)[:, None] - (ny - 1) / 2, np.arange(nx) - (nx - 1) / 2
    slope = g[:, 1, None, None] * theta[2] - g[:, 2, None, None] * theta[1]
    turn = dk[:, 0, None, None] * x + dk[:, 1, None, None] * y
    model = np.einsum("ti,iyx->tyx", g, theta) + turn * slope
    samples = (model + 1).astype(np.float32)
    found = FringeEvidence(
        "vertical",
        (0.3, 0.0),
        (0.3, 0.0),
        (0, 0),
        SHAPE,
        np.arange(n),
        np.arange(n, dtype=float),
        0.02,
        samples,
        samples,
        g,
        dk,
        np.zeros((n, 5)),
        np.zeros((n, 5, 5)),
        theta,
        np.ones(SHAPE),
        np.zeros(SHAPE),
        np.isfinite(theta[0]),
        read,
        shot,
    )
    assert found.model.dtype == found.residual.dtype == found.variance.dtype == np.float32
    np.testing.assert_allclose(found.model, model, atol=3e-7 * np.nanmax(model), rtol=0)
    variance = shot * np.maximum(model, 0) + read
    np.testing.assert_allclose(found.variance, variance, rtol=1e-5)
    good = found.good
    np.testing.assert_allclose(found.residual[:, good], 1, atol=0.02)
    assert np.isnan(found.residual[:, ~good]).all()
