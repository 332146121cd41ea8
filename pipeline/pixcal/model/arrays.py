"""Array types by data type; docstrings give shapes and units."""

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

C128 = NDArray[np.complex128]
F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]


class Source(Protocol):
    """A map (y, x) that is read block by block, such as an array on disk."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows and columns."""

    def read(self, *ranges: tuple[int, int]) -> NDArray[Any]:
        """A block, given (start, stop) of rows and of columns."""
