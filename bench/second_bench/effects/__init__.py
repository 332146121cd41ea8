"""Faults of a bench."""

from second_bench.effects import charge, electronics, fringes, light, outside, particles, response
from second_bench.effects.law import LAWS, Law

__all__ = [
    "LAWS",
    "Law",
    "charge",
    "electronics",
    "fringes",
    "light",
    "outside",
    "particles",
    "response",
]
