"""The gauge's modes: what they are, and that they are taken out."""

import numpy as np

from pixcal.estimators.fringe_fit.gauge import fringe_modes, gauge_matrix


def tile(b=0.0, c=0.0, d=0.0, seed=0):
    """theta turned by z += b conj(z) + c iota and iota += Re(conj(d) z)."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:53, :61]
    psi = 1.21 * x + 0.13 * y + 5e-3 * rng.normal(size=x.shape)
    iota = 2e4 * (1 + 1e-3 * rng.normal(size=x.shape)) * np.exp(-((x - 20) ** 2) / 1e5)
    z = 0.85 * iota * np.exp(1j * psi)
    changed = z + b * z.conj() + c * iota
    light = iota + (np.conj(d) * z).real
    theta = np.stack([light, changed.imag, changed.real])
    smooth = 0.85 * np.exp(1j * (1.21 * x + 0.13 * y))
    return theta, np.ones(x.shape, bool), smooth, psi


def test_a_change_of_gauge_moves_the_phase_by_the_four_modes():
    b, c = 1e-4 * (2 - 1j), 1e-4 * (-1 + 3j)
    theta, _, _, psi = tile(b, c)
    moved = np.angle((theta[2] + 1j * theta[1]) * np.exp(-1j * psi))
    modes = np.stack(fringe_modes(psi, np.asarray(1 / 0.85))).reshape(4, -1)
    coefficients = np.linalg.lstsq(modes.T, moved.ravel(), rcond=None)[0]
    np.testing.assert_allclose(coefficients, [c.imag, -c.real, b.imag, -b.real], atol=2e-7)


def test_the_gauge_matrix_undoes_it():
    b, c, d = 3e-3 * (2 - 1j), 3e-3 * (-1 + 3j), 4e-3 * (1 + 1j)
    still, *_ = tile()
    theta, good, smooth, _ = tile(b, c, d)
    for _ in range(3):
        theta = np.einsum("ij,jyx->iyx", gauge_matrix([(theta, good, smooth)]), theta)
    reference = np.einsum("ij,jyx->iyx", gauge_matrix([(still, good, smooth)]), still)
    np.testing.assert_allclose(theta, reference, atol=2e-4 * 2e4)
    phase = np.angle((theta[2] + 1j * theta[1]) * smooth.conj())
    psi = np.angle(smooth)
    modes = np.stack(fringe_modes(psi, np.asarray(1 / 0.85))).reshape(4, -1)
    y, x = np.mgrid[:53, :61]
    smooth_terms = np.stack([np.ones(x.shape), x, y, x * x, x * y, y * y]).reshape(6, -1)
    basis = np.concatenate([modes, smooth_terms])
    left = np.linalg.lstsq(basis.T, phase.ravel(), rcond=None)[0][:4]
    assert np.abs(left).max() < 2e-6
