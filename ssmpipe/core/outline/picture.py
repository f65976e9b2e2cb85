"""A photograph or mask as numbers: grey or colour values, and how opaque every pixel is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssmpipe.core.arrays import Bools, frozen
from ssmpipe.core.errors import GeometryError


@dataclass(frozen=True, eq=False)
class Picture:
    """Pixels of an image. The centre of the first pixel is the origin, x runs to the right, y runs down [pixels].

    Parameters
    ----------
    colors : (height, width, 1 or 3) float32
        Grey, or red, green and blue; 0 is black, 1 is white.
    opaque : (height, width) bool, optional
        False where the file says that the pixel is transparent; None when it says nothing.

    Raises
    ------
    GeometryError
        If the arrays do not fit each other or are not finite.

    Examples
    --------
    >>> Picture(np.zeros((2, 3, 1))).size
    (2, 3)
    """

    colors: np.ndarray
    opaque: Bools | None = None

    def __post_init__(self) -> None:
        colors = np.asarray(self.colors)
        if colors.ndim != 3 or colors.shape[2] not in (1, 3) or 0 in colors.shape:
            raise GeometryError(f"a picture needs values of shape (height, width, 1 or 3), got {colors.shape}")
        if not np.isfinite(colors).all():
            raise GeometryError("the picture has values that are not finite")
        object.__setattr__(self, "colors", frozen(colors, np.float32))
        if self.opaque is not None:
            if np.shape(self.opaque) != colors.shape[:2]:
                raise GeometryError(
                    f"opacity of shape {np.shape(self.opaque)} for a picture of {colors.shape[:2]} pixels"
                )
            object.__setattr__(self, "opaque", frozen(np.asarray(self.opaque), np.bool_))

    @property
    def size(self) -> tuple[int, int]:
        """Height and width [pixels]."""
        return int(self.colors.shape[0]), int(self.colors.shape[1])
