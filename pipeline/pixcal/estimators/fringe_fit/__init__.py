"""Fringe fit: phases of the frames and maps of the pixels from sums over the samples."""
