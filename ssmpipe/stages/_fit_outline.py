"""The stage ``fit`` for planar outlines."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from ssmpipe.contract import Context, Port, Stage, StageConfig
from ssmpipe.core.outline.distance import point_to_segments
from ssmpipe.core.outline.outline import Outline, edge_indices, resample
from ssmpipe.core.spline.fit_curve import Spacing, curve_points, fit_curve

_PER_CONTROL = 8


class Config(StageConfig):
    """Options of ``fit`` for outlines."""

    degree: Annotated[int, Field(ge=1, le=5, description="Degree of the spline.")] = 2
    n_control: Annotated[int, Field(ge=4, description="Control points, the same number for all shapes [count].")] = 80
    points: Annotated[
        Literal["polyline", "given"],
        Field(
            description="What is fitted. polyline: the outline with its edges, read at equal steps, so that sparse or uneven points do "
            "no harm; given: its points alone."
        ),
    ] = "polyline"
    parameters: Annotated[
        Spacing,
        Field(
            description="Parameters of given points: arc-length (of the fitted curve), chord, centripetal, or uniform (by number)."
        ),
    ] = "arc-length"
    fairness: Annotated[
        float,
        Field(
            ge=0,
            description="Weight of the squared second derivative [-]; the default only bridges spans without points.",
        ),
    ] = 1e-12
    max_rms: Annotated[
        float,
        Field(
            gt=0,
            description="Warn when the RMS distance between outline and spline exceeds this share of the size [-].",
        ),
    ] = 0.005


def run(contour: Outline, *, cfg: Config, ctx: Context) -> dict[str, Any]:
    """Fit, and report RMS and maximum distance both ways."""
    data = contour
    if cfg.points == "polyline":
        data = resample(contour, max(len(contour.points), _PER_CONTROL * cfg.n_control))
    curve = fit_curve(
        data.points,
        degree=cfg.degree,
        n_control=cfg.n_control,
        closed=contour.closed,
        parameters=cfg.parameters,
        fairness=cfg.fairness,
    )
    dense = curve_points(curve, np.linspace(0.0, 1.0, 20 * cfg.n_control + 1))
    to_spline = point_to_segments(contour.points, dense, edge_indices(len(dense), False))[0]
    to_outline = point_to_segments(dense, contour.points, contour.edges)[0]
    for name, distance in (("contour_to_spline", to_spline), ("spline_to_contour", to_outline)):
        ctx.metric(f"{name}_rms_mm", float(np.sqrt((distance**2).mean())))
        ctx.metric(f"{name}_max_mm", float(distance.max()))
    rms = max(ctx.metrics["contour_to_spline_rms_mm"], ctx.metrics["spline_to_contour_rms_mm"])
    if rms > cfg.max_rms * contour.diagonal:
        ctx.warn(
            f"the spline is {rms:.3g} RMS away from the outline ({100 * rms / contour.diagonal:.2f} % of its size); "
            "raise fit.n_control"
        )
    return {"surface": curve}


OUTLINE = Stage(
    name="fit",
    scope="shape",
    version=1,
    config=Config,
    run=run,
    inputs=(Port("contour", "outline"),),
    outputs=(Port("surface", "surface"),),
    methods="A B-spline curve of degree {degree} with {n_control} control points was fitted to each outline by least squares "
    "({parameters} parameters).",
    cites=("piegl1997",),
)
