"""The bench in software: what is recorded, and the steps from light to samples."""
