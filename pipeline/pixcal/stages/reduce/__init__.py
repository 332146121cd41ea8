"""From raw frames to electrons: calibration frames, detector, bad pixels, reduced cubes."""

from pixcal.stages.reduce.stage import Config, run

__all__ = ["Config", "run"]
