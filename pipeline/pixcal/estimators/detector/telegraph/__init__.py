"""Telegraph noise of a population of pixels.

`moments` measures each pixel, `classes` gives its likelihood for each amplitude, `population` gives
the number and amplitudes of pixels that jump, `dwell` their dwell times; `find` combines them.
"""
