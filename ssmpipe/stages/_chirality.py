"""Options of ``align`` about left and right, for surfaces and outlines alike."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from ssmpipe.contract import StageConfig


class ChiralityConfig(StageConfig):
    """What is done about left and right."""

    check_mirror: Annotated[
        bool,
        Field(
            description="Warn when the mirror image fits clearly better (a wrong side label, or sides that are mixed)."
        ),
    ] = True
    chirality: Annotated[
        Literal["keep", "best-fit"],
        Field(
            description="keep: no shape is mirrored here. best-fit: where left and right are mixed and not labelled, a shape is mirrored "
            "when its mirror image fits the reference better."
        ),
    ] = "keep"
    chirality_margin: Annotated[
        float,
        Field(
            ge=0,
            lt=1,
            description="Share of the distance by which one image must fit better than the other: by less, best-fit warns; by more, keep "
            "warns of the mirror image [-].",
        ),
    ] = 0.05
