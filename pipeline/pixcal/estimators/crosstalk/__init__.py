"""The coupling between pixels, measured three ways and joined.

`support` detects couplings, and their period, in the noise that neighbours share (`covariance`) and
around `hot_pixels`. For that period `dense` measures all couplings within two pixels, from these
and the `pattern` of the maps (visibility and offsets of all sets), each shrunk by its error;
`joined` selects the significant ones.
"""
