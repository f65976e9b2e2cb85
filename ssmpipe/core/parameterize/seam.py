"""Where a surface that is not a disk was cut open, so that its map to the square closes again."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ssmpipe.core.arrays import Ints
from ssmpipe.core.errors import TopologyError

SeamTopology = Literal["tube", "cone", "closed"]
N_POLES = {"tube": 0, "cone": 1, "closed": 2}


@dataclass(frozen=True)
class Seam:
    """The seam of a surface that was cut to a disk, in vertices of the cut mesh.

    The map of the cut mesh has period 1 in u: both vertices of a pair have the same v, and the u of the right one is the u
    of the left one plus 1. v runs from 0 to 1 along the seam.

    Parameters
    ----------
    topology : {"tube", "cone", "closed"}
        Of the surface before the cut. tube: from one rim (v = 0) to the other (v = 1); cone: from the rim (v = 0) to the
        apex (v = 1); closed: from the antapex (v = 0) to the apex (v = 1).
    pairs : (n_pairs, 2) int64
        Left (u near 0) and right (u near 1) copies of the seam's vertices, by increasing v, poles left out.
    poles : tuple of int
        Vertices that a whole edge of the square stands for: none for a tube, (apex,) for a cone, (antapex, apex) if closed.

    Raises
    ------
    TopologyError
        If the number of poles does not suit the topology.

    Examples
    --------
    >>> Seam("tube", np.array([[0, 4], [1, 5]])).poles
    ()
    """

    topology: SeamTopology
    pairs: Ints
    poles: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        pairs = np.ascontiguousarray(self.pairs, dtype=np.int64)
        if pairs.ndim != 2 or pairs.shape[1] != 2:
            raise TopologyError(f"a seam needs pairs of vertices, got an array of shape {pairs.shape}")
        expected = N_POLES.get(self.topology)
        if len(self.poles) != expected:
            raise TopologyError(f"a seam of a {self.topology} has {expected} poles, got {len(self.poles)}")
        object.__setattr__(self, "pairs", pairs)
