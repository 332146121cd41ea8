"""The coupling between pixels, as a kernel.

Three `sources` measure shares: the noise that neighbours have in common (`covariance` of
`residuals`), the surroundings of `hot_pixels`, and the `maps` of a fit. `support` detects the
significant links; `kernel` chooses the period and measures all couplings within two pixels jointly.
"""
