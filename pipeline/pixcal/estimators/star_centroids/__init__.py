"""Star centroids: what the offsets do to them, and their correction."""
