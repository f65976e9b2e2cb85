"""Options of ``align`` about left and right, for surfaces and outlines alike."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from ssmpipe.contract import Context, StageConfig

OTHER_SIDE = "if it is of the other side, say --side (or the column side of --cohort), or mirror its file where the model mirrors no side"
"""Advice about a shape that joins a finished model."""


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


def warn_of_both_images(best: float, worst: float, mirrored: bool, advice: str, ctx: Context) -> None:
    """Warn that a shape and its mirror image fit almost alike; ``advice`` is for a shape of a cohort."""
    if ctx.joins:
        advice = "look at its page, its coefficients may be those of the mirror image"
    ctx.warn(
        f"left and right fit almost alike (distance {best:.3g} and {worst:.3g}); it was {'' if mirrored else 'not '}mirrored: {advice}"
    )
