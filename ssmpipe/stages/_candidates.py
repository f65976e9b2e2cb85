"""Landmarks that geometry proposes: how stages tell the report of them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ssmpipe.contract import Context
from ssmpipe.core.align.rigid import apply
from ssmpipe.core.arrays import Floats


def propose(found: Mapping[str, Floats], transform: Floats, ctx: Context) -> None:
    """Record places in the coordinates of the scan's file, so that they can be looked at there and taken over into a landmark file.

    Parameters
    ----------
    found : mapping name -> (3,) float64
        In the current frame [mm].
    transform : (4, 4) float64
        From the scan to the current frame.
    ctx : Context
    """
    places = apply(np.asarray(np.linalg.inv(transform)), np.array(list(found.values())))
    ctx.metric(
        "landmark_candidates",
        {name: " ".join(f"{x:.6g}" for x in place) for name, place in zip(found, places, strict=True)},
    )
