"""Thresholds and widths of codes from the weights of their bits."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pixcal.model.arrays import F64, I64


class Law(NamedTuple):
    """Threshold of a code, given the levels made by the weights of its bits."""

    below: float  # weight of the level of the code below in a threshold
    any_code: bool = False  # whether that is the code of the next lower level, whatever its number


# Successive approximation sets a bit if it fits; other converters take the nearest level, of two
# consecutive codes or of all.
FITS, NEAREST, NEAREST_OF_ALL = Law(0.0), Law(0.5), Law(0.5, any_code=True)


@dataclass(frozen=True)
class WrongBits:
    """Errors of the weights of bits, and their significance."""

    bits: F64  # (n,) errors, codes, lowest bit first
    law: Law
    covariance: F64  # (n, n)
    chi2: float  # of the bits: the fall of the misfit
    misfit: float  # chi-square of the widths after correction


def level_errors(bits: F64, codes: int) -> F64:
    """Shifts (codes) of the levels of codes 0 to ``codes - 1`` by errors of bit weights."""
    errors = np.zeros(1)
    for bit in bits:
        errors = np.concatenate([errors, errors + bit])
    return errors[:codes] if len(errors) >= codes else np.resize(errors, codes)


def code_cells(bits: F64, law: Law, codes: int) -> tuple[F64, I64]:
    """Threshold of each code, and the codes in the order of their thresholds.

    ``bits``: (n,) error (codes) of the weight of each bit, lowest bit first.
    """
    level = np.arange(codes) + level_errors(bits, codes)
    order = np.argsort(level, kind="stable") if law.any_code else np.arange(codes)
    level = level[order]
    lower = np.concatenate([[level[0] - 1], level[:-1]])
    return level - 0.5 + law.below * (lower + 1 - level), order
