"""Alternatives to ``pixcal fit``, as short as a user would write them.

Each module has ``fit_phases(cube, vector, ...)``: from frames in electrons (t, y, x), float64, and
the nominal fringe vector (kx, ky) in rad/px to the phase of the pixels in rad. All estimate the
frames' phases themselves. None uses the truth of a simulation.
"""
