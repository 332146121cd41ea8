"""Star centroids: the effect of the offsets, and their correction."""
