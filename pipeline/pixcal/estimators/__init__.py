"""From arrays of samples to fringe parameters, maps, detector properties, test statistics."""
