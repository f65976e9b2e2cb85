from __future__ import annotations

import numpy as np
import pytest

from ssmpipe.core.correspondence.window import Window
from ssmpipe.core.model.shape_model import ShapeModel
from ssmpipe.use.target import engine_options


@pytest.mark.parametrize(("rims", "start"), [("free", "affine"), ("kept", "identity")])
def test_a_scan_starts_as_the_group_did(rims: str, start: str) -> None:
    """Free rims are found by a registration whatever the size is; the identity says nothing of where they are."""
    none, window = np.zeros((2, 0)), Window((0.0, 0.1), (1.0, 0.9)) if rims == "free" else None
    faces = np.array([[0, 1, 2]])
    model = ShapeModel(("a", "b"), np.eye(3), np.zeros((0, 3, 3)), none[0], none, (3, 1), faces, "tube", 1.0, window)
    given = {"rims": rims, "start": "auto", "normalize": "size", "reference": "nearest-to-mean"}
    options = engine_options(model, {"steps": [{"stage": "optimize", "options": given}]})
    assert options.start == start
    assert options.window == window
