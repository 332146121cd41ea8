"""Telegraph noise of a population of pixels.

`moments` measures each pixel, `classes` gives its likelihood for each amplitude, `population` how
many pixels jump, how far and how often, `dwell` how long they stay; `find` combines them.
"""
