"""Array aliases used in signatures."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]
Ints: TypeAlias = NDArray[np.int64]
Bools: TypeAlias = NDArray[np.bool_]


def frozen(array: NDArray, dtype: type) -> NDArray:
    """Return a read-only, C-contiguous copy of ``array`` as ``dtype``.

    Examples
    --------
    >>> frozen(np.arange(3), float).flags.writeable
    False
    """
    copy: NDArray = np.array(array, dtype=dtype, order="C", copy=True)
    copy.setflags(write=False)
    return copy
