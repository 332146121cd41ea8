"""The simulated bench: recordings, and the steps from light to samples."""
