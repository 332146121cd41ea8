"""Detector characterisation: calibration frames, response, noise of pixels, charge."""
