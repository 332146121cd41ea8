"""The coupling between pixels, measured three ways and joined.

`hot_pixels` (darks), `covariance` (noise of flats and of fringe residuals) and `maps` (visibility,
and offsets at several baselines) each give least-squares sums over the same unknown shares;
`support` finds which couplings there are, and `joined` what they are worth together.
"""
