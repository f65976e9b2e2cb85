import numpy as np
import pytest

from ssmpipe.core.errors import TopologyError
from ssmpipe.core.parameterize.seam import Seam


def test_the_poles_suit_the_topology() -> None:
    pairs = np.array([[0, 4], [1, 5]])
    assert Seam("closed", pairs, (8, 9)).pairs.dtype == np.int64
    with pytest.raises(TopologyError, match="a seam of a cone has 1 poles, got 0"):
        Seam("cone", pairs)
    with pytest.raises(TopologyError, match=r"pairs of vertices, got an array of shape \(3,\)"):
        Seam("tube", np.arange(3))
