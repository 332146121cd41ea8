"""Random bad input for pixcal, judged without its code: `python benchmarks/fuzz.py`."""
