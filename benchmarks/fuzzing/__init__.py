"""Bad input for pixcal, made at random and judged without its code: `python benchmarks/fuzz.py`."""
