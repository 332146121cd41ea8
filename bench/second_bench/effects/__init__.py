"""Faults of a bench."""

from second_bench.effects import charge, electronics, fringes, light, outside, particles, response
from second_bench.effects.law import LAWS, Law, laws_of

__all__ = [
    "LAWS",
    "Law",
    "charge",
    "electronics",
    "fringes",
    "laws_of",
    "light",
    "outside",
    "particles",
    "response",
]
