"""Fix the gauge freedom of free intensities.

The data do not change when theta -> Q theta and g -> Q^-T g (physics note, section 2). Of Q's nine
numbers, four appear in the phase map, as fringes at the fringe frequency and twice it: with
z = alpha exp(i psi), the change z' = z + b conj(z) + c iota shifts the phase by

    Im(b exp(-2 i psi)) + Im(c (iota / alpha) exp(-i psi))

They are chosen so that the phase map contains none of these fringes.
"""

import numpy as np

from pixcal.model.arrays import C128, F64, Mask

# modes of the phase map that free intensities and amplitudes of frames leave undetermined
FRINGE_MODES = ("cos(psi)*iota/alpha", "sin(psi)*iota/alpha", "cos(2*psi)", "sin(2*psi)")


def fringe_modes(psi: F64, ratio: F64) -> list[F64]:
    """The four fringe-frequency modes of the phase map, from psi (rad) and iota / alpha."""
    return [ratio * np.cos(psi), ratio * np.sin(psi), np.cos(2 * psi), np.sin(2 * psi)]


def gauge_matrix(tiles: list[tuple[F64, Mask, C128]]) -> F64:
    """Change Q (3, 3) of theta that removes the fringe-frequency modes from the phase maps.

    The new parameters are ``Q @ theta``, the frames ``g @ inv(Q)``. ``tiles``: theta (3, y, x),
    good pixels, and the smooth phasor that defines the modes, of each tile.
    """
    rows, rights, light_rows, light_rights = [], [], [], []
    for theta, good, smooth in tiles:
        iota, z = theta[0], theta[2] + 1j * theta[1]
        y, x = np.nonzero(good)
        s, n = smooth[good], len(y)
        if n < 30:
            continue
        rest = np.angle(z[good] * s.conj())
        ux, uy = (x - x.mean()) / (np.ptp(x) + 1), (y - y.mean()) / (np.ptp(y) + 1)
        terms = np.stack([np.ones(n), ux, uy, ux * ux, ux * uy, uy * uy], axis=1)
        psi, ratio = np.angle(s), 1 / np.abs(s)
        modes = np.stack(fringe_modes(psi, ratio), axis=1)
        light = np.stack([np.cos(psi), np.sin(psi)], axis=1)
        # Light is smooth. Clip it, lest a few pixels of unknown response dominate the fit.
        level = np.clip(iota[good] / np.median(iota[good]), 0.0, 2.0)
        # Each tile has its own smooth phase and light: remove them before joining the tiles.
        q, _ = np.linalg.qr(terms)
        rows.append(modes - q @ (q.T @ modes))
        rights.append(rest - q @ (q.T @ rest))
        light_rows.append(light - q @ (q.T @ light))
        light_rights.append(level - q @ (q.T @ level))
    matrix = np.eye(3)
    if not rows:
        return matrix
    (cos1, sin1, cos2, sin2), (light_cos, light_sin) = (
        np.linalg.lstsq(np.concatenate(design), np.concatenate(right), rcond=None)[0]
        for design, right in ((rows, rights), (light_rows, light_rights))
    )
    # Im(c e^-i psi) = c_i cos - c_r sin, Im(b e^-2i psi) = b_i cos 2 - b_r sin 2; to subtract.
    c, b = complex(-sin1, cos1), complex(-sin2, cos2)
    # theta = (iota, Im z, Re z); z -= b conj(z) + c iota.
    matrix[1] += [-c.imag, b.real, -b.imag]
    matrix[2] += [-c.real, -b.imag, -b.real]
    # Fringes of the mean light, light_cos cos psi + light_sin sin psi, with |z| / iota = V.
    visibility = float(np.median(np.concatenate([np.abs(s[good]) for _, good, s in tiles])))
    matrix[0] += [0.0, -light_sin / visibility, -light_cos / visibility]
    return matrix
