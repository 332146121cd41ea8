"""Time series of frames: light, offset, fringe vector, lines and rows."""
