"""Telegraph noise of a population of pixels.

`moments` has what is measured of each pixel, `classes` how likely that is for each amplitude,
`population` how many jump, how far and how often; `find` puts them together.
"""
